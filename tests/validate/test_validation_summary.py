"""Many models on many recordings against one by one, their summary, and how it is stored."""

from dataclasses import replace

import numpy as np
import pytest
from fit_cases import MODE, MODE_AT, levels, simulated
from rig_point import machine

from gbid import load, save
from gbid.core.errors import DataError, UsageError
from gbid.core.tables import write_csv
from gbid.identify import fit
from gbid.identify.data import select
from gbid.rig import Prbs, record
from gbid.structure import PiezoPair, Plant, RotorBearing
from gbid.validate import (
    ValidationScores,
    ValidationSummary,
    check_residuals,
    cross_validate,
    cross_validate_many,
    fit_percent,
    summarise,
)
from gbid.validate.central import summary_csv_table


@pytest.fixture(scope="module")
def recordings():
    point = {"pressure_bar": 5.0, "speed_rpm": 6000.0}
    return [record(machine(), Prbs(0.3), conditions=point, seed=i, name=f"r{i}") for i in range(3)]


def with_mean_removed(rec):
    return rec.with_signals(**{name: v - v.mean(axis=0) for name, v in rec.signals.items()})


def plainly(result, recording, left_out=()):
    """Least squares over simulations from each unit state and over the terms of trend and hum of each output."""
    u, y = (select(recording, wanted)[0] for wanted in (result.options.inputs, result.options.outputs))
    kept = np.ones(len(y), bool)
    for start, stop in left_out:
        kept[start:stop] = False

    def run(inputs, state):
        return result.model.simulate(
            inputs, recording.sample_time, initial_state=state, intersample=result.options.intersample
        )

    n = result.model.n_states
    columns = [run(0 * u, unit) for unit in np.eye(n)]
    disturbances, t = result.disturbances, recording.time
    courses = [t**power for power in range(disturbances.n_polynomials)]
    courses += [wave(2 * np.pi * f * t) for f in disturbances.hum for wave in (np.cos, np.sin)]
    columns += [np.outer(course, unit) for course in courses for unit in np.eye(y.shape[1])]
    free = np.stack(columns, axis=2)
    size = np.linalg.norm(free[kept].reshape(-1, free.shape[2]), axis=0)
    from_rest = run(u, np.zeros(n))
    solution = np.linalg.lstsq((free[kept] / size).reshape(-1, len(size)), (y - from_rest)[kept].ravel(), rcond=None)[0]
    simulated = from_rest + (free / size) @ solution
    norm = np.abs(y - simulated)[kept].max(axis=0)
    return fit_percent(y[kept], simulated[kept]), norm, simulated, (solution / size)[:n]


# ---- many, one by one, and plain least squares ----


@pytest.mark.parametrize(
    ("structure", "options"),
    [
        (PiezoPair(), {}),
        (PiezoPair(), {"trend": "offset"}),
        (PiezoPair(), {"trend": 3, "hum": [50.0, 131.0]}),
        (RotorBearing(), {"max_iterations": 1}),
        (RotorBearing(), {"intersample": "zoh", "focus": "simulation", "max_iterations": 1}),
        (Plant(RotorBearing(delay="exact", disturbance_gain="none")), {"stop": "paper", "max_iterations": 1}),
    ],
    ids=["piezos", "offsets", "trend and hum", "bearing", "held", "exact delay"],
)
def test_many_at_once_agree_with_one_by_one(recordings, structure, options):
    data = [with_mean_removed(rec) for rec in recordings]
    results = [fit(structure, rec, **options) for rec in data[:2]]
    scores = cross_validate_many(results, data)
    pairs = ((0, 1), (0, 2), (1, 0), (1, 2))
    assert list(zip(scores.models, scores.recordings, strict=True)) == [(f"r{i}", f"r{j}") for i, j in pairs]
    ones = [cross_validate(results[i], data[j]) for i, j in pairs]
    np.testing.assert_allclose(scores.fit_percent, [v.fit_percent for v in ones], rtol=0, atol=1e-9)
    np.testing.assert_allclose(scores.infinity_norm, [v.infinity_norm for v in ones], rtol=1e-9)
    for (i, j), one in zip(pairs, ones, strict=True):
        fit_of, norm, response, state = plainly(results[i], data[j])
        np.testing.assert_allclose(one.fit_percent, fit_of, rtol=0, atol=1e-9)
        np.testing.assert_allclose(one.infinity_norm, norm, rtol=1e-8)
        np.testing.assert_allclose(one.simulated, response, rtol=0, atol=1e-9 * np.abs(response).max())
        np.testing.assert_allclose(one.initial_state, state, rtol=1e-5, atol=1e-7 * np.abs(state).max())
    assert scores.output_names == ones[0].output_names
    np.testing.assert_array_equal(scores.pressure_bar, 5.0)


