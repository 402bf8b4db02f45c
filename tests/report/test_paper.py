"""The paper's figures and tables from results, and its figures beside ours."""

import csv
import errno
import json
import math
import os
import shutil
import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import scipy
from experiment_files import QUICK, json_of, printed_by
from experiment_files import gbid as command
from figure_cases import machine
from places import ROOT
from stored_values import small as small_value

import gbid
from gbid import report
from gbid.control.impact.measured import MeasuredImpact
from gbid.control.impact.ringdown import RingDown
from gbid.control.impact.study import ImpactStudy, ImpactValidation
from gbid.core.errors import DataError, UsageError
from gbid.core.files import share_folder
from gbid.core.tables import csv_text, markdown_table
from gbid.experiment.load import load_experiment
from gbid.experiment.run import Job
from gbid.lpv import characteristics, fit_lpv, load_machine
from gbid.lpv.estimates import Estimates
from gbid.lpv.model import CHARACTERISTICS
from gbid.report.named import comparison, paper
from gbid.rig import RotorBearingTruth, Scatter
from gbid.rig.machine import scatter_random, scattered
from gbid.structure import KEY_PARAMETERS
from gbid.validate import ValidationScores, summarise

paper_files, compared = paper(), comparison()
PaperNumber, _values, counts, judged = (getattr(compared, n) for n in ("PaperNumber", "_values", "counts", "judged"))
paper_numbers, reproduction = compared.paper_numbers, compared.reproduction
reproduction_markdown = paper_files.reproduction_markdown

NUMBERS = {number.id: number for number in paper_numbers()}


# The figures as the paper prints them, typed from its text a second time: sections and tables in their order.
PRINTED = {
    **dict(zip(("xx", "xy", "yx", "yy"), (0.44, 0.037, 0.059, 0.21), strict=True)),
    "static_largest": 0.95,
    "recordings": 86,
    **{"p1_x": 3078, "p2_x": 8143, "p1_y": 2452, "p2_y": 6494, "kappa_x": 1.863, "kappa_y": 1.865},
    **{"bearing_mean_x": 81.1, "bearing_std_x": 2.66, "bearing_mean_y": 85.1, "bearing_std_y": 3.37},
    **{"actuator_mean_x": 98.34, "actuator_std_x": 0.074, "actuator_mean_y": 99.42, "actuator_std_y": 0.058},
    **{"rms_tau_x": 0.088, "rms_tau_y": 0.041, "rms_omega_1": 1.13, "rms_omega_2": 0.58},
    **{"rms_zeta_1": 0.0104, "rms_zeta_2": 0.0063},
    **{"rms_g_xx": 0.0031, "rms_g_xy": 0.0022, "rms_g_yx": 0.0027, "rms_g_yy": 0.0031, "largest_gain": 0.016},
    **{"damping_factor_1": 9.0, "damping_factor_2": 14.5, "tuned_kappa_x": 1.125, "tuned_kappa_y": 0.99},
    "tuned_damping": 0.318,
    "hysteresis": 8.4,
}
TABLES_3_AND_4 = {  # frequency 1, damping 1, frequency 2, damping 2
    "expected_open": (126.6, 0.035, 132.1, 0.029),
    "expected_closed": (99.9, 0.318, 105.1, 0.424),
    "obtained_open": (126.3, 0.026, 134.4, 0.016),
    "obtained_closed": (89.9, 0.658, 111.6, 0.446),
}


def test_listed_figures_are_those_of_the_paper():
    short = {"xx": "static_rms_xx", "xy": "static_rms_xy", "yx": "static_rms_yx", "yy": "static_rms_yy"}
    short |= {name: f"actuator_{name}" for name in ("p1_x", "p2_x", "p1_y", "p2_y", "kappa_x", "kappa_y")}
    printed = {short.get(name, name): value for name, value in PRINTED.items()}
    keys = [f"{what}_{i}" for i in (1, 2) for what in ("frequency", "damping")]
    for name, values in TABLES_3_AND_4.items():
        printed |= {f"{name}_{key}": value for key, value in zip(keys, values, strict=True)}
        word = name.replace("expected", "model")
        printed |= {f"{word}_{key}": value for key, value in zip(keys, values, strict=True)}
    printed |= {"model_damping_factor_1": 9.0, "model_damping_factor_2": 14.5}
    assert {name: q.value for name, q in NUMBERS.items() if q.value is not None} == printed


def test_kinds_are_counted_and_only_surfaces_have_no_figure_of_the_paper():
    kinds = [number.kind for number in NUMBERS.values()]
    assert {kind: kinds.count(kind) for kind in compared.KIND_WORDS} == {
        "independent": 17,
        "found again": 24,
        "set": 32,
    }
    without = {name for name, number in NUMBERS.items() if number.value is None}
    assert without == {f"surface_{name}" for name in CHARACTERISTICS}


