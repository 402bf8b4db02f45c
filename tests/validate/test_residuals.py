"""Tests of residuals: known correlations, a delay that is wrong, bands that cover what they say."""

from dataclasses import replace

import numpy as np
import pytest
from fit_cases import MODE, MODE_AT, H, innovations, levels, simulated
from scipy.linalg import toeplitz
from scipy.signal import lfilter
from scipy.stats import chi2, kstest, norm

from gbid.core.errors import DataError, UsageError
from gbid.identify import fit
from gbid.identify.disturbances import Disturbances, Trend
from gbid.identify.uncertainty.residual_tests import input_test
from gbid.recording import Recording
from gbid.structure import LinearStructure, Parameter, evaluate
from gbid.validate import check_residuals, cross_validate
from gbid.validate.simulate import LinearSimulator

OFFSET = Disturbances(("y",), (Trend(1),))

LAG = LinearStructure(
    "lag",
    [Parameter("a", 1.0, lower=0.01, upper=50.0), Parameter("b", 1.0), Parameter("k", 0.0)],
    lambda p: {"A": [[-p.a]], "B": [[p.b]], "C": [[1]], "K": [[p.k]]},
)
LAG_AT = {"a": 1.5, "b": 2.0, "k": 3.0}


def held(result_of, values):
    """A result whose model has given values: residuals without an estimate in them."""
    return result_of.changed(model=evaluate(LAG, values, ("u",), ("y",)))


@pytest.fixture(scope="module")
def data():
    return innovations(LAG, LAG_AT, levels(4000, seed=2), noise=[0.3], name="first")


@pytest.fixture(scope="module")
def result(data):
    return fit(LAG, data)


def test_the_residuals_of_the_true_model_are_white(data, result):
    tests = check_residuals(result, data)
    assert tests.recording == "first"
    assert tests.p_white.shape == (1,)
    assert tests.p_white[0] > 0.01
    assert (tests.input_names, tests.output_names) == (("u",), ("y",))
    np.testing.assert_array_equal(tests.lags, np.arange(51))
    np.testing.assert_array_equal(tests.cross_lags, np.arange(-50, 51))
    np.testing.assert_allclose(tests.time, H * np.arange(51))
    assert tests.autocorrelation[0, 0] == pytest.approx(1.0)
    assert tests.verdict == (f"y: residuals white (p = {tests.p_white[0]:.2g})",)
    assert tests.outside[0, 0] < 0.1
    assert tests.p_independent[0, 0] > 0.01
    assert tests.band == pytest.approx(norm.ppf(0.995) / np.sqrt(4000))
    assert tests.rms[0] == pytest.approx(np.sqrt(result.loss), rel=1e-3)
    assert tests.fit_percent[0] == pytest.approx(result.fit_percent[0, 0], abs=0.05)


def test_all_numbers_are_those_of_numpy(data, result):
    """The residuals by the model's own predict, their correlations by sums."""
    short = data.slice(0, 400)
    tests = check_residuals(result, short, lags=12)
    u, y = short.signal("u"), short.signal("y")

    def error(x0):
        return (y - result.model.predict(u, y, H, initial_state=[x0]))[:, 0]

    # The initial state is the one of the simulation that comes nearest.
    runs = [(y - result.model.simulate(u, H, initial_state=[x0]))[:, 0] for x0 in (0.0, 1.0)]
    free = runs[0] - runs[1]
    x0 = (free @ runs[0]) / (free @ free)
    e = error(x0)
    assert tests.infinity_norm[0] == pytest.approx(np.abs(e).max(), rel=1e-6)
    assert tests.rms[0] == pytest.approx(np.sqrt(np.mean(e**2)), rel=1e-6)
    e, v = e - e.mean(), u[:, 0] - u.mean()
    auto = np.correlate(e, e, "full")[399 : 399 + 13] / (e @ e)
    np.testing.assert_allclose(tests.autocorrelation[0], auto, atol=1e-6)
    cross = np.correlate(e, v, "full")[399 - 12 : 399 + 13] / np.sqrt((e @ e) * (v @ v))
    np.testing.assert_allclose(tests.crosscorrelation[0, 0], cross, atol=1e-6)
    inside = np.abs(cross[12:]) <= tests.cross_band[0, 0]
    assert tests.outside[0, 0] == pytest.approx(1 - inside.mean())


