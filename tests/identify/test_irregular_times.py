"""Samples at irregular times: fits, simulations and predictions go from each time to the next exactly."""

import json

import casadi as ca
import numpy as np
import pytest
from experiment_files import gbid as cli
from fit_cases import assert_derivatives

import gbid
from gbid import LinearModel, NonlinearStructure, Parameter, Recording
from gbid.core.errors import DataError, GbidError, UsageError
from tests.benchmarks.running import DOCS
from tests.benchmarks.time_coverage import (
    CASES,
    MEAN_STEP,
    TRUTH,
    Case,
    ratios,
    recording,
    step_matrix,
    structure,
    times,
)

A = np.array([[0, 1], [-(TRUTH["w"] ** 2), -2 * TRUTH["z"] * TRUTH["w"]]])
B, C, K = np.array([[0], [TRUTH["g"]]]), np.array([[1.0, 0.0]]), np.array([[TRUTH["k1"]], [TRUTH["k2"]]])


def made(clock, seed, hold="zoh", n=500, errors="white"):
    return recording(Case(clock, 0.0, hold, errors), seed, n)[0]


@pytest.mark.parametrize("hold", ["zoh", "foh"])
def test_simulation_and_prediction_are_exact(hold):
    rec, e = recording(Case("jitter", 0.0, hold, "fed back"), 1, 200)
    u, y = rec.signals["u"], rec.signals["y"]
    model = LinearModel(A, B, C, [[0]], K, intersample=(hold,))
    np.testing.assert_allclose((y - model.predict(u, y, rec.stamps))[:, 0], e, atol=1e-10)
    rec, e = recording(Case("two loggers", 0.0, hold, "white"), 1, 200)
    u, y = rec.signals["u"], rec.signals["y"]
    np.testing.assert_allclose((y - model.simulate(u, rec.stamps))[:, 0], e, atol=1e-10)
    even = np.arange(len(u)) * MEAN_STEP
    np.testing.assert_allclose(model.simulate(u, even), model.simulate(u, MEAN_STEP), atol=1e-10)


QUICK = [(case, 3) for case in CASES if case.errors != "Wiener" and case.clock != "even"]
SLOW = [pytest.param(case, 40, marks=pytest.mark.slow) for case in CASES if case.errors != "Wiener"]


@pytest.mark.parametrize(("case", "seeds"), [*QUICK, *SLOW])
def test_intervals_cover(case, seeds):
    """Of w, z and g; 9 and 120 ratios exceed the limits with less than 0.1 % (chi-square)."""
    errors, failed = ratios(case, seeds)
    assert not failed
    assert np.sqrt(np.square(errors).mean()) < {3: 2.0, 40: 1.25}[seeds]


def test_the_page_shows_what_was_measured():
    """The figures of the page: with a tenth of the samples missing as many intervals contain the truth as without."""
    run = json.loads((DOCS / "time_coverage.json").read_text(encoding="utf-8"))
    covered = {Case(*(row[key] for key in Case._fields)): row["covered"] for row in run["rows"]}
    assert set(covered) == set(CASES)
    assert not any(row["failed"] for row in run["rows"])
    assert min(share for case, share in covered.items() if case.errors == "white") > 0.92
    for errors in ("white", "fed back"):
        whole, lost = (covered[Case("even", share, "zoh", errors)] for share in (0.0, 0.1))
        assert lost > whole - 0.03


@pytest.mark.parametrize("focus", ["simulation", "prediction"])
def test_even_times_give_the_fit_at_even_times(focus):
    rec = made("jitter", 5, n=300, errors="fed back" if focus == "prediction" else "white")
    u, y, even = rec.signals["u"], rec.signals["y"], np.arange(300) * MEAN_STEP
    assert Recording({"u": u}, stamps=even + 4.0).stamps is None
    even[-1] += 1e-6  # otherwise they are even
    one = gbid.fit(structure(), Recording({"u": u, "y": y}, MEAN_STEP), focus=focus)
    other = gbid.fit(structure(), Recording({"u": u, "y": y}, stamps=even), focus=focus)
    for name in one.free:
        assert other.parameters[name] == pytest.approx(one.parameters[name], abs=1e-3 * one.std[name])
        assert other.std[name] == pytest.approx(one.std[name], rel=1e-3)
    assert other.log_likelihood == pytest.approx(one.log_likelihood, abs=1e-3)