def test_each_listed_figure_has_a_value_of_ours_and_the_other_way_round():
    assert set(NUMBERS) == set(dict(_values()))
    assert {number.off for number in NUMBERS.values()} - {""} == set(compared.ACCOUNTS)
    assert {number.off for number in NUMBERS.values() if number.accounts == "explained"} == {"flat"}
    assert set(compared.CHECKS) < set(NUMBERS)
    for number in NUMBERS.values():
        assert number.scatter is None or number.scatter_from, number.id


def test_no_row_passes_because_our_value_is_zero():
    for number in NUMBERS.values():
        assert judged(number, 0.0).verdict == "open", number.id


def number(value=10.0, scatter=None, samples=None):
    return PaperNumber("a", "", "", "", "set", value, scatter, samples=samples, off="share", why="because")


def test_no_tolerance_is_above_a_quarter():
    measured = NUMBERS["obtained_closed_damping_1"]
    assert (measured.scatter, measured.allowed) == (0.34, pytest.approx(0.658 / 4))
    assert judged(measured, 0.431, 0.034).verdict == "open"
    assert judged(number(scatter=1.0), 12.6, 5.0).verdict == "open"  # nor does a standard deviation of ours excuse more


@pytest.mark.parametrize(
    ("listed", "ours", "std", "verdict"),
    [
        (number(scatter=1.0), 10.9, math.nan, "within"),
        (number(scatter=1.0), 8.9, math.nan, "open"),
        (number(scatter=1.0), 11.05, 0.2, "within"),  # up to hypot(1, 2 * 0.2) = 1.077
        (number(scatter=1.0), 11.1, 0.2, "open"),
        (number(), 10.0, math.nan, "open"),  # the paper gives no scatter
        (number(value=None), 10.0, 1.0, "open"),
        (number(scatter=1.0, samples=100), 10.19, math.nan, "within"),  # of a mean: two standard errors, 0.2
        (number(scatter=1.0, samples=100), 10.21, math.nan, "open"),
        (number(samples=51), 11.99, math.nan, "within"),  # of a standard deviation: 2 * 10 / sqrt(2 * 50) = 2
        (number(samples=51), 12.01, math.nan, "open"),
        (number(samples=51), 0.0, math.nan, "open"),
        (number(scatter=1.0), math.nan, math.nan, "missing"),
    ],
)
def test_verdicts(listed, ours, std, verdict):
    assert judged(listed, ours, std).verdict == verdict


@pytest.mark.parametrize(
    ("predicted", "std", "verdict"),
    [
        (12.0, 0.5, "ours"),
        (11.2, 0.0, "ours"),
        (10.9, 0.0, "open"),
        (10.9, 0.4, "ours"),
        (math.nan, 1.0, "open"),
    ],
)
def test_a_setting_or_an_explanation_holds_where_its_prediction_does(predicted, std, verdict):
    row = compared.accounted(judged(number(scatter=1.0), 12.0, 0.5), predicted, std)
    assert row.verdict == verdict  # within two standard deviations of both
    assert row.why == "because"
    assert row.document()["explanation"] == "share"
    linked = replace(judged(number(scatter=1.0), 12.0, 0.5), number=replace(number(), accounts="explained"))
    assert compared.accounted(linked, predicted, std).verdict == verdict.replace("ours", "explained")


@pytest.mark.parametrize(
    ("value", "verdict"), [(10.0, "within"), (10.19, "within"), (11.0, "open"), (math.nan, "open")]
)
def test_a_row_is_open_where_other_code_gives_another_value(value, verdict):
    row = compared.checked(judged(number(scatter=1.0), 10.0), value)
    assert (row.verdict, row.document()["checked"]) == (verdict, None if math.isnan(value) else value)


def test_a_deviation_is_ours_minus_the_papers():
    row = judged(number(8.0, 1.0), 10.0, 0.5).document()
    assert (row["paper"], row["ours"], row["ours_std"]) == (8.0, 10.0, 0.5)
    assert (row["deviation"], row["deviation_percent"]) == (2.0, 25.0)
    assert judged(number(-4.0, 1.0), -5.0).document()["deviation_percent"] == 25.0
    assert judged(number(None), 10.0).document()["deviation"] is None


def test_rows_are_counted_by_kind_and_verdict():
    rows = [judged(number(8.0, 1.0), value) for value in (8.0, 8.5, 8.9, 12.0, 1.0, math.nan)]
    rows.append(replace(rows[0], number=replace(rows[0].number, kind="independent")))
    none = dict.fromkeys(("within", "explained", "ours", "open", "missing"), 0)
    assert counts(rows) == {
        "independent": {**none, "within": 1},
        "found again": none,
        "set": {**none, "within": 3, "open": 2, "missing": 1},
    }


class Stored(SimpleNamespace):
    """Results of which only some are there; the caches of the comparison need a hash."""

    __hash__ = object.__hash__


