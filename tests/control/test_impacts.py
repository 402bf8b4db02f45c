"""Impacts on the rig: force scaling, ring-downs in any loop, the paper's rows, figures, the stage and its verb."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from experiment_files import gbid as command
from experiment_files import write_quick
from json_keys import assert_keys
from scipy.linalg import block_diag

import gbid
from gbid import load, report, save
from gbid.control import (
    HalfSine,
    ImpactStudy,
    close_loop,
    controller_structure,
    exact_plant,
    impact_response,
    p_controller,
    ringing_modes,
    sample_controller,
    sampled_loop,
    save_controller,
    scheduled,
    study_impacts,
)
from gbid.core.errors import DataError, UsageError
from gbid.rig import Hammer, Impact, Machine, SampledController, SensorChain, Stationary, record
from gbid.structure import LinearModel

MODEL = gbid.load_model("theisen2016")
PAPER = p_controller(1.125, 0.99)
SAMPLED = sample_controller(PAPER, 2e-4)
POINT = (6.0, 0.0)
QUIET = SensorChain(noise_p_m=0.0, noise_u_m=0.0, noise_f_n=0.0, resolution_p_m=0.0, resolution_u_m=0.0)


@cache
def hit(axis: str, loop: str = "open", speed: float = 0.0, mass: float = 2.18, seed: int = 1, noisy: bool = True):
    sensors = {} if noisy else {"sensors": QUIET}
    machine = Machine.from_parameters(MODEL.key_parameters(6.0, speed), MODEL.actuators, moving_mass=mass, **sensors)
    times = [0.1 + 0.25 * i + i * 7.3e-5 if noisy else 0.2 + 0.3 * i for i in range(3 if noisy else 2)]
    hammer = Hammer(tuple(Impact.along(axis, t, 12.0) for t in times), 0.85 if noisy else 1.1)
    options = {"conditions": {"pressure_bar": 6.0, "speed_rpm": speed}, "seed": seed, "name": f"{axis}_{loop}"}
    controller = None
    if loop == "closed":
        zero = record(machine, Stationary(0.3), **options).signal("p").mean(axis=0)
        controller = SampledController(SAMPLED.A, SAMPLED.B, SAMPLED.C, SAMPLED.D, 2e-4, offset=zero)
    return record(machine, hammer, controller=controller, **options)


def off_by(computed, true) -> np.ndarray:
    """Deviations of four modal numbers in standard deviations."""
    estimate = np.column_stack([computed.frequency_hz, computed.damping]).ravel()
    return (estimate - np.array([v for mode in true for v in mode])) / np.sqrt(np.diag(computed.covariance))


def test_ringing_modes_are_those_a_impact_excites() -> None:
    """The two of the bearing among all that a loop has, wherever filters put theirs."""
    everything = close_loop(MODEL.plant_at(*POINT), PAPER).modes()
    assert len(everything) > 2
    np.testing.assert_allclose(ringing_modes(MODEL.plant_at(*POINT), PAPER), everything[:2])
    running = sampled_loop(exact_plant(MODEL, *POINT), PAPER)
    np.testing.assert_allclose(ringing_modes(exact_plant(MODEL, *POINT), SAMPLED), running.modes[:2], rtol=1e-9)
    plant = MODEL.at(*POINT)
    slow = LinearModel(  # a filter that rings at 40 Hz and is hardly coupled to the disc
        block_diag(plant.A, [[0, 251.0], [-251.0, -5.0]]),
        np.vstack([plant.B, np.zeros((2, 2))]),
        np.hstack([plant.C, np.zeros((2, 2))]),
        plant.D,
    )
    np.testing.assert_allclose(ringing_modes(slow, entry=_entry(slow.n_states)), plant.modes(), rtol=1e-9)


def _entry(n: int) -> np.ndarray:
    entry = np.zeros((n, 2))
    positions = [int(np.flatnonzero(row)[0]) for row in MODEL.at(*POINT).C]
    for j, place in enumerate(positions):
        entry[int(np.flatnonzero(MODEL.at(*POINT).A[place])[0]), j] = 1.0
    return entry


@pytest.mark.parametrize("mass", [2.18, 3.0])
@pytest.mark.parametrize("speed", [0.0, 2050.0])
def test_force_scaling_is_one_over_the_mass(mass: float, speed: float) -> None:
    for axis in "xy":
        validation = gbid.validate_impact(hit(axis, speed=speed, mass=mass), MODEL.at(6.0, speed))
        assert validation.force_scale == pytest.approx(1 / mass, abs=3.5 * validation.force_scale_std)
        assert validation.force_scale_std < 0.004 / mass
        assert validation.along_percent > 97
        assert validation.axis == axis
        assert validation.loop == "open loop"


def test_noise_of_the_hammer_alone_scatters_the_force_scaling_as_its_std_says() -> None:
    """A position without error, so that nothing but the force part is left: 20 draws give a std to 16 %."""
    response = impact_response(MODEL.plant_at(*POINT), PAPER, HalfSine(12.0, 2e-3, 1.0), duration_s=0.12)
    step = np.maximum(10 * np.arange(600) - 503, 0)
    p, f, rng = response.p[step], response.force_n[step], np.random.default_rng(4)
    results = []
    for i in range(20):
        force = np.column_stack([f + 0.3 * rng.standard_normal(600), 0.3 * rng.standard_normal(600)])
        recording = gbid.Recording({"p": p, "f": force}, 2e-4, name=f"draw {i}")
        results.append(gbid.validate_impact(recording, MODEL.plant_at(*POINT), PAPER))
    scatter = np.std([q.force_scale for q in results], ddof=1)
    assert np.mean([q.force_scale_std for q in results]) == pytest.approx(scatter, rel=0.4)


def test_closed_loop_as_it_runs_explains_the_impact_and_the_continuous_one_does_less() -> None:
    """What the sampling and one sample of computation change is far beyond the noise."""
    running = gbid.validate_impact(hit("x", "closed"), exact_plant(MODEL, *POINT), SAMPLED)
    assert running.force_scale == pytest.approx(1 / 2.18, abs=3.5 * running.force_scale_std)
    assert running.along_percent > 98
    continuous = gbid.validate_impact(hit("x", "closed"), MODEL.plant_at(*POINT), PAPER)
    assert continuous.along_percent < 90
    early = gbid.validate_impact(hit("x", "closed"), exact_plant(MODEL, *POINT), SAMPLED, computation_s=0.0)
    assert early.along_percent < running.along_percent - 1


def test_continuous_loop_is_that_of_the_half_sine() -> None:
    """A noise-free force, one impact: the interpolated force against the half-sine itself, stepped ten times finer."""
    response = impact_response(MODEL.plant_at(*POINT), PAPER, HalfSine(12.0, 2e-3, 1.0), duration_s=0.12)
    step = np.maximum(10 * np.arange(600) - 503, 0)  # of 20 us, since an impact between two samples
    p, f = 0.4 * response.p[step], response.force_n[step]
    rec = gbid.Recording({"p": p + 1e-6, "f": np.column_stack([f, 0 * f])}, 2e-4, name="smooth")
    validation = gbid.validate_impact(rec, MODEL.plant_at(*POINT), PAPER)
    assert validation.force_scale == pytest.approx(0.4, rel=2e-4)
    np.testing.assert_allclose(validation.simulated, p, atol=3e-4 * np.abs(p).max())
    assert validation.along_percent > 99.9


def test_ring_downs_agree_with_the_true_machine() -> None:
    """Open loop with the bearing's modes; closed with those of the sampled loop, exact delays, unbalance left in."""
    speed = 2050.0
    opened = gbid.fit_ringdown([hit(axis, speed=speed) for axis in "xy"])
    assert (np.abs(off_by(opened, MODEL.at(6.0, speed).modes())) < 4).all()
    assert not opened.lag_rates.size
    assert opened.frequency_std.max() < 0.03
    closed = gbid.fit_ringdown([hit(axis, "closed", speed) for axis in "xy"])
    true = ringing_modes(exact_plant(MODEL, 6.0, speed), SAMPLED)
    assert (np.abs(off_by(closed, true)) < 4).all()
    assert closed.damping_std.max() < 0.02
    plain = gbid.fit_ringdown([hit(axis, "closed", speed) for axis in "xy"], lags=0)
    assert np.abs(off_by(plain, true)).max() > 10  # two modes alone, as in the paper, are biased in a loop