@pytest.mark.parametrize("rho", [0.8, -0.6])
def test_a_known_autocorrelation(result, rho):
    """Output noise of a known colour, in simulation focus: rho to the power of the lag."""
    u = levels(20000, seed=3)
    e = lfilter([0.2], [1, -rho], np.random.default_rng(5).normal(size=(20000, 1)), axis=0)
    rec = Recording({"u": u, "y": evaluate(LAG, LAG_AT).simulate(u, H) + e}, H, name="coloured")
    simulation = held(result, LAG_AT).changed(options=replace(result.options, focus="simulation"))
    tests = check_residuals(simulation, rec, lags=20)
    np.testing.assert_allclose(tests.autocorrelation[0], rho ** np.arange(21), atol=0.06)
    assert tests.p_white[0] < 1e-10
    assert "not white" in tests.verdict[0]
    assert tests.outside[0, 0] < 0.1  # coloured, but nothing of the input is in it


def test_a_delay_that_is_left_out_shows_at_its_lags():
    """The model acts at once, the system three samples late: the input's next samples are missing from it."""
    delayed = LinearStructure(
        "late",
        LAG.parameters[:2],
        lambda p: {"A": [[-p.a]], "B": [[0]], "B_delayed": [[p.b]], "delay": [0.3], "C": [[1]]},
    )
    u = np.random.default_rng(1).choice([-1.0, 1.0], (5000, 1))  # white, so that each lag stands for itself
    truth = {"a": 1.5, "b": 2.0}
    rec = simulated(delayed, truth, u, noise=0.05)
    at_once = fit(LAG, rec, focus="simulation")
    wrong = check_residuals(at_once, rec, lags=30)
    right = check_residuals(fit(delayed, rec), rec, lags=30)
    assert right.outside[0, 0] < 0.1
    assert right.p_independent[0, 0] > 0.01
    assert wrong.p_independent[0, 0] < 1e-6
    assert not [word for word in right.verdict if "follow" in word]
    assert wrong.outside[0, 0] > 0.1
    assert any("y: residuals still follow u: the structure is incomplete" in word for word in wrong.verdict)
    # With the true values at once: what is missing is h(t - 3) - h(t), most at the lags of the delay.
    held_model = at_once.changed(model=evaluate(LAG, {**truth, "k": 0.0}, ("u",), ("y",)))
    known = check_residuals(held_model, rec, lags=30)
    response = 2.0 * np.exp(-1.5 * H * np.arange(40)) * (1 - np.exp(-1.5 * H)) / 1.5
    pulse = np.concatenate([np.zeros(31), response])[:61]  # held input: first seen one sample later
    missing = np.concatenate([np.zeros(3), pulse[:-3]]) - pulse
    expected = missing / np.sqrt(np.sum(missing**2) + 0.05**2)
    np.testing.assert_allclose(known.crosscorrelation[0, 0], expected, atol=0.06)
    assert np.abs(known.crosscorrelation[0, 0])[31:].argmax() in (0, 3)
    assert not (np.abs(known.crosscorrelation[0, 0, :30]) > 2 * known.cross_band[0, 0]).any()  # causal