def test_derivatives_are_those_of_the_cost():
    rec = made("jitter", 2, "foh", 300, errors="fed back")
    lost = np.where(np.arange(300) % 7 == 3, np.nan, rec.signals["y"][:, 0])
    problem = gbid.identify.fit_problem(structure(), rec.with_signals(y=lost), intersample="foh", trend="linear")
    assert_derivatives(problem, 9)


def test_the_likelihood_with_missing_outputs_is_that_of_a_kalman_filter():
    rec = made("jitter", 3, n=300, errors="fed back")
    y = np.where(np.random.default_rng(0).random(300) < 0.15, np.nan, rec.signals["y"][:, 0])
    result = gbid.fit(structure(), rec.with_signals(y=y), focus="prediction")
    p, cov = result.parameters, float(result.error_covariance[0, 0])
    x, P, total, u = result.initial_states[0], np.zeros((2, 2)), 0.0, rec.signals["u"][:, 0]
    for k, step in enumerate(np.diff(rec.stamps, append=rec.stamps[-1] + MEAN_STEP)):
        M = step_matrix(p, step)
        F, gain, L = M[:2, :2], M[:2, 4], np.zeros(2)
        across, e = F @ P[:, 0] + gain * cov, 0.0
        if not np.isnan(y[k]):
            S, e = P[0, 0] + cov, y[k] - x[0]
            total -= 0.5 * (e**2 / S + np.log(2 * np.pi * S))
            L = across / S
        x = F @ x + M[:2, 2] * u[k] + L * e
        P = F @ P @ F.T + np.outer(gain, gain) * cov - np.outer(L, across)
    assert result.success
    assert result.log_likelihood == pytest.approx(total, abs=0.05)


@pytest.mark.parametrize("hold", ["zoh", "foh"])
def test_two_loggers_in_one_file(tmp_path, hold):
    """The input and the output have times of their own; the input is held, or on a line, at times of the output."""
    time = times("two loggers", 0, 500)
    ours = np.isin(np.round(time, 6), np.round(np.arange(0, 15, 0.05), 6)) | (time == time[-1])  # times of the input
    random = np.random.default_rng(7)
    u = random.choice([-1.0, 1.0], len(time)) if hold == "zoh" else random.standard_normal(len(time))
    last = np.maximum.accumulate(np.where(ours, np.arange(len(time)), 0))
    u = u[last] if hold == "zoh" else np.interp(time, time[ours], u[ours])
    model = LinearModel(A, B, C, [[0]], intersample=(hold,))
    x, y = np.zeros(2), np.empty(len(time))
    for k in range(len(time)):
        y[k] = x[0] + 0.01 * random.standard_normal()
        if k + 1 < len(time):
            step = time[k + 1] - time[k]
            slope = (u[k + 1] - u[k]) / step if hold == "foh" else 0.0
            x = (step_matrix(TRUTH, step) @ [*x, u[k], slope, 0.0])[:2]
    path, cell = tmp_path / "a.csv", "{:.9g}".format
    rows = zip(time, u, y, ours, strict=True)
    path.write_text(
        "t,u,y\n" + "".join(f"{t:.6f},{cell(a) if i else ''},{'' if i else cell(b)}\n" for t, a, b, i in rows)
    )
    volts = {"unit": "V", "stored_unit": "V"}
    kept = {"hold": True} if hold == "zoh" else {"interpolate": True}
    signals = {"u": {"columns": ["u"], **kept, **volts}, "y": {"columns": ["y"], **volts}}
    rec = gbid.import_recording(path, {"signals": signals, "time": "t", "gaps": "missing"})
    np.testing.assert_allclose(rec.signals["u"][:, 0], u, atol=1e-8)
    assert np.isnan(rec.signals["y"][ours]).all()
    assert "the times are kept as they are" in rec.provenance["import_remarks"]
    result = gbid.fit(structure(), rec, focus="simulation", intersample=hold)
    assert result.success
    for name in ("w", "z", "g"):
        assert abs(result.parameters[name] - TRUTH[name]) < 4 * result.std[name]
        assert result.std[name] < 0.01 * TRUTH[name]
    assert np.nanstd(rec.signals["y"] - model.simulate(rec.signals["u"], rec.stamps)) < 0.015
    validation = gbid.cross_validate(result, rec)
    assert validation.fit_percent[0] == pytest.approx(result.fit_percent[0, 0], abs=0.2)
    np.testing.assert_array_equal(validation.time, rec.stamps)
    counted = ~ours
    error = (validation.measured - validation.simulated)[counted]
    assert error.std() == pytest.approx(0.01, rel=0.2)