def test_study_round_trip(tmp_path) -> None:
    study = study_impacts([hit("x", "closed")], MODEL, PAPER, SAMPLED, lags=0, loop="soft")
    save(study, tmp_path / "study.h5")
    again = load(tmp_path / "study.h5", ImpactStudy)
    assert (again.loop, again.model, again.controller) == ("soft", MODEL.name, PAPER.name)
    assert (again.expected, again.figures) == (study.expected, study.figures)
    assert again.ringdown.modes() == study.ringdown.modes()
    np.testing.assert_array_equal(again.validations[0].simulated, study.validations[0].simulated)
    with pytest.raises(UsageError, match="exists"):
        save(study, tmp_path / "study.h5")


def test_bad_models() -> None:
    rec = hit("x")
    with pytest.raises(UsageError, match="has exact delays"):
        gbid.validate_impact(rec, exact_plant(MODEL, *POINT), PAPER)
    with pytest.raises(UsageError, match="is unstable"):
        gbid.validate_impact(rec, MODEL.plant_at(*POINT), p_controller(4.0, 4.0))
    with pytest.raises(UsageError, match="expected"):
        gbid.validate_impact(rec, MODEL.plant_at(*POINT), entry=np.zeros((3, 2)))
    single = gbid.Recording({"p": rec.signal("p")[:, :1], "f": rec.signal("f")}, 2e-4)
    with pytest.raises(DataError, match="an impact needs two"):
        gbid.validate_impact(single, MODEL.at(*POINT))
    still = replace(rec, signals={**rec.signals, "f": 0 * rec.signal("f")})
    with pytest.raises(DataError, match="no impact"):
        gbid.validate_impact(still, MODEL.at(*POINT))


