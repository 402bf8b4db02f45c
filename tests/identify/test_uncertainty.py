"""Stated uncertainty against theory, finite differences and the spread of many fits."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from compilers import no_compiler
from fit_cases import EVERY, EVERY_AT, KEY, MODE, MODE_AT, TS, H, levels, piezo_motion, simulated
from scipy.linalg import matmul_toeplitz
from scipy.signal import lfilter
from scipy.stats import kstest

from gbid.identify import fit
from gbid.identify.uncertainty.residual_tests import correlation, whiteness_test
from gbid.recording import Recording
from gbid.structure import LinearStructure, Parameter, RotorBearing, evaluate

LAG = LinearStructure(
    "lag",
    [Parameter("a", 1.0, lower=0.01, upper=50.0), Parameter("b", 1.0)],
    lambda p: {"A": [[-p.a]], "B": [[p.b]], "C": [[1]]},
)
LAG_AT = {"a": 1.5, "b": 2.0}
GAINS = dict.fromkeys(("bd_xx", "bd_xy", "bd_yx", "bd_yy"), 0.0)


def coloured(n, rho, seed, size=0.2):
    """First-order autoregressive noise, (n,)."""
    e = size * np.random.default_rng(seed).normal(size=n + 500)
    return lfilter([1.0], [1.0, -rho], e)[500:]


def lag_data(n, rho=0.0, seed=1, input_seed=1, name="data"):
    u = levels(n, seed=input_seed)
    y = evaluate(LAG, LAG_AT).simulate(u, H) + coloured(n, rho, seed)[:, None]
    return Recording({"u": u, "y": y}, H, name=name)


@cache
def lag_fits(n, rho, count):
    """Fits of few iterations, so that none is tried again from elsewhere: they converge at once."""
    return [fit(LAG, lag_data(n, rho, 1000 + seed), max_iterations=20) for seed in range(count)]


def theory(n, rho, input_seed=1, size=0.2):
    """Standard deviations of a and b for noise of known colour: (P'P)^-1 P'R P (P'P)^-1, initial state included."""
    u, at = levels(n, seed=input_seed), np.array([1.5, 2.0, 0.0])

    def run(t):
        return evaluate(LAG, {"a": t[0], "b": t[1]}).simulate(u, H, initial_state=[t[2]])[:, 0]

    P = np.array([(run(at + s) - run(at - s)) / 2e-6 for s in 1e-6 * np.eye(3)]).T
    inverse = np.linalg.inv(P.T @ P)
    variance = size**2 / (1 - rho**2)
    J = variance * P.T @ matmul_toeplitz(rho ** np.arange(n), P)
    return np.sqrt(np.diag(inverse @ J @ inverse))[:2]


def stds(result, kind):
    return np.array([result.std_with(kind)[name] for name in result.free])


# ---- white and coloured noise ----


def test_for_white_noise_both_are_that_of_theory():
    results = lag_fits(3000, 0.0, 10)
    expected = theory(3000, 0.0)
    white, robust = (np.array([stds(r, kind) for r in results]) for kind in ("white", "robust"))
    np.testing.assert_allclose(white, np.broadcast_to(expected, white.shape), rtol=0.12)
    np.testing.assert_allclose(white.mean(axis=0), expected, rtol=0.02)
    np.testing.assert_allclose(robust.mean(axis=0), expected, rtol=0.1)
    np.testing.assert_allclose(robust, np.broadcast_to(expected, robust.shape), rtol=0.45)


@pytest.mark.parametrize(("n", "rho", "count"), [(1000, 0.9, 36), (4000, -0.5, 12)])
def test_for_coloured_noise_the_robust_one_is_that_of_theory(n, rho, count):
    results = lag_fits(n, rho, count)
    expected = theory(n, rho)
    robust = np.array([stds(r, "robust") for r in results])
    np.testing.assert_allclose(robust.mean(axis=0), expected, rtol=0.15)
    assert all(r.trusted == "robust" for r in results)
    for r in results:
        assert any("the residuals are not white" in note for note in r.notes)
        np.testing.assert_array_equal(r.covariance, r.covariance_robust)
        assert r.std == r.std_with("robust")
    white = np.array([stds(r, "white") for r in results]).mean(axis=0)
    if rho > 0:  # slow noise hides in what the slow input does
        assert (white < 0.75 * expected).all()
    else:
        assert (white > 1.2 * expected).all()


@pytest.mark.parametrize(("rho", "kinds"), [(0.0, ("white", "robust")), (0.9, ("robust",))])
def test_stated_intervals_cover_the_spread_of_many_fits(rho, kinds):
    results = lag_fits(1000, rho, 36)
    values = np.array([[r.parameters[name] for name in "ab"] for r in results])
    for kind in kinds:
        stated = np.array([stds(r, kind) for r in results])
        z = (values - [1.5, 2.0]) / stated
        # A standard deviation from 36 values is known to 12 %: two of those.
        np.testing.assert_allclose(stated.mean(axis=0) / values.std(axis=0, ddof=1), 1, atol=0.25)
        assert ((np.abs(z) < 1.96).mean(axis=0) >= 0.86).all()
        assert (np.abs(z.mean(axis=0)) < 4 / np.sqrt(36)).all()


def test_the_trace_of_unequal_and_correlated_outputs():
    """No weight asked for, and outputs of very different noise: both stated covariances still hold."""
    u = levels(1200, 2, hold=3)
    clean = evaluate(EVERY, EVERY_AT).simulate(u, H)
    root = np.array([[0.8, 0.0], [0.1, 0.1]])
    names, values, white, robust = "awbcd", [], [], []
    for seed in range(30):
        e = np.random.default_rng(seed).normal(size=u.shape) @ root.T
        result = fit(EVERY, Recording({"u": u, "y": clean + e}, H), start=EVERY_AT, focus="simulation")
        values.append([result.parameters[name] for name in names])
        white.append(stds(result, "white"))
        robust.append(stds(result, "robust"))
    spread = np.std(values, axis=0, ddof=1)
    np.testing.assert_allclose(np.mean(white, axis=0) / spread, 1, atol=0.3)
    np.testing.assert_allclose(np.mean(robust, axis=0) / spread, 1, atol=0.35)


@pytest.mark.parametrize("focus", ["simulation", "prediction"])
def test_windows_engines_and_gaps_do_not_move_the_covariance(focus):
    """It belongs to the estimate, not to the way that led there."""
    recs = [
        replace(simulated(MODE, MODE_AT, levels(n, seed=i), noise=0.3, seed=i), name=f"r{i}")
        for i, n in enumerate((700, 431))
    ]
    options = {"focus": focus, "left_out": {"r0": [(100, 130)]}}
    reference = fit(MODE, recs, window=None, **options)
    scale = np.sqrt(np.outer(np.diag(reference.covariance_white), np.diag(reference.covariance_white)))
    others = [fit(MODE, recs, window=window, **options) for window in (40, 333)]
    with no_compiler():
        others.append(fit(MODE, recs, window=None, **options))
    for other in others:
        for name in ("covariance_white", "covariance_robust"):
            a, b = getattr(other, name), getattr(reference, name)
            assert np.abs(a - b).max() < 0.02 * np.abs(b / scale).max() * scale.max()
            np.testing.assert_allclose(np.diag(a), np.diag(b), rtol=0.01)


# ---- what is trusted ----


def test_what_is_trusted_is_what_the_residuals_say():
    white = lag_fits(1000, 0.0, 36)
    assert sum(r.trusted == "robust" for r in white) <= 2  # one in a hundred is expected
    for r in white:
        assert r.trusted == ("white" if r.whiteness.min() >= 0.01 else "robust")
        chosen = r.covariance_white if r.trusted == "white" else r.covariance_robust
        np.testing.assert_array_equal(r.covariance, chosen)
    assert all(r.trusted == "robust" for r in lag_fits(2000, 0.3, 8))


def test_the_whiteness_test_keeps_its_level():
    random = np.random.default_rng(12)
    one = np.array([whiteness_test([random.normal(size=(400, 2))]).p_value for _ in range(400)]).ravel()
    assert kstest(one, "uniform").pvalue > 1e-3
    assert (one < 0.01).mean() < 0.025
    several = [
        whiteness_test([random.normal(size=(n, 1)) for n in (300, 150, 40)]).p_value[0] for _ in range(400)
    ]  # the last is too short to count
    assert kstest(several, "uniform").pvalue > 1e-3
    test = whiteness_test([random.normal(size=(400, 1))], lags=12)
    assert test.lags == 12
    # A mean is no colour.
    e = random.normal(size=(400, 1))
    assert whiteness_test([e + 100.0]).p_value == pytest.approx(whiteness_test([e]).p_value, rel=1e-6)


def test_the_statistic_is_ljungs_and_boxs():
    e = np.random.default_rng(2).normal(size=(150, 1))
    centred = e[:, 0] - e.mean()
    rho = [centred[lag:] @ centred[:-lag] / (centred @ centred) for lag in range(1, 6)]
    expected = 150 * 152 * sum(r**2 / (150 - lag) for lag, r in enumerate(rho, 1))
    assert whiteness_test([e], lags=5).statistic[0] == pytest.approx(expected, rel=1e-10)


@pytest.mark.parametrize(("n", "lags"), [(50, 10), (1000, 0), (333, 332)])
def test_correlation_is_numpys(n, lags):
    random = np.random.default_rng(n)
    a, b = random.normal(size=n) + 0.5, random.normal(size=n)
    b[3:] += a[:-3]
    expected = np.correlate(b, a, "full")[n - 1 : n + lags] / np.sqrt((a @ a) * (b @ b))
    np.testing.assert_allclose(correlation(a, b, lags), expected, rtol=1e-9, atol=1e-13)


# ---- what follows from the parameters ----


def by_differences(structure, result, function):
    """Standard deviations of a function of the model by central differences and the covariance."""
    slopes = []
    for name in result.free:
        step = 1e-3 * result.std_with("white")[name]
        ends = [
            np.asarray(function(evaluate(structure, {**result.parameters, name: result.parameters[name] + s})))
            for s in (step, -step)
        ]
        slopes.append((ends[0] - ends[1]) / (2 * step))
    slopes = np.moveaxis(np.array(slopes), 0, -1)
    return np.sqrt(np.einsum("...p,pq,...q->...", slopes, result.covariance, slopes))


@pytest.mark.parametrize("delay", ["pade", "exact"])
@pytest.mark.parametrize("focus", ["prediction", "simulation"])
def test_modes_and_static_gain_of_the_rotor(delay, focus):
    structure = RotorBearing(delay=delay)
    rec = simulated(structure, {**KEY, **GAINS}, piezo_motion(2500), h=TS, hold="foh", noise=3e-8)
    result = fit(structure, rec, focus=focus)
    modes = by_differences(structure, result, lambda model: model.modes())
    assert result.modes_std.shape == (len(result.model.modes()), 2)
    np.testing.assert_allclose(result.modes_std, modes, rtol=1e-4)
    gain = by_differences(structure, result, lambda model: model.static_gain())
    np.testing.assert_allclose(result.static_gain_std, gain, rtol=1e-4)
    truth = np.array(evaluate(structure, {**KEY, **GAINS}).modes())[:2]
    assert (np.abs(np.array(result.model.modes())[:2] - truth) < 4 * result.modes_std[:2]).all()


def test_an_integrator_has_no_static_gain_to_be_sure_of():
    arm = LinearStructure(
        "arm",
        [Parameter("b1", 1.0), Parameter("K2", 1.0)],
        lambda p: {"A": [[0, 1], [0, -p.b1]], "B": [[0], [p.K2]], "C": [[1, 0]]},
    )
    result = fit(arm, simulated(arm, {"b1": 2.0, "K2": 3.0}, levels(400), noise=0.05))
    assert result.success
    assert np.isnan(result.static_gain_std).all()
    assert result.modes_std.shape == (0, 2)


# ---- numbers that compare models ----


def test_aic_and_fpe_are_their_definitions_and_choose_the_smaller_true_model():
    rec = lag_data(1000)
    result = fit(LAG, rec)
    n, k = 1000, 3  # two parameters and an initial state
    v = result.error_covariance[0, 0]
    assert result.aic == pytest.approx(n * np.log(v) + 2 * k, rel=1e-12)
    assert result.fpe == pytest.approx(v * (1 + k / n) / (1 - k / n), rel=1e-9)
    assert result.log_likelihood == pytest.approx(-n / 2 * (np.log(2 * np.pi * v) + 1), rel=1e-12)
    wrong = LinearStructure("gain", [Parameter("d", 1.0)], lambda p: {"A": [[-5.0]], "B": [[p.d]], "C": [[1]]})
    other = fit(wrong, rec)
    assert other.aic > result.aic + 100
    assert other.fpe > result.fpe
    known = fit(LAG, rec, initial_state="zero")
    assert known.aic == pytest.approx(n * np.log(known.error_covariance[0, 0]) + 2 * 2, rel=1e-12)


def test_the_condition_tells_of_parameters_that_hang_together():
    close = LinearStructure(
        "close",
        [Parameter("a", 1.0), Parameter("b", 1.0), Parameter("c", 0.5)],
        lambda p: {"A": [[-p.a]], "B": [[p.b + p.c]], "C": [[1]], "D": [[1e-4 * p.c]]},
    )
    rec = simulated(close, {"a": 1.5, "b": 2.0, "c": 0.3}, levels(500), noise=0.1)
    apart, together = fit(LAG, lag_data(500)), fit(close, rec)
    assert apart.condition < 1e3
    assert together.condition > 1e5