def test_recordings_of_different_rates_are_fitted_together_and_validated_at_another():
    random, model = np.random.default_rng(3), LinearModel(A, B, C, [[0]], intersample=("foh",))
    even = []
    for step in (0.02, 0.05):
        u = random.standard_normal(400)
        y = model.simulate(u, step)[:, 0] + 0.02 * random.standard_normal(400)
        even.append(Recording({"u": u, "y": y}, step, name=f"{step}"))
    result = gbid.fit(structure(), [even[0], made("jitter", 1, "foh")], focus="simulation", intersample="foh")
    assert result.success
    for name in ("w", "z", "g"):
        assert abs(result.parameters[name] - TRUTH[name]) < 4 * result.std[name]
    validation = gbid.cross_validate(result, even[1])
    assert (validation.measured - validation.simulated).std() == pytest.approx(0.02, rel=0.2)
    assert len(result.bode().frequency_hz) > 50


EXPERIMENT = """\
format: 1
name: irregular
title: Samples at irregular times
results: results
import:
  data_folder: data
  recordings:
    - &file
      name: one
      file: one.csv
      time: t
      time_unit: s
      gaps: missing
      signals: {u: {columns: [u], unit: V, stored_unit: V}, y: {columns: [y], unit: mm, stored_unit: mm}}
    - {<<: *file, name: two, file: two.csv}
fits:
  mode: {structure: structure.py:made, focus: simulation, intersample: foh, left_out: {one: [[2.0, 3.0]]}}
crossval: {mode: {on: cyclic, minimum_percent: 90}}
figures: {mode: {from_s: 2.0, to_s: 4.0, residuals: true}}
"""


STRUCTURE = """\
import casadi as ca
from gbid import LinearStructure, Parameter


def matrices(p):
    A = ca.vertcat(ca.horzcat(0, 1), ca.horzcat(-(p.w**2), -2 * p.z * p.w))
    return {"A": A, "B": ca.vertcat(0, p.g), "C": ca.DM([[1.0, 0.0]])}


made = LinearStructure("mode", [Parameter("w", 9.0), Parameter("z", 0.1), Parameter("g", 80.0)], matrices, "u", "y")
"""


def test_from_a_file_through_yaml_to_a_page(tmp_path):
    (tmp_path / "data").mkdir()
    recordings = [made("jitter", seed, "foh", 400) for seed in (1, 2)]
    for name, rec in zip(("one", "two"), recordings, strict=True):
        rows = zip(rec.stamps, rec.signals["u"][:, 0], rec.signals["y"][:, 0], strict=True)
        (tmp_path / "data" / f"{name}.csv").write_text(
            "t,u,y\n" + "".join(f"{t:.12f},{u:.12g},{y:.12g}\n" for t, u, y in rows)
        )
    (tmp_path / "structure.py").write_text(STRUCTURE)
    (tmp_path / "experiment.yaml").write_text(EXPERIMENT)
    for verb in ("check", "run"):
        assert cli(verb, tmp_path / "experiment.yaml") == 0
    stored = gbid.load(tmp_path / "results" / "fits" / "mode" / "one.h5")
    count = [int(np.searchsorted(recordings[0].time, t)) for t in (2.0, 3.0)]
    again = gbid.fit(structure(), recordings[0], focus="simulation", intersample="foh", left_out={"s1": [tuple(count)]})
    for name in ("w", "z", "g"):
        assert stored.parameters[name] == pytest.approx(again.parameters[name], abs=0.01 * again.std[name])
        assert abs(stored.parameters[name] - TRUTH[name]) < 4 * stored.std[name]
    assert (tmp_path / "results" / "figures" / "mode_one_on_two_residuals.png").exists()