YAML = """\
format: 1
name: hits
rig:
  operating_points: [{pressure_bar: 6.0, speed_rpm: 0}]
  prbs: {recordings: 0}
  stationary: {recordings: 0}
impacts:
  controller: paper
  operating_points: [{pressure_bar: 6.0, speed_rpm: 0}]
  repeats: 1
  spacing_s: 0.25
"""


def test_verb_makes_tables_and_files(tmp_path, capsys) -> None:
    path = write_quick(tmp_path, text=YAML)
    assert command("impact", path) == 0
    out = capsys.readouterr().out
    for words in (
        "natural frequencies",
        "damping factors",
        "expected from model",
        "obtained from the impacts",
        "126.3",
    ):
        assert words in out
    folder = tmp_path / "results" / "hits" / "impacts"
    with (folder / "impacts.csv").open() as file:
        lines = list(file)
    assert any(line.startswith("# content_key: ") for line in lines)
    rows = list(csv.DictReader(line for line in lines if not line.startswith("#")))
    assert [row["loop"] + row["mode"] for row in rows] == ["open1", "open2", "closed1", "closed2"]
    assert float(rows[2]["expected_damping"]) == pytest.approx(0.318, abs=5e-4)
    before = {file: file.stat().st_mtime_ns for file in folder.rglob("*.*")}
    assert len(before) == 8
    assert command("impact", path, "--json") == 0
    document = json.loads(capsys.readouterr().out)
    assert_keys("impacts", document)
    assert [d["name"] for d in document["impacts"]] == ["p6_n0_open", "p6_n0_closed"]
    assert document["impacts"][1]["published"]["measured"] == [[89.9, 0.658], [111.6, 0.446]]
    assert {o["state"] for o in document["outcomes"]} == {"kept"}
    assert {file: file.stat().st_mtime_ns for file in folder.rglob("*.*")} == before
    write_quick(tmp_path, ("repeats: 1", "repeats: 2"), text=YAML)
    assert command("impact", path) == 2
    assert "--overwrite" in capsys.readouterr().err


def test_controller_of_a_file_runs(tmp_path, capsys) -> None:
    save_controller(
        tmp_path / "mine.yaml", controller_structure("P"), {"kappa_x": 0.5, "kappa_y": 0.4}, sample_time=2e-4
    )
    path = write_quick(tmp_path, ("paper", "mine.yaml"), ("  repeats", "  loops: [closed]\n  repeats"), text=YAML)
    assert command("impact", path, "--json") == 0
    document = json.loads(capsys.readouterr().out)["impacts"][0]
    damping = [row["running_damping"] for row in document["modes"]]
    obtained = [row["obtained_damping"] for row in document["modes"]]
    np.testing.assert_allclose(obtained, damping, rtol=0.05)
    assert document["published"] == {}  # the paper ran another controller