def test_repeated_poles_are_no_obstacle(recordings):
    """Two equal poles have no eigenvectors of their own: the modes cannot be run apart."""
    result = fit(PiezoPair(), recordings[0])
    A = np.array(result.model.A)
    A[1] = [-A[0, 0] * -1.0, A[0, 0], 0, 0]  # the fast pole of x made equal to the slow one
    double = result.changed(model=replace(result.model, A=A))
    scores, one = cross_validate_many([double], recordings[1:2]), cross_validate(double, recordings[1])
    np.testing.assert_allclose(scores.fit_percent[0], one.fit_percent, atol=1e-9)


def test_no_pair_is_refused(recordings):
    with pytest.raises(DataError, match="no pair"):
        cross_validate_many([fit(PiezoPair(), recordings[0])], recordings[:1])


# ---- stretches left out ----


def test_stretches_left_out_do_not_count():
    """Rubbish in the outputs of a stretch changes nothing once it is left out, before and beside its fit."""
    result = fit(MODE, simulated(MODE, MODE_AT, levels(400), name="first"), focus="simulation")
    clean = simulated(MODE, MODE_AT, levels(600, seed=3), x0=[1.0, 2.0], name="b")
    y = clean.signal("y").copy()
    y[100:160], y[0:20] = 1e3, -1e3
    bad, left_out = clean.with_signals(y=y), [(100, 160), (0, 20)]
    validation = cross_validate(result, bad, left_out)
    assert validation.fit_percent[0] == pytest.approx(100, abs=1e-2)
    np.testing.assert_allclose(validation.simulated, plainly(result, bad, left_out)[2], rtol=0, atol=1e-8)
    np.testing.assert_allclose(validation.initial_state, [1.0, 2.0], rtol=1e-3)
    assert validation.simulated.shape == validation.measured.shape == (600, 1)
    assert cross_validate(result, bad).fit_percent[0] < 50
    kept = np.r_[20:100, 160:600]
    expected = 100 * (
        1 - np.linalg.norm(y[kept] - validation.simulated[kept]) / np.linalg.norm(y[kept] - y[kept].mean())
    )
    assert validation.fit_percent[0] == pytest.approx(expected, rel=1e-12)
    assert check_residuals(result, bad, 20, left_out).infinity_norm[0] < 1e-2 < check_residuals(result, bad, 20).rms[0]


def test_offsets_are_those_of_the_samples_that_count(recordings):
    result = fit(PiezoPair(), recordings[0], trend="offset")
    signal = result.options.outputs[0]
    wrong = recordings[1].signal(signal).copy()
    wrong[500:900] += 10 * np.ptp(wrong, axis=0)
    bad, left_out = recordings[1].with_signals(**{signal: wrong}), [(500, 900)]
    validation = cross_validate(result, bad, left_out)
    percent, norm, response, _ = plainly(result, bad, left_out)
    np.testing.assert_allclose(validation.simulated, response, rtol=0, atol=1e-8 * np.abs(response).max())
    np.testing.assert_allclose(validation.fit_percent, percent, rtol=0, atol=1e-8)
    np.testing.assert_allclose(validation.infinity_norm, norm, rtol=1e-7)


@pytest.mark.parametrize("stretch", [(-1, 5), (5, 5), (590, 601), (0, 600)])
def test_stretches_beyond_the_recording_are_refused(stretch):
    result = fit(MODE, simulated(MODE, MODE_AT, levels(400)), focus="simulation")
    with pytest.raises(DataError, match=r"left[ _]out"):
        cross_validate(result, simulated(MODE, MODE_AT, levels(600, seed=3)), [stretch])


# ---- the summary ----