def test_a_nonlinear_structure_takes_irregular_times_in_the_compiled_pass():
    def dynamics(x, u, p):
        return ca.vertcat(x[1], -(p.w**2) * x[0] - 2 * p.z * p.w * x[1] + p.g * u[0])

    parameters = [Parameter("w", 9.0), Parameter("z", 0.1), Parameter("g", 80.0)]
    nonlinear = NonlinearStructure("mode", parameters, ["x", "v"], dynamics, lambda x, u, p: x[0], ["u"], ["y"])
    rec = made("jitter", 4, "foh")
    one, other = (gbid.fit(s, rec, focus="simulation", intersample="foh") for s in (nonlinear, structure()))
    assert one.success
    for name in one.free:
        assert one.parameters[name] == pytest.approx(other.parameters[name], abs=0.1 * other.std[name])
        assert one.std[name] == pytest.approx(other.std[name], rel=0.01)
    x0 = one.initial_states[0]
    simulated = one.model.simulate(rec.signals["u"], rec.stamps, initial_state=x0)
    assert np.std(rec.signals["y"] - simulated) == pytest.approx(np.sqrt(one.loss), rel=1e-3)


def test_what_a_recording_keeps(tmp_path):
    rec = made("lost and jitter", 1)
    gbid.save_recording(rec, tmp_path / "a.h5")
    again = gbid.load_recording(tmp_path / "a.h5")
    np.testing.assert_array_equal(again.stamps, rec.stamps)
    assert again.sample_time == pytest.approx(rec.stamps[-1] / (rec.n_samples - 1))
    part = rec.slice(100, 200)
    np.testing.assert_allclose(part.stamps, rec.stamps[100:200] - rec.stamps[100])
    assert "irregular times" in repr(rec)
    holes = rec.with_signals(u=np.where(np.arange(rec.n_samples) % 3 == 1, np.nan, 2 * rec.time + 1))
    np.testing.assert_allclose(holes.slice(0, 400).interpolated("u").signals["u"][:, 0], 2 * rec.time[:400] + 1)


def test_what_cannot_take_irregular_times_says_so():
    rec = made("jitter", 1)
    with pytest.raises(DataError, match=r"stamps do not rise at sample 1: 0 s, 0 s"):
        Recording({"u": np.zeros(3)}, stamps=[0, 0, 1])
    with pytest.raises(DataError, match=r"stamps have shape \(2,\); give a time for each of 3"):
        Recording({"u": np.zeros(3)}, stamps=[0, 1])
    for use in (
        lambda: gbid.measured_response(rec, ["u"], ["y"]),
        lambda: gbid.subspace(rec, inputs=["u"], outputs=["y"]),
    ):
        with pytest.raises(DataError, match="has samples at irregular times; this function needs even times"):
            use()
    with pytest.raises(GbidError, match=r"errors='ar' needs every output sample.*at irregular times"):
        gbid.fit(structure(), rec, focus="simulation", errors="ar")
    late = gbid.LinearStructure(
        "late",
        [Parameter("a", 2.0), Parameter("tau", 0.01, 0.0)],
        lambda p: {"A": -p.a, "B_delayed": p.a, "C": 1, "delay": p.tau},
        inputs=["u"],
        outputs=["y"],
    )
    with pytest.raises(UsageError, match=r"'late': exact delays with samples at irregular times.*pade_order"):
        gbid.fit(late, rec, focus="simulation")
    controller = LinearModel([[-5.0]], [[1.0]], [[1.0]], [[0.0]])
    loop = gbid.ClosedLoop(structure(), controller, sample_time=MEAN_STEP)
    with pytest.raises(UsageError, match=r"a sampled controller with samples at irregular times"):
        gbid.fit(loop, rec, inputs="u", focus="simulation")
