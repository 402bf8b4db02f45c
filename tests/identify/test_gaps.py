"""Missing outputs: likelihood of an independent Kalman filter, derivatives, coverage, outputs at a lower rate."""

import casadi as ca
import numpy as np
import pytest
import scipy
from experiment_files import gbid as cli
from fit_cases import assert_derivatives

import gbid
from gbid import LinearStructure, Parameter, Recording
from gbid.core.errors import DataError, GbidError

STEP = 0.01
TRUTH = {"w": 10.0, "z": 0.08, "g": 100.0, "k1": 3.0, "k2": 8.0}


def structure(n_y=1):
    """Oscillator whose position is measured, and beside it its velocity."""

    def matrices(p):
        return {
            "A": ca.vertcat(ca.horzcat(0, 1), ca.horzcat(-(p.w**2), -2 * p.z * p.w)),
            "B": ca.vertcat(0, p.g),
            "C": ca.DM(np.diag([1.0, 0.1])[:n_y]),
            "K": ca.horzcat(ca.vertcat(p.k1, p.k2), ca.DM.zeros(2, n_y - 1)),
        }

    start = {"w": 9.0, "z": 0.1, "g": 80.0, "k1": 1.0, "k2": 1.0}
    names = [Parameter(name, value) for name, value in start.items()]
    return LinearStructure("oscillator", names, matrices, inputs=["u"], outputs=["y"])


def sampled(p, n_y=1):
    """Matrices of the sampled innovations model, by scipy."""
    A, B = np.array([[0, 1], [-(p["w"] ** 2), -2 * p["z"] * p["w"]]]), np.array([[0], [p["g"]]])
    K = np.column_stack([[p["k1"], p["k2"]], np.zeros((2, n_y - 1))])
    M = np.zeros((3 + n_y, 3 + n_y))
    M[:2] = np.hstack([A, B, K])
    M = scipy.linalg.expm(M * STEP)
    return M[:2, :2], M[:2, 2], M[:2, 3:], np.diag([1.0, 0.1])[:n_y]