def test_values_of_ours_from_surfaces_and_impacts(monkeypatch):
    paper, computed = machine(), dict(_values())
    tau = paper.coefficients["tau_x"]
    points = np.array(paper.operating_points, float)
    linear = (tau[0] + 2e-4, tau[1] + 1e-4, *tau[2:])  # an rms is not the largest, and not about a mean
    shifted = replace(paper, coefficients={**paper.coefficients, "tau_x": linear})
    sizes = (("g_xx", 0.1), ("g_yx", 0.3), ("omega_1", 5.0))
    surfaces = SimpleNamespace(model=shifted, deviations=[SimpleNamespace(name=n, largest=v) for n, v in sizes])
    ring = SimpleNamespace(modes=lambda: ((99.0, 0.11), (119.0, 0.22)))
    impacts = {
        "open": SimpleNamespace(expected=((100.0, 0.1), (120.0, 0.2)), ringdown=ring),
        "closed": SimpleNamespace(expected=((101.0, 0.3), (121.0, 0.5))),
    }
    summary = SimpleNamespace(mean=(81.0, 82.0), std=(3.0, 4.0), n_recordings=51)
    results = Stored(
        machine=paper,
        surface_fit=surfaces,
        impacts_at=lambda with_piezos: impacts,
        summary={"rotor_bearing": summary}.__getitem__,
    )
    again = np.array([[[97.0, 0.10], [118.0, 0.2]], [[100.0, 0.14], [119.0, 0.2]]])
    monkeypatch.setattr(compared, "_drawn", lambda results: {q: np.full((2, 2), 0.01) for q in ("open", "closed")})
    monkeypatch.setattr(compared, "recorded_again", lambda results, loop: {"open": again}[loop])
    expected = np.sqrt(np.mean((2e-4 + 1e-4 * points[:, 0]) ** 2))
    assert computed["surface_tau_x"](results)[0] == pytest.approx(expected)
    assert [computed[f"surface_{name}"](results)[0] for name in ("tau_y", "omega_1")] == pytest.approx([0, 0], abs=1e-9)
    assert computed["largest_gain"](results)[0] == 0.3
    assert [computed[f"damping_factor_{i}"](results)[0] for i in (1, 2)] == pytest.approx([3.0, 2.5])
    assert computed["damping_factor_1"](results)[1] == pytest.approx(3.0 * np.hypot(0.01 / 0.3, 0.01 / 0.1))
    assert computed["expected_closed_frequency_2"](results) == (121.0, 0.01)
    assert computed["obtained_open_frequency_1"](results) == (99.0, pytest.approx(3 / np.sqrt(2)))  # between recordings
    assert computed["obtained_open_damping_1"](results) == (0.11, pytest.approx(0.04 / np.sqrt(2)))
    assert computed["obtained_open_damping_2"](results) == (0.22, 0.0)
    assert [computed[f"bearing_{what}"](results)[0] for what in ("mean_x", "mean_y", "std_y")] == [81.0, 82.0, 4.0]
    assert computed["bearing_mean_x"](results)[1] == pytest.approx(3.0 / np.sqrt(51))
    assert computed["bearing_std_y"](results)[1] == pytest.approx(4.0 / 10)


def test_scatter_of_the_rig_predicts_the_rms_off_the_surfaces():
    """Truths drawn as the rig draws them, fitted without errors: the rms of each characteristic is as predicted."""
    paper, scatter = machine(), Scatter(share=0.5)
    points = np.repeat(np.array(paper.operating_points, float), 6, axis=0)
    values = []
    for i, (bar, rpm) in enumerate(points):
        known = {key: float(v) for key, v in paper.key_parameters(bar, rpm).items()}
        random = scatter_random(1, f"r{i}", {"pressure_bar": bar})
        drawn = scattered(RotorBearingTruth.from_parameters(known), scatter, random)[0].key_parameters()
        values.append([drawn[key] for key in KEY_PARAMETERS])
    values = np.array(values)
    covariance = np.array([np.diag((1e-6 * v) ** 2) for v in values])
    fit = fit_lpv(Estimates(tuple(f"r{i}" for i in range(90)), points, values, covariance), weighting="ordinary")
    results = Stored(
        surface_fit=fit, experiment=SimpleNamespace(spec=SimpleNamespace(rig=SimpleNamespace(scatter=scatter)))
    )
    own = dict(_values())
    for name in CHARACTERISTICS:
        (computed, std), (predicted, _) = (
            own[f"rms_{name}"](results),
            compared._of_share(NUMBERS[f"rms_{name}"], results),
        )
        assert computed == pytest.approx(predicted, abs=4 * std), name