@pytest.mark.parametrize("rho", [0.0, 0.8])
@pytest.mark.parametrize("hold", [1, 8])
def test_bands_cover_ninety_nine_of_a_hundred(result, rho, hold):
    """For residuals of any colour and inputs of any colour, as long as one has nothing of the other."""
    outside_cross, outside_auto, chance = [], [], []
    simulation = held(result, {**LAG_AT, "k": 0.0}).changed(options=replace(result.options, focus="simulation"))
    for seed in range(40):
        random = np.random.default_rng(100 + seed)
        u = np.repeat(random.choice([-1.0, 1.0], (2000 // hold, 1)), hold, axis=0)
        e = lfilter([0.2], [1, -rho], random.normal(size=(2000, 1)), axis=0)
        rec = Recording({"u": u, "y": simulation.model.simulate(u, H) + e}, H)
        tests = check_residuals(simulation, rec, lags=30)
        outside_cross.append((np.abs(tests.crosscorrelation) > tests.cross_band[:, :, None]).mean())
        outside_auto.append((np.abs(tests.autocorrelation[0, 1:]) > tests.band).mean())
        chance.append(tests.p_independent[0, 0])
    assert kstest(chance, "uniform").pvalue > 1e-3
    assert 0.002 < np.mean(outside_cross) < 0.03
    if rho == 0:
        assert 0.004 < np.mean(outside_auto) < 0.02
    else:
        assert np.mean(outside_auto) > 0.2


def test_another_recording_may_be_tested(data, result):
    other = innovations(LAG, LAG_AT, levels(2000, seed=9), noise=[0.3], seed=7, name="second")
    tests = check_residuals(result, other)
    assert tests.recording == "second"
    assert tests.p_white[0] > 1e-3
    assert tests.rms[0] == pytest.approx(0.3, rel=0.1)


def test_a_poor_gain_shows_as_colour(data, result):
    poor = check_residuals(held(result, {**LAG_AT, "k": 0.0}), data)
    assert poor.p_white[0] < 1e-6
    assert poor.rms[0] > check_residuals(result, data).rms[0]


def test_several_inputs_and_outputs_have_their_names():
    two = LinearStructure(
        "two",
        [Parameter("a", 1.0), Parameter("b", 1.0), Parameter("c", 1.0)],
        lambda p: {"A": [[-p.a, 0], [0, -2]], "B": [[p.b, 0], [0, p.c]], "C": [[1, 0], [0, 1]]},
    )
    u = levels(1500, 2, hold=3)
    clean = evaluate(two, {"a": 1.5, "b": 2.0, "c": 1.0}).simulate(u, H)
    clean[:, 1] += 0.3 * np.concatenate([[0.0], u[:-1, 0]])  # the second output follows the first input as well
    rec = Recording({"u": u, "y": clean + 0.1 * np.random.default_rng(1).normal(size=u.shape)}, H)
    tests = check_residuals(fit(two, rec, focus="simulation"), rec, lags=8)
    assert tests.crosscorrelation.shape == (2, 2, 17)
    assert tests.cross_band.shape == tests.outside.shape == (2, 2)
    assert tests.outside[1, 0] > 0.1
    assert tests.outside[0].max() < 0.3
    assert "y_2: residuals still follow u_x: the structure is incomplete" in tests.verdict
    assert not any("y_1" in word and "follow" in word for word in tests.verdict)
    assert tests.follows == ((), ("u_x",))
    assert tests.white.tolist() == [True, False]


@pytest.mark.parametrize("lags", [0, -1, 101])
def test_wrong_lags_are_refused(data, result, lags):
    with pytest.raises(UsageError, match=r"'first' has 400 samples; lags must be 1 to a fourth"):
        check_residuals(result, data.slice(0, 400), lags=lags)


def test_a_recording_without_the_signals_is_refused(result):
    with pytest.raises(DataError, match="has no signal 'y'"):
        check_residuals(result, Recording({"u": levels(500)}, H))


def test_a_model_that_overflows_is_refused(data, result):
    wild = result.changed(model=replace(result.model, A=np.array([[80.0]])))
    with pytest.raises(DataError, match="overflows on recording 'first'"):
        check_residuals(wild, data)


def test_the_simulation_of_a_mode_leaves_its_white_noise():
    rec = simulated(MODE, MODE_AT, levels(2000), noise=0.3)
    tests = check_residuals(fit(MODE, rec, focus="simulation"), rec)
    assert tests.p_white[0] > 0.01
    assert tests.rms[0] == pytest.approx(0.3, rel=0.05)


# ---- numbers by their formulas ----


def correlations(a, b, lags):
    """``sum a[k] b[k + l] / (|a| |b|)`` at lags 0, 1, ..."""
    size = np.sqrt((a @ a) * (b @ b))
    return np.array([a[: len(a) - lag] @ b[lag:] for lag in range(lags + 1)]) / size


def test_band_and_probability_are_those_of_bartletts_covariance(data, result):
    """Of coloured residuals and a slow input, whose correlations at neighbouring lags are nearly the same number."""
    lags = 20
    poor = result.changed(model=replace(result.model, K=None))
    slow = data.with_signals(u=levels(4000, hold=60, seed=2))
    tests = check_residuals(poor, slow, lags=lags)
    u, y = slow.signal("u"), slow.signal("y")
    state = LinearSimulator(poor.model, H, poor.options.intersample).explain(u.T, y.T).initial_state
    e = (y - poor.model.simulate(u, H, initial_state=state, intersample=poor.options.intersample))[:, 0]
    e, v = e - e.mean(), u[:, 0] - u.mean()
    most, n = 2 * lags, len(e)
    of_errors, other = correlations(e, e, most), correlations(v, v, most + lags)
    covariance = [
        sum((1 - abs(m) / (most + 1)) * of_errors[abs(m)] * other[abs(m + k)] for m in range(-most, most + 1))
        for k in range(lags + 1)
    ]
    assert tests.cross_band[0, 0] == pytest.approx(norm.ppf(0.995) * np.sqrt(covariance[0] / n), rel=1e-9)
    values, vectors = np.linalg.eigh(toeplitz(covariance))
    kept = values > 1e-6 * values[-1]
    assert kept.sum() > np.sum(values > 1e-1 * values[-1])
    statistic = n * np.sum((vectors.T @ correlations(v, e, lags))[kept] ** 2 / values[kept])
    assert tests.p_independent[0, 0] == pytest.approx(chi2.sf(statistic, kept.sum()), rel=1e-6, abs=1e-300)


def test_two_outputs_are_white_at_half_a_percent_each(data, result):
    two = {"p_white": np.array([0.006, 0.004]), "p_independent": np.ones((2, 1)), "output_names": ("x", "y")}
    computed = replace(check_residuals(result, data), **two)
    np.testing.assert_array_equal(computed.white, [True, False])
    assert computed.verdict == ("x: residuals white (p = 0.006)", "y: residuals not white (p = 0.004)")


def test_the_longest_stretch_is_tested(data, result):
    tests = check_residuals(result, data, left_out=[(700, 800), (2900, 2950)])
    alone = check_residuals(result, data.slice(800, 2900))
    for name in ("autocorrelation", "crosscorrelation", "cross_band", "p_white", "rms", "infinity_norm"):
        np.testing.assert_allclose(getattr(tests, name), getattr(alone, name), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("focus", ["prediction", "simulation"])
def test_an_offset_of_the_outputs_changes_nothing_where_offsets_are_estimated(data, result, focus):
    free = result.changed(disturbances=OFFSET, options=replace(result.options, focus=focus))
    shifted = data.with_signals(y=data.signal("y") + 40.0)
    computed, plain = check_residuals(free, shifted), check_residuals(free, data)
    np.testing.assert_allclose(computed.rms, plain.rms, rtol=1e-9)
    np.testing.assert_allclose(computed.infinity_norm, plain.infinity_norm, rtol=1e-9)
    np.testing.assert_allclose(computed.autocorrelation, plain.autocorrelation, atol=1e-9)


# ---- offsets that belong to a recording ----


@pytest.fixture(scope="module")
def model():
    """A fit with an offset, its parameters the truth but for noise."""
    recording = simulated(MODE, MODE_AT, levels(2000), name="first")
    return fit(MODE, with_offset(recording, 3.0, 1), focus="simulation", trend="offset")


def with_offset(recording, offset, seed):
    signals = dict(recording.signals)
    name = MODE.outputs[0]
    noise = np.random.default_rng(seed).standard_normal(signals[name].shape)
    signals[name] = signals[name] + offset + 0.01 * signals[name].std() * noise
    return replace(recording, signals=signals)


def test_a_recording_has_an_offset_of_its_own(model):
    other = with_offset(simulated(MODE, MODE_AT, levels(2000, seed=5), name="second"), -7.0, 2)
    assert cross_validate(model, other).fit_percent.min() > 98.5
    assert check_residuals(model, other).white.all()
    without = model.changed(disturbances=Disturbances())
    assert cross_validate(without, other).fit_percent.min() < 90


def test_a_simulation_is_tested_where_outputs_are_missing_and_a_prediction_between(result):
    random = np.random.default_rng(5)
    true, other = (simulated(LAG, {**LAG_AT, "a": a}, levels(4000, seed=3), noise=0.05) for a in (1.5, 1.6))
    gone = random.random(4000) < 0.1
    with_gaps = [
        Recording({"u": r.signals["u"], "y": np.where(gone, np.nan, r.signals["y"][:, 0])}, H, name="gaps")
        for r in (true, other)
    ]
    of_simulation = fit(LAG, true, focus="simulation", fixed={"k": 0.0})
    right, wrong = (check_residuals(of_simulation, r) for r in with_gaps)
    assert right.white.all()
    assert not right.follows[0]
    assert right.rms[0] == pytest.approx(0.05, rel=0.05)
    assert wrong.follows[0] == ("u",)
    assert len(check_residuals(result, with_gaps[0]).lags) - 1 == np.diff(np.flatnonzero(gone)).max() // 4
    every_second = Recording(
        {"u": true.signals["u"], "y": np.where(np.arange(4000) % 2, np.nan, true.signals["y"][:, 0])}, H
    )
    with pytest.raises(DataError, match=r"no four samples in a row have all outputs.*simulation focus"):
        check_residuals(result, every_second)


@pytest.mark.parametrize("rho", [0.0, 0.7])
def test_an_input_in_step_with_the_gaps_is_followed_no_more_often_than_by_chance(rho):
    """Every second output is missing, and the levels of the input change at even samples."""
    n, p = 1500, []
    for seed in range(400):
        random = np.random.default_rng(seed)
        residuals = lfilter([1.0], [1.0, -rho], random.normal(size=(n, 1)), axis=0)
        residuals[1::2] = 0.0
        inputs = np.repeat(random.choice([-1.0, 1.0], (n // 10, 1)), 10, axis=0)
        p.append(input_test(residuals, inputs, 25, white=rho == 0).p_value[0, 0])
    assert 0.025 < np.mean(np.array(p) < 0.05) < 0.08
    assert np.mean(np.array(p) < 0.01) < 0.025