@pytest.mark.parametrize(
    ("old", "new", "text"),
    [
        ("controller: paper", "controller: none.yaml", "none.yaml: no such controller file"),
        ("controller: paper", "controller: tuned", "no section 'controller'"),
        ("  repeats: 1", "  model: lpv", "there is no section 'lpv'"),
        ("  repeats: 1", "  model: nowhere", "nowhere"),
        ("speed_rpm: 0}]\n  repeats", "speed_rpm: 99999}]\n  repeats", "lies outside the domain"),
        ("spacing_s: 0.25", "spacing_s: 0.005", "too short for impacts"),
        ("spacing_s: 0.25", "impact_s: 0.0003", "less than 4 samples"),
        ("repeats: 1", "repeats: 0", "impacts.repeats"),
        ("controller: paper", "beside: {open: paper}", "'open' is reserved; choose another"),
        ("controller: paper", "beside: {closed: paper}", "choose another"),
        ("controller: paper", "beside: {a: none.yaml}", "none.yaml: no such controller file"),
        ("controller: paper", "beside: {a: 'tuned:q'}", "no section 'controller'"),
        ("controller: paper", "beside: {a/b: paper}", "impacts.beside"),
        ("controller: paper", "beside: {a: 3}", "impacts.beside.a"),
        ("controller: paper", "beside: [paper]", "impacts.beside"),
    ],
)
def test_bad_sections(tmp_path, capsys, old: str, new: str, text: str) -> None:
    path = write_quick(tmp_path, (old, new), text=YAML)
    assert command("check", path) == 2
    assert text in " ".join(capsys.readouterr().err.split())


def test_tuned_controller_that_is_not_there(tmp_path, capsys) -> None:
    path = write_quick(tmp_path, ("paper", "tuned"), text=f"{YAML}controller: {{feedback: {{}}}}\n")
    assert command("check", path) == 0
    assert command("impact", path) == 2
    assert "gbid tune" in capsys.readouterr().err


# ---- Further loops: each controller runs sampled on the rig, with figures of what an impact does.

BESIDE = "  controller: paper\n  loops: [closed]\n  beside: {soft: soft.yaml, follows: follows.yaml}\n"


def save_beside(folder) -> None:
    """Save a biquad, and a P controller whose gains follow the pressure."""
    soft = {"b0": 0.9, "b1": -0.5, "b2": -1.0, "frequency": 0.5, "damping": 0.7}
    gains = {f"{name}_{axis}": value for name, value in soft.items() for axis in "xy"}
    save_controller(folder / "soft.yaml", controller_structure("biquad"), gains, sample_time=2e-4)
    follows = scheduled(controller_structure("P"), ("1", "P"), MODEL.domain)
    rising = {q.name: 0.5 if q.name.endswith("_1") else 0.1 for q in follows.parameters}
    save_controller(folder / "follows.yaml", follows, rising, points=[POINT], sample_time=2e-4)


def test_further_loops_run_sampled_on_the_rig(tmp_path, capsys) -> None:
    save_beside(tmp_path)
    path = write_quick(tmp_path, ("  controller: paper\n", BESIDE), text=YAML)
    assert command("impact", path, "--json", "--engine", "serial") == 0
    document = json.loads(capsys.readouterr().out)
    studies = {d["loop"]: d for d in document["impacts"]}
    assert list(studies) == ["closed", "soft", "follows"]
    assert studies["soft"]["published"] == {}
    folder = tmp_path / "results" / "hits" / "impacts"
    assert (folder / "recordings" / "p6_n0_soft_x.h5").is_file()
    for loop in ("soft", "follows"):
        design = gbid.load_controller(tmp_path / f"{loop}.yaml")
        sampled = design.sampled_at(*POINT)
        expected = ringing_modes(exact_plant(MODEL, *POINT), sampled)
        for row, (frequency, damping) in zip(studies[loop]["modes"], expected, strict=True):
            assert row["running_frequency [Hz]"] == pytest.approx(frequency)
            assert row["running_damping"] == pytest.approx(damping)
        # what ran on the rig is the sampled controller: its r follows from the p that it measured
        rec = gbid.load_recording(folder / "recordings" / f"p6_n0_{loop}_x.h5")
        A, B, C, D = (np.array(m) for m in (sampled.A, sampled.B, sampled.C, sampled.D))
        p = rec.signal("p") - rec.signal("p")[:900].mean(axis=0)
        x, r = np.zeros(len(A)), np.zeros_like(p)
        for k in range(len(p) - 1):
            r[k + 1] = C @ x + D @ p[k]
            x = A @ x + B @ p[k]
        after = slice(950, 1200)
        assert np.abs((r - rec.signal("r"))[after]).max() < 0.05 * np.abs(rec.signal("r")).max()
    assert command("impact", path) == 0
    out = capsys.readouterr().out
    for words in ("6 bar, 0 rpm: soft", "6 bar, 0 rpm: follows", "piezo up to"):
        assert words in out