def test_std_of_characteristics_follows_from_that_of_the_key_parameters():
    keys = machine().key_parameters(6.0, 0.0)
    values = np.array([float(keys[key]) for key in KEY_PARAMETERS])
    root = 1e-3 * np.abs(values)[:, None] * np.random.default_rng(1).standard_normal((14, 14))
    drawn = values + np.random.default_rng(2).standard_normal((4000, 14)) @ root.T
    computed = compared._propagated(values, root @ root.T)
    np.testing.assert_allclose(computed, characteristics(drawn).std(axis=0), rtol=0.05)


def test_readings_of_a_coefficient_are_plants_of_the_machine(monkeypatch):
    published = load_machine("theisen2016")
    used, *others = published.alternatives.values()
    assert used.coefficients == published.model.coefficients
    assert [q.coefficients["d_yx"][5] / used.coefficients["d_yx"][5] for q in others] == pytest.approx([10, 0.1, 0, -1])
    three = ((3.0, 0.0), (7.0, 4000.0), (7.0, 6000.0))
    used, worst = (replace(q, operating_points=three) for q in (used, others[0]))
    published = replace(published, alternatives={"d = 1": used, "d = 10": worst})
    rig = SimpleNamespace(sample_time_s=2e-4)
    results = Stored(
        published_machine=published, experiment=SimpleNamespace(spec=SimpleNamespace(rig=rig, lpv="a section"))
    )
    monkeypatch.setattr(compared, "changed_verdicts", lambda results, model: [])
    rows, designs = compared.alternative_rows(results), compared.alternative_designs(results)
    assert min(min(row[2:4]) for row in rows) > 0  # each is stable, which is why none can be ruled out
    by_hand = min(zeta for bar, rpm in used.operating_points for _, zeta in used.plant_at(bar, rpm).modes())
    assert rows[0][2] == pytest.approx(by_hand)
    assert [row[1] for row in rows] == [0, 2]  # all points but the one at rest
    tuned, first, complete = np.array([row[3:] for row in designs]).T
    assert first[0] == pytest.approx(tuned[0], rel=1e-5)
    assert (tuned >= first - 1e-6).all()
    assert complete.min() > first.min()  # a design over all readings as plants has the better worst case
    assert (tuned >= complete - 1e-6).all()