def made(seed, n=1500, lost=0.1, n_y=1, every=1, gain=True):
    """Simulated recording: a share of the outputs lost at random, the last output measured every few samples."""
    random = np.random.default_rng(seed)
    F, G, K, C = sampled(TRUTH, n_y)
    u = np.repeat(random.choice([-1.0, 1.0], n // 10 + 1), 10)[:n]
    noise = 0.02 * random.standard_normal((n, n_y)) @ np.array([[1.0, 0.3], [0.0, 1.0]])[:n_y, :n_y]
    x, y = np.zeros(2), np.empty((n, n_y))
    for k in range(n):
        y[k] = C @ x + noise[k]
        x = F @ x + G * u[k] + gain * K @ noise[k]
    y[random.random((n, n_y)) < lost] = np.nan
    y[np.arange(n) % every > 0, -1] = np.nan
    return Recording({"u": u, "y": y}, STEP, name=f"s{seed}")


def kalman_log_likelihood(result, rec):
    """Log-likelihood of an innovations model by the textbook's filter, sample by sample."""
    y = rec.signals["y"]
    F, G, K, C = sampled(result.parameters, y.shape[1])
    K = K if result.options.focus == "prediction" else 0 * K
    cov, x, P, total = result.error_covariance, result.initial_states[0], np.zeros((2, 2)), 0.0
    for u, measured in zip(rec.signals["u"][:, 0], y, strict=True):
        measured_mask = ~np.isnan(measured)
        S = (C @ P @ C.T + cov)[np.ix_(measured_mask, measured_mask)]
        e = (measured - C @ x)[measured_mask]
        across = (F @ P @ C.T + K @ cov)[:, measured_mask]
        if measured_mask.any():
            total -= 0.5 * (
                e @ np.linalg.solve(S, e) + np.linalg.slogdet(S)[1] + measured_mask.sum() * np.log(2 * np.pi)
            )
        L = across @ np.linalg.inv(S)
        x = F @ x + G * u + L @ e
        P = F @ P @ F.T + K @ cov @ K.T - L @ across.T
    return total


@pytest.mark.parametrize(
    ("focus", "n_y", "every"),
    [
        ("prediction", 1, 1),
        ("simulation", 2, 5),
        pytest.param("prediction", 2, 1, marks=pytest.mark.slow),
        pytest.param("prediction", 2, 5, marks=pytest.mark.slow),
    ],
)
def test_the_likelihood_is_that_of_a_kalman_filter(focus, n_y, every):
    rec = made(2, 400, n_y=n_y, every=every, gain=focus == "prediction")
    result = gbid.fit(structure(n_y), rec, focus=focus)
    assert result.success
    assert result.log_likelihood == pytest.approx(kalman_log_likelihood(result, rec), abs=0.05)
    for name in result.free:
        assert abs(result.parameters[name] - TRUTH[name]) < 4 * result.std[name]


def test_derivatives_are_those_of_the_cost():
    problem = gbid.identify.fit_problem(structure(2), made(2, 300, n_y=2, every=3))
    assert_derivatives(problem, 7)


def test_whole_samples_that_are_missing_do_not_count_and_the_fast_pass_runs():
    rec, other = made(3, gain=False), made(3, gain=False)
    wild = np.where(np.isnan(rec.signals["y"]), 1e3, rec.signals["y"])
    spans = [(int(k), int(k) + 1) for k in np.flatnonzero(np.isnan(rec.signals["y"][:, 0]))]
    given = {"w": 9.5, "z": 0.1, "g": 90.0}
    result = gbid.fit(structure(), other, focus="simulation", start=given)
    same = gbid.fit(structure(), rec.with_signals(y=wild), focus="simulation", start=given, left_out={rec.name: spans})
    for name in result.free:
        assert result.parameters[name] == pytest.approx(same.parameters[name], rel=1e-5)
    assert result.engine == gbid.fit(structure(), made(3, lost=0.0), focus="simulation").engine
    validation = gbid.cross_validate(result, rec)
    assert validation.fit_percent[0] == pytest.approx(result.fit_percent[0, 0], abs=0.2)


def test_irregular_times_are_a_grid_with_held_inputs(tmp_path):
    """Every step between stamps is exact: inputs are held from one to the next."""
    rec = made(4, 3000, lost=0.0, gain=False)
    stamps = np.cumsum(np.random.default_rng(0).choice([1, 2, 3], 1400))
    kept = stamps[stamps < 3000]
    u = rec.signals["u"][kept, 0]
    F, G, _, C = sampled(TRUTH)
    x, y = np.zeros(2), []
    for steps, level in zip(np.diff(kept, append=kept[-1] + 1), u, strict=True):
        y.append(float((C @ x)[0]))
        for _ in range(steps):
            x = F @ x + G * level
    y = np.array(y) + 1e-3 * np.random.default_rng(1).standard_normal(len(y))
    path = tmp_path / "a.csv"
    path.write_text("t,u,y\n" + "".join(f"{STEP * k:.2f},{a:g},{b:.9g}\n" for k, a, b in zip(kept, u, y, strict=True)))
    volts = {"unit": "V", "stored_unit": "V"}
    signals = {"u": {"columns": ["u"], "hold": True, **volts}, "y": {"columns": ["y"], **volts}}
    result = gbid.fit(
        structure(),
        gbid.import_recording(path, {"signals": signals, "time": "t", "gaps": "missing", "sample_time": STEP}),
        focus="simulation",
    )
    assert result.success
    for name in result.free:
        assert abs(result.parameters[name] - TRUTH[name]) < 4 * result.std[name]
        assert result.std[name] < 0.01 * TRUTH[name]


def test_what_takes_no_gaps_refuses_them_by_name():
    rec = made(5)
    gone = rec.with_signals(u=np.where(np.arange(rec.n_samples) == 7, np.nan, rec.signals["u"][:, 0]))
    with pytest.raises(DataError, match=r"1 samples of signal 'u' are missing, the first at sample 7.*recording.held"):
        gbid.fit(structure(), gone)
    with pytest.raises(GbidError, match="errors='ar' needs every output sample, and some are missing"):
        gbid.fit(structure(), rec, focus="simulation", errors="ar")
    with pytest.raises(DataError, match="samples of signal 'y' are missing"):
        gbid.measured_response(rec, ["u"], ["y"])
    with pytest.raises(DataError, match="samples of signal 'y' are missing"):
        gbid.subspace(rec, order=2, inputs=["u"], outputs=["y"])


@pytest.mark.parametrize("every", [1, 2])
def test_weights_are_advised_only_where_a_fit_takes_them(every):
    rec = made(1, lost=0.0, every=every, gain=False)
    drift = scipy.signal.lfilter([0.3], [1.0, -0.99], np.random.default_rng(5).normal(size=rec.n_samples))
    drifting = rec.with_signals(y=rec.signals["y"][:, 0] + drift)
    result = gbid.fit(structure(), drifting, focus="simulation", fixed={"k1": 0.0, "k2": 0.0})
    (not_white,) = [note for note in result.notes if "not white" in note]
    assert ("errors='ar'" in not_white) == (every == 1)


@pytest.mark.parametrize("seeds", [pytest.param(40, marks=pytest.mark.slow), 1])
def test_coverage_is_that_without_gaps(seeds):
    """Errors over their standard deviations; 40 seeds cover at least as without gaps less two standard deviations."""
    names = ("w", "z", "g", "k2")
    for lost in (0.0, 0.1):
        fits = [gbid.fit(structure(), made(seed, lost=lost)) for seed in range(seeds)]
        assert all(result.success for result in fits)
        ratio = np.array([[(r.parameters[q] - TRUTH[q]) / r.std[q] for q in names] for r in fits])
        covered = (np.abs(ratio) < 1.96).mean()
        assert covered > 0.95 - 2 * np.sqrt(0.95 * 0.05 / ratio.size) * 2  # parameters of a fit are correlated


EXPERIMENT = """\
format: 1
name: gaps
results: results
import:
  data_folder: .
  recordings:
    - name: a
      file: a.csv
      sample_time_s: 0.01
      signals: {u: {columns: [u], unit: m, channels: [one]}, p: {columns: [p], unit: m, channels: [one]}}
fits:
  mode: {structure: structure.py:structure, focus: simulation, outputs: p}
"""
STRUCTURE = """\
from gbid import LinearStructure, Parameter


def matrices(p):
    return {"A": [[0, 1], [-p.w**2, -2 * p.z * p.w]], "B": [[0], [p.g]], "C": [[1, 0]]}


own = [Parameter("w", 9.0), Parameter("z", 0.1), Parameter("g", 80.0)]
structure = LinearStructure("mode", own, matrices, "u", "p")
"""


def test_an_experiment_takes_signals_of_the_rig_with_missing_samples(tmp_path):
    rec = made(6, gain=False)
    rows = zip(rec.signals["u"][:, 0], rec.signals["y"][:, 0], strict=True)
    lines = [f"{u:g},{'' if np.isnan(y) else f'{y:.9g}'}" for u, y in rows]
    (tmp_path / "a.csv").write_text("\n".join(["u,p", *lines, ""]))
    (tmp_path / "structure.py").write_text(STRUCTURE)
    (tmp_path / "experiment.yaml").write_text(EXPERIMENT)
    for verb in ("check", "run"):
        assert cli(verb, tmp_path / "experiment.yaml") == 0
    stored = gbid.load(tmp_path / "results" / "fits" / "mode" / "a.h5")
    for name in ("w", "z", "g"):
        assert abs(stored.parameters[name] - TRUTH[name]) < 4 * stored.std[name]