def test_a_further_loop_without_its_controller_leaves_the_others(tmp_path, capsys) -> None:
    text = (
        YAML.replace("  controller: paper\n", "  loops: [open]\n  beside: {best: tuned}\n")
        + "controller: {feedback: {}}\n"
    )
    path = write_quick(tmp_path, text=text)
    assert command("impact", path, "--json") == 3
    captured = capsys.readouterr()
    assert "impact best: " in captured.err
    assert "`gbid tune` makes it" in captured.err
    document = json.loads(captured.out)
    assert [d["loop"] for d in document["impacts"]] == ["open"]


@cache
def study(loop: str):
    """Hits of both axes of a rig whose sensors have no noise."""
    recordings = [hit(axis, loop, noisy=False) for axis in "xy"]
    return study_impacts(recordings, MODEL, *((PAPER, SAMPLED) if loop == "closed" else ()), lags=0)


@pytest.mark.parametrize("loop", ["open", "closed"])
def test_figures_of_impacts_are_those_of_the_rig(loop: str) -> None:
    # the rig integrates disc and stacks by itself, step by step; the other side is the model's sampled loop
    for computed, axis in zip(study(loop).figures, "xy", strict=True):
        assert computed.peak_m == pytest.approx(computed.peak_simulated_m, rel=0.01)
        assert computed.decay_s == pytest.approx(computed.decay_simulated_s, rel=0.01)
        assert computed.piezo_m == pytest.approx(computed.piezo_simulated_m, rel=0.01, abs=1e-9)
        assert computed.peak_std_m < 0.01 * computed.peak_m
        u = hit(axis, loop, noisy=False).signal("u")
        assert computed.piezo_m == pytest.approx(np.abs(u - u[:900].mean(axis=0)).max() / 2, rel=0.01, abs=1e-9)
    assert (computed.piezo_m > 5e-6) == (loop == "closed")


def test_figures_without_a_signal_of_the_piezos_are_not_there() -> None:
    rec = hit("x", "closed", noisy=False)
    bare = gbid.Recording({n: v for n, v in rec.signals.items() if n not in ("u", "r")}, 2e-4, rec.conditions)
    result = study_impacts([bare], MODEL, PAPER, SAMPLED, lags=0).figures[0]
    assert np.isnan(result.piezo_m)
    assert result.piezo_simulated_m == pytest.approx(study("closed").figures[0].piezo_simulated_m, rel=1e-3)


def test_loops_are_averaged_over_their_impacts() -> None:
    data = report.impact_loops_data({loop: study(loop) for loop in ("open", "closed")}, duration_s=0.04)
    assert data.time[0] == pytest.approx(-5e-3)
    assert data.time[-1] == pytest.approx(0.04 - 2e-4)
    for word in ("open", "closed"):
        p = hit("x", word, noisy=False).signal("p")[:, 0]
        start = study(word).validations[0].windows[0][0]
        first = p[start - 25 : start + 200] - p[:900].mean()
        np.testing.assert_allclose(data.mean[word][:, 0], first, atol=2e-7)
        assert data.spread[word].max() < 2e-7
    assert report.plot_impact_loops(data) is not None
    with pytest.raises(UsageError, match="must have the same operating point"):
        report.impact_loops_data({})