def test_another_reading_moves_surfaces_without_changing_their_errors(surfaces):
    """The difference of two readings is itself a surface, so the fit moves by it and the residuals stay."""
    published = load_machine("theisen2016")
    other = published.alternatives["d_yx[Omega^2] = -0.003087"]
    seen = []

    def row(number, results):
        seen.append(results)
        return judged(number, number.value if results is not seen[0] and number.id == "rms_zeta_2" else 0.0)

    def answer(results):
        return results is seen[0], ""

    lpv = SimpleNamespace(weighting="ordinary", order=2, robust=False)
    results = Stored(
        machine=published.model,
        surface_fit=surfaces,
        experiment=SimpleNamespace(spec=SimpleNamespace(lpv=lpv)),
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(compared, "_compared", row)
        patch.setattr(compared, "ANSWERS", dict.fromkeys(compared.ANSWERS, answer))
        assert compared.changed_verdicts(results, other) == ["rms_zeta_2", *compared._SAID_OF_SURFACES]
    fit = seen[1].surface_fit
    assert seen[1].experiment is results.experiment
    np.testing.assert_allclose(
        fit.estimates.values - fit.surface, surfaces.estimates.values - surfaces.surface, atol=1e-6
    )
    shifted = {
        key: np.subtract(fit.model.coefficients[key], surfaces.model.coefficients[key]) for key in KEY_PARAMETERS
    }
    assert shifted["d_yx"][5] == pytest.approx(-9 * 3.087e-7, rel=1e-6)
    assert all(
        abs(shifted[key]).max() < 1e-6 * abs(np.array(surfaces.model.coefficients[key])).max() for key in shifted
    )


def test_impacts_recorded_again_scatter_as_the_rig_does(monkeypatch, tmp_path):
    """Without noise and scatter they show the rig's own modes; again and again, another machine each time."""
    monkeypatch.setattr(sys.modules[compared.recorded_again.__module__], "_REPEATS", 3)
    experiment = load_experiment(ROOT / "experiments" / "theisen2016.yaml", tmp_path)
    impacts = experiment.spec.impacts.model_copy(update={"repeats": 1})
    one_ring = {"open": SimpleNamespace(ringdown=SimpleNamespace(lag_rates=()))}
    hit_once = replace(experiment, spec=experiment.spec.model_copy(update={"impacts": impacts}))
    results = Stored(job=Job(hit_once), impacts_at=lambda with_piezos: one_ring)
    true = np.array(machine().at(6.0, 0.0).modes())
    np.testing.assert_allclose(compared.ringing_without_noise(results, "open"), true, rtol=2e-3)
    modes = compared.recorded_again(results, "open")
    assert modes.shape == (3, 2, 2)
    drawn = 0.5 * np.array([[1.13, 0.0104], [0.58, 0.0063]])  # half of the paper's deviations (Sec. 4)
    assert (np.abs(modes - true) < 4 * drawn).all()
    assert (modes.std(axis=0, ddof=1) > 0.1 * drawn).all()


def test_stored_comparison_is_of_the_present_list():
    """`make paper` writes it, docs/reproduction.md shows it."""
    stored = json.loads((ROOT / "docs" / "reproduction.json").read_text(encoding="utf-8"))
    assert [row["id"] for row in stored["rows"]] == list(NUMBERS)
    for row in stored["rows"]:
        listed = NUMBERS[row["id"]]
        assert (row["paper"], row["kind"], row["allowed"]) == (listed.value, listed.kind, listed.allowed)
        again = judged(listed, row["ours"], math.nan if row["ours_std"] is None else row["ours_std"])
        if again.verdict == "open" and row["predicted"] is not None:
            again = compared.accounted(again, row["predicted"], row["predicted_std"])
        if row["checked"] is not None:
            again = compared.checked(again, row["checked"])
        assert row["verdict"] == again.verdict, row["id"]
    assert {row["id"] for row in stored["sentences"]} == set(compared.ANSWERS)
    assert all(row["paper"] for row in stored["sentences"])


def test_broken_list_of_figures_is_refused(tmp_path):
    path = tmp_path / "numbers.yaml"
    row = "  - {id: x, where: '', quantity: q, unit: '', kind: set, value: 1, off: b}\n"
    path.write_text(f"explanations: {{a: text}}\nnumbers:\n{row}")
    with pytest.raises(UsageError, match="no setting or explanation 'b'"):
        paper_numbers(path)
    path.write_text("explanations: {}\nnumbers:\n  - {id: x, where: '', quantity: q, unit: '', kind: mine, value: 1}\n")
    with pytest.raises(UsageError, match="kind = 'mine'; choose independent, found again, set"):
        paper_numbers(path)
    row = "  - {id: x, where: '', quantity: q, unit: '', kind: set, value: 1}\n"
    path.write_text(f"explanations: {{}}\nnumbers:\n{row}{row}")
    with pytest.raises(UsageError, match="twice"):
        paper_numbers(path)


def staircases(gain, scatter=0.0):
    """Recordings of a static map, one staircase for each axis, with the equilibrium away from zero."""
    random, computed = np.random.default_rng(1), []
    levels = 1e-6 * np.concatenate([np.arange(-5, 6), np.arange(4, -6, -1)])
    for axis in (0, 1):
        u = np.zeros((len(levels) * 200, 2))
        u[:, axis] = np.repeat(levels, 200)
        p = u @ gain.T + [3e-6, -2e-6] + scatter * random.standard_normal(u.shape)
        computed.append(gbid.Recording({"r": u, "u": u, "p": p}, 2e-4, name="xy"[axis]))
    return computed


def test_static_map_panels_are_the_gains():
    gain = np.array([[0.25, -0.01], [0.02, 0.29]])
    result = gbid.characterise_staircase(staircases(gain, 1e-9))
    axes = report.plot_static_map(result)
    assert [ax.get_xlabel() for ax in axes[1]] == ["$u_{x}$ [µm]", "$u_{y}$ [µm]"]
    for i, j in np.ndindex(2, 2):
        _, rising, falling = lines = axes[i, j].get_lines()
        for line in lines:
            slope, offset = np.polyfit(line.get_xdata(), line.get_ydata(), 1)
            assert slope == pytest.approx(gain[i, j], abs=2e-4)
            assert offset == pytest.approx(0, abs=2e-3)  # about the equilibrium [µm]
        assert min(len(rising.get_xdata()), len(falling.get_xdata())) > 0


def test_histogram_counts_every_pair():
    random = np.random.default_rng(2)
    percent = np.column_stack([80 + random.standard_normal(40), 85 + random.standard_normal(40)])
    names = tuple(str(i) for i in range(40))
    where = np.full(40, 6.0)
    scores = ValidationScores(names, names, where, where, ("p_x", "p_y"), ("m", "m"), percent, 1e-6 * percent)
    for j, ax in enumerate(report.plot_fit_histogram(summarise(scores))):
        assert ax.patches[0].get_data().values.sum() == 40
        mean, std = percent[:, j].mean(), percent[:, j].std(ddof=1)
        assert ax.texts[0].get_text() == f"mean {mean:.2f} %\nstd {std:.2f} %\nn = 40"


def test_histogram_states_the_number_of_all_pairs():
    names = tuple(map(str, range(40)))
    percent = np.column_stack([np.r_[-300.0, 80 + np.random.default_rng(2).standard_normal(39)]] * 2)
    scores = ValidationScores(names, names, *[np.full(40, 6.0)] * 2, ("p_x", "p_y"), ("m", "m"), percent, percent)
    ax = report.plot_fit_histogram(summarise(scores))[0]
    assert "1 more to the left" in ax.get_title("right")
    assert ax.texts[0].get_text().endswith("n = 40")  # as mean and std


@pytest.fixture(scope="module")
def surfaces():
    paper, random = machine(), np.random.default_rng(3)
    points = np.repeat(np.array(paper.operating_points), 2, axis=0)
    values = np.column_stack([paper.key_parameters(*points.T)[key] for key in KEY_PARAMETERS])
    values *= 1 + 0.01 * random.standard_normal(values.shape)
    names = tuple(f"r{i}" for i in range(len(points)))
    covariance = np.array([np.diag((0.01 * v) ** 2) for v in values])
    return fit_lpv(Estimates(names, points, values, covariance), weighting="ordinary")


class Surfaced(Stored):
    """Results with surfaces alone, and a rig with the scatter of the paper's experiment."""

    def __init__(self, fit):
        rig = SimpleNamespace(scatter=Scatter(share=0.5))
        super().__init__(machine=machine(), surface_fit=fit, experiment=SimpleNamespace(spec=SimpleNamespace(rig=rig)))


def test_rows_of_surfaces_open_when_their_characteristics_are_a_tenth_too_large(surfaces, monkeypatch):
    fed = [name for name in NUMBERS if name.startswith(("rms_", "surface_")) or name == "largest_gain"]
    assert len(fed) == 21
    right = Surfaced(surfaces)
    for name in fed:
        assert compared.CHECKS[name](right) == pytest.approx(dict(_values())[name](right)[0], rel=1e-6), name
    scaled = lambda values: 1.1 * characteristics(values)  # noqa: E731
    monkeypatch.setattr(compared, "characteristics", scaled)
    monkeypatch.setattr(sys.modules["gbid.lpv.fit"], "characteristics", scaled)
    wrong = Surfaced(replace(surfaces))  # nothing is cached
    assert {name: compared._compared(NUMBERS[name], wrong).verdict for name in fed} == dict.fromkeys(fed, "open")


def ringing(modes, n=600):
    """Free responses of two coupled oscillators after an impact along x, and after one along y."""
    w, z = 2 * np.pi * np.array(modes).T[0], np.array(modes).T[1]
    shapes = np.array([[1.0, 0.3], [-0.2, 1.0]])
    K, D = (shapes @ np.diag(q) @ np.linalg.inv(shapes) for q in (-(w**2), -2 * z * w))
    step = scipy.linalg.expm(2e-4 * np.block([[np.zeros((2, 2)), np.eye(2)], [K, D]]))
    validations = []
    for axis in "xy":
        states = [np.array([0.0, 0.0, *(1e-3 * (axis == q) for q in "xy")])]
        while len(states) < n:
            states.append(step @ states[-1])
        hit = MeasuredImpact(0, 1, 10.0, 0.0 if axis == "x" else 90.0)
        p = np.array(states)[:, :2] + 1e-8 * np.random.default_rng(1).standard_normal((n, 2))
        validations.append(SimpleNamespace(time=2e-4 * np.arange(n), measured=p, impacts=(hit,)))
    return validations


def test_rows_of_ring_downs_open_when_their_modes_are_a_tenth_too_large(monkeypatch):
    listed = [f"obtained_closed_{what}_{i}" for i in (1, 2) for what in ("frequency", "damping")]
    true = np.array([(90.5, 0.62), (111.0, 0.44)])
    monkeypatch.setattr(compared, "recorded_again", lambda results, loop: np.array([0.97 * true, 1.03 * true]))
    verdicts = []
    for factor in (1.0, 1.1):
        ring = SimpleNamespace(modes=lambda q=factor: q * true, lag_rates=np.zeros(0), oscillations=np.zeros((0, 2)))
        study = SimpleNamespace(ringdown=ring, validations=ringing(true))
        results = Stored(impacts_at=lambda rotating, q=study: {"closed": q})
        np.testing.assert_allclose([compared.CHECKS[name](results) for name in listed], true.ravel(), rtol=5e-3)
        verdicts.append([compared._compared(NUMBERS[name], results).verdict for name in listed])
    assert verdicts == [["within"] * 4, ["open"] * 4]


def test_headline_counts_what_lies_outside():
    ours = {q: q.value * (1.5 if q.id.endswith("closed_frequency_1") else 1.0) for q in NUMBERS.values() if q.value}
    rows = [judged(listed, value) for listed, value in ours.items()]
    formulas, gains, measured = compared.headline(rows)
    assert "1 of 10" in formulas
    assert "0 of 3" in gains
    assert "1 of 4 figures of the closed loop lie outside, and 0 of 4 of the open" in measured


def test_table_b6_contradicts_two_sentences_of_the_paper():
    points = np.array(machine().operating_points, float)
    answers = {name: answer(machine(), points) for name, answer in compared.OF_SURFACES.items()}
    assert answers["coupling"][0] is answers["falling_delay"][0] is False
    assert "at 10 of 15 points" in answers["coupling"][1]
    assert "in 10 (x)" in answers["falling_delay"][1]


@pytest.mark.parametrize(("within", "holds"), [(0.2, True), (2.0, False)])
def test_variation_within_points_is_small_beside_that_of_the_points(within, holds):
    random, points = np.random.default_rng(4), np.repeat(np.array(machine().operating_points, float), 6, axis=0)
    away = np.repeat(random.standard_normal((15, 14)), 6, axis=0) + within * random.standard_normal((90, 14))
    fit = SimpleNamespace(estimates=SimpleNamespace(values=away, points=points), surface=np.zeros((90, 14)))
    assert compared.ANSWERS["small_variation"](Stored(surface_fit=fit))[0] is holds


@pytest.mark.parametrize("what", ["delay", "frequency", "damping", "gain"])
def test_estimates_stand_at_their_points(surfaces, what):
    panels = report.fit_over_pressure_data(surfaces, what)
    for panel in panels:
        assert panel.points == pytest.approx(surfaces.estimates.points)
        assert list(panel.speed_rpm) == [0, 4000, 6000]
        on_curve = [
            np.interp(bar, panel.pressure_bar, panel.values[list(panel.speed_rpm).index(rpm)])
            for bar, rpm in panel.points
        ]
        assert panel.estimates == pytest.approx(on_curve, rel=0.2, abs=0.02)


def test_surface_panels_are_the_estimates(surfaces):
    for surface in report.fit_surfaces_data(surfaces, "d"):
        column = KEY_PARAMETERS.index(surface.name)
        assert surface.estimates == pytest.approx(surfaces.estimates.values[:, column])
        assert surface.at_points == pytest.approx(surfaces.surface[:, column])


def study(loop, start, decay):
    time = 2e-4 * np.arange(2000)
    p, f = np.zeros((2000, 2)), np.zeros((2000, 2))
    for impact in (start, start + 900):
        f[impact : impact + 10, 0] = 10.0
        p[impact:, 0] += 1e-6 * np.exp(-decay * time[: 2000 - impact])
    windows = ((start, start + 400), (start + 900, start + 1300))
    impacts = tuple(MeasuredImpact(a, a + 10, 10.0, 0.0) for a, _ in windows)
    result = ImpactValidation(
        0.5,
        0.01,
        np.array([80.0, 1.0]),
        80.0,
        time,
        p + 1e-7,
        np.full_like(p, 1e-7),
        p,
        f,
        windows,
        impacts,
        0,
        "r",
        loop,
    )
    modes = ((120.0, 0.1), (130.0, 0.1))
    return ImpactStudy(
        {"pressure_bar": 6.0, "speed_rpm": 0.0}, loop, "m", "", modes, modes, small_value(RingDown), (result,)
    )


def test_impacts_of_both_loops_begin_at_zero():
    curves = report.impact_data(study("open", 300, 20.0), study("closed", 457, 90.0), "x")
    assert set(curves.responses) == set(curves.forces) == {"open loop", "closed loop"}
    for force in curves.forces.values():
        assert curves.time[np.flatnonzero(force)[0]] == pytest.approx(0.0, abs=1e-12)
        assert (force > 0).sum() == 10  # the second impact is not shown
    assert curves.title == "6 bar, 0 rpm"
    with pytest.raises(UsageError, match="no impact along y"):
        report.impact_data(study("open", 300, 20.0), study("closed", 457, 90.0), "y")
    compared = report.impact_validation_data(study("closed", 457, 90.0), "x")
    assert compared.responses["measured"] == pytest.approx(
        compared.responses["simulated"]
    )  # the rest turned with the shaft


SMALL = (
    QUICK.replace("pressure_bar: 5.0, speed_rpm: 6000", "pressure_bar: 6.0, speed_rpm: 0") + "nominal: {fit: piezos}\n"
)


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    folder = tmp_path_factory.mktemp("paper")
    path = folder / "experiment.yaml"
    path.write_text(SMALL)
    for verb in ("rig", "fit", "crossval"):
        assert command(verb, path, "--results", folder / "out") == 0
    return path, folder / "out"


def test_verb_writes_what_it_can_and_says_what_it_left_out(small, monkeypatch, capsys):
    path, out = small
    wanted = ("fig03_differential_pairing", "fig09_crossval_bearing", "fig11_stiffness", "fig20_sensitivities")
    monkeypatch.setattr(paper_files, "FIGURES", {name: paper_files.FIGURES[name] for name in wanted})
    formats = [word for kind in ("pdf", "svg", "png") for word in ("--format", kind)]
    document = json_of(capsys, "paper", path, "--only", "figures", "--results", out, *formats)
    left_out = {row["item"]: row["why"] for row in document["left_out"]}
    assert left_out["fig11_stiffness"] == "no section 'lpv'; add one"
    assert left_out["table3_natural_frequencies"] == "no section 'impacts'; add one"
    assert set(left_out) == {
        *wanted[2:],
        "designs",
        "designs_impacts",
        "table3_natural_frequencies",
        "table4_damping_factors",
        "tableB6_coefficients",
    }
    for name in wanted[:2]:
        begins = {"pdf": b"%PDF", "svg": b"<?xml", "png": b"\x89PNG"}
        for kind, magic in begins.items():
            assert (out / "figures" / f"{name}.{kind}").read_bytes().startswith(magic)
    again = json_of(capsys, "paper", path, "--only", "figures", "--results", out)
    assert {o["state"] for o in again["outcomes"]} == {"kept"}


def test_a_full_disk_is_not_a_figure_left_out(small, tmp_path, monkeypatch, capsys):
    path, out = small
    shutil.copytree(out, tmp_path / "out", ignore=shutil.ignore_patterns("figures"))

    def full(_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("gbid.core.files.os.fsync", full)
    printed = printed_by(capsys, "paper", path, "--only", "figures", "--results", tmp_path / "out", code=3)
    assert "No space left in" in printed.err.splitlines()[-1]


def test_tables_hold_what_the_model_file_says(small):
    path, out = small
    results = paper().PaperResults(Job(load_experiment(path, out)))
    table = paper_files.actuator_table(results)
    rows = [dict(zip((column.heading for column in table.columns), row, strict=True)) for row in table.rows]
    assert {row["parameter"]: row["published"] for row in rows} == dict(machine().actuators)
    assert {row["parameter"]: row["value"] for row in rows} == results.nominal.parameters
    read = list(csv.DictReader(csv_text(paper_files.controller_table(results)).splitlines()))
    assert [float(row["gain [m/m]"]) for row in read] == [0.926, 0.927, 0.220, 0.640]
    assert markdown_table(paper_files.machine_table(results)).count("\n| ") == 2 + len(load_machine("theisen2016").rig)


def test_rows_without_results_are_missing_with_the_reason(small, monkeypatch, capsys):
    path, out = small
    monkeypatch.setattr(paper_files, "_PAST", paper_files._PAST[:3])  # controllers for each reading take long
    rows = {row.number.id: row for row in reproduction(paper().PaperResults(Job(load_experiment(path, out))))}
    assert rows["bearing_mean_x"].verdict != "missing"
    assert rows["rms_omega_1"].why == "no section 'lpv'; add one"
    assert "static" in rows["static_rms_xx"].why
    text = reproduction_markdown(paper_files.reproduction_document(list(rows.values())))
    assert text.count("\n| ") == 3 + len(rows)  # heads of both tables, and a rule
    document = json_of(capsys, "paper", path, "--only", "comparison", "--results", out)
    assert len(document["rows"]) == len(NUMBERS)
    assert len(document["past_the_paper"]) == 2  # neither ring-downs nor designs
    answers = {row["id"]: row["answer"] for row in document["sentences"]}
    assert answers["sensitivity"] == answers["peak_gain"] == "yes"
    assert answers["coupling"] == "not testable"  # no section 'lpv'
    for name, row in rows.items():  # the published model needs no results
        if name.startswith(("model_", "tuned_")):
            assert row.verdict == ("explained" if name == "tuned_kappa_x" else "within"), name
    assert rows["tuned_kappa_x"].predicted == pytest.approx(1.128, abs=0.01)
    assert (out / "reproduction.csv").read_text().count("\n") == len(NUMBERS) + 3  # names and two comments


def test_another_machine_has_no_reproduction(tmp_path):
    text = (share_folder("models") / "theisen2016.yaml").read_text(encoding="utf-8")
    (tmp_path / "own.yaml").write_text(text.replace("name: theisen2016", "name: own"), encoding="utf-8")
    path = tmp_path / "experiment.yaml"
    path.write_text(QUICK.replace("rig:\n", "rig:\n  model: own.yaml\n"))
    with pytest.raises(DataError, match="theisen2016"):
        reproduction(paper().PaperResults(Job(load_experiment(path, tmp_path / "out"))))


def test_staircases_are_made_where_they_are_asked_for(tmp_path):
    path = tmp_path / "experiment.yaml"
    points = "operating_points: [{pressure_bar: 5.0, speed_rpm: 0}, {pressure_bar: 6.0, speed_rpm: 0}]"
    text = f"format: 1\nname: own\nrig:\n  {points}\n  staircase: {{at: [{{pressure_bar: 6.0, speed_rpm: 0}}]}}\n"
    path.write_text(text)
    stairs = [name for name in load_experiment(path).recordings if "stairs" in name]
    assert stairs == ["p6_n0_stairs_x1", "p6_n0_stairs_y1"]
    path.write_text(text.replace("at: [{pressure_bar: 6.0", "at: [{pressure_bar: 7.0"))
    with pytest.raises(UsageError, match="no operating point of the rig"):
        load_experiment(path)