def some_scores(n=40, seed=0):
    random = np.random.default_rng(seed)
    return ValidationScores(
        tuple(f"m{i % 8}" for i in range(n)),
        tuple(f"r{i}" for i in range(n)),
        np.repeat([6.0, 3.0], n // 2),
        np.tile([0.0, 4000.0], n // 2),
        ("p_x", "p_y"),
        ("m", "m"),
        np.column_stack([random.normal(81, 2.7, n), random.normal(85, 3.4, n)]),
        random.uniform(1e-6, 5e-6, (n, 2)),
    )


def test_summary_is_that_of_numpy():
    scores = some_scores()
    summary = summarise(scores, bins=8, worst=2)
    assert (summary.n_pairs, summary.n_models, summary.n_recordings) == (40, 8, 40)
    np.testing.assert_allclose(summary.mean, scores.fit_percent.mean(0))
    np.testing.assert_allclose(summary.std, scores.fit_percent.std(0, ddof=1))
    np.testing.assert_allclose(summary.infinity_norm_max, scores.infinity_norm.max(0))
    np.testing.assert_array_equal(summary.counts.sum(axis=1) + summary.below, [40, 40])
    assert summary.counts.shape == (2, 8)
    assert summary.edges.shape == (2, 9)
    order = np.argsort(scores.fit_percent[:, 1])
    assert [w.recording for w in summary.worst if w.output == "p_y"] == [f"r{i}" for i in order[:2]]
    assert [(p.pressure_bar, p.speed_rpm) for p in summary.points] == [(3, 0), (3, 4000), (6, 0), (6, 4000)]
    rows = (scores.pressure_bar == 3) & (scores.speed_rpm == 4000)
    np.testing.assert_allclose(summary.points[1].mean, scores.fit_percent[rows].mean(0))
    assert sum(p.n_pairs for p in summary.points) == 40


def test_one_hopeless_model_does_not_flatten_the_histogram():
    scores = some_scores()
    fit = scores.fit_percent.copy()
    fit[3, 0] = -4e4
    summary = summarise(replace(scores, fit_percent=fit))
    assert summary.below.tolist() == [1, 0]
    assert summary.edges[0, 0] > 50
    assert summary.least[0] == -4e4
    assert summary.worst[0].model == "m3"


def test_points_that_are_not_known_are_one():
    nowhere = np.full(40, np.nan)
    summary = summarise(replace(some_scores(), pressure_bar=nowhere, speed_rpm=nowhere))
    assert [p.n_pairs for p in summary.points] == [40]


def test_equal_fits_and_single_pairs():
    scores = some_scores(2)
    same = summarise(replace(scores, fit_percent=np.full((2, 2), 99.0)))
    np.testing.assert_array_equal(same.std, 0)
    assert same.counts.sum() == 4
    np.testing.assert_allclose(same.edges[:, [0, -1]], [[98.5, 99.5]] * 2)
    poor = np.array([[-1e6, -1e6], [-1e6 + 1e-4, -1e6 + 1e-4]])  # equal up to rounding
    assert np.ptp(summarise(replace(scores, fit_percent=poor)).edges) == pytest.approx(1.0, abs=1e-3)
    assert np.isnan(summarise(some_scores(2)).points[0].std).all()
    with pytest.raises(UsageError, match="bins = 0"):
        summarise(scores, bins=0)
    with pytest.raises(DataError, match="nothing to summarise"):
        summarise(replace(scores, models=()))


def test_summary_comes_back_as_it_was(tmp_path):
    summary = summarise(some_scores(), failed=["m1 on r2: not there"])
    save(summary, tmp_path / "a.h5")
    back = load(tmp_path / "a.h5", ValidationSummary)
    for name in ("mean", "std", "edges", "counts", "below", "infinity_norm_max", "median"):
        np.testing.assert_array_equal(getattr(back, name), getattr(summary, name))
    assert back.worst == summary.worst
    assert back.failed == summary.failed
    assert (back.n_pairs, back.output_names, back.output_units) == (40, ("p_x", "p_y"), ("m", "m"))
    for one, other in zip(back.points, summary.points, strict=True):
        assert (one.pressure_bar, one.speed_rpm, one.n_pairs) == (other.pressure_bar, other.speed_rpm, other.n_pairs)
        np.testing.assert_array_equal(one.mean, other.mean)
    with pytest.raises(UsageError, match="exists already"):
        save(summary, tmp_path / "a.h5")
    write_csv(summary_csv_table(summary), tmp_path / "a.csv")
    lines = (tmp_path / "a.csv").read_text().splitlines()
    assert lines[1] == "pressure_bar,speed_rpm,output,pairs,mean,std,infinity_norm,unit"
    assert lines[2].startswith(f"all,all,p_x,40,{summary.mean[0]!r},".replace("np.float64(", "").replace(")", ""))
    assert len(lines) == 2 + 2 * 5
