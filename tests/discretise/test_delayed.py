"""Exact delays: the taps against fine integration, models with them against brute force and high-order Pade."""

from itertools import pairwise

import numpy as np
import pytest
from fit_cases import ACTUATORS, KEY, TS, fit_data, piezo_motion, smooth
from scipy.linalg import expm

from gbid.core.errors import UsageError
from gbid.discretise import delayed_taps, discretise
from gbid.identify.kernel.blocks import cut
from gbid.identify.kernel.linear import PortableLinearKernel
from gbid.identify.predictor import build_predictor
from gbid.structure import LinearModel, LinearStructure, Parameter, Plant, RotorBearing, evaluate, with_pade

H = 0.1
A = np.array([[-0.6, 2.0], [-3.0, -0.2]])
b = np.array([[0.4], [1.5]])
GAINS = {"bd_xx": 3e4, "bd_xy": -4e3, "bd_yx": 2e3, "bd_yy": 5e4}


def between(u, t, h, hold):
    """Input (n_samples, n_u) at any time; before and after the record at its first and last sample."""
    k = np.clip(np.floor(t / h + 1e-12).astype(int), 0, len(u) - 1)
    if hold == "zoh":
        return u[k]
    following = u[np.minimum(k + 1, len(u) - 1)]
    part = np.clip(t / h - k, 0, 1)[..., None]
    return u[k] * (1 - part) + following * part


def states_by_integration(A, B, B_delayed, delay, u, h, holds, x0):
    """States at the samples by steps over the stretches on which every input is one straight line.

    Cut where any input, prompt or late, changes its piece; each stretch by one exponential of the state and the
    inputs' values and slopes, so exact to rounding and without a word on taps.
    """
    n, n_u = B.shape
    x, rows = np.asarray(x0, float), [np.asarray(x0, float)]
    for k in range(len(u) - 1):
        edges = {0.0, h}
        for tau in delay:
            edges.add((tau / h % 1.0) * h)
        edges = np.unique(np.round(sorted(edges), 15))
        for start, stop in pairwise(edges):
            length = stop - start
            drive, slope = np.zeros(n), np.zeros(n)
            for i in range(n_u):
                for matrix, tau in ((B, 0.0), (B_delayed, delay[i])):
                    # Two points within the stretch settle the straight line.
                    t = k * h + start + length * np.array([0.25, 0.75]) - tau
                    v = between(u[:, [i]], t, h, holds[i])[:, 0]
                    incline = (v[1] - v[0]) / (0.5 * length)
                    drive = drive + matrix[:, i] * (v[0] - 0.25 * length * incline)
                    slope = slope + matrix[:, i] * incline
            big = np.zeros((n + 2, n + 2))
            big[:n, :n], big[:n, n], big[:n, n + 1], big[n + 1, n] = A, drive, slope, 1.0
            x = (expm(big * length) @ np.concatenate([x, [1.0, 0.0]]))[:n]
        rows.append(x)
    return np.array(rows)


# ---- taps ----


@pytest.mark.parametrize("hold", ["zoh", "foh"])
@pytest.mark.parametrize("delay", [0.0, 0.004, 0.05, 0.0999, 0.1, 0.13, 0.2, 0.371])
def test_taps_against_fine_integration(hold, delay):
    """The integral over one sample, by Simpson's rule on a fine grid for each piece of the input."""
    taps = delayed_taps(A, b, delay, H, hold)
    delayed = delay % H if not np.isclose(delay % H, H) else 0.0
    assert taps.shift == int(delay / H + 1e-12)
    assert taps.columns[0].shape == (2, 1)
    for offset, column in zip((1, 0, -1), taps.columns, strict=True):
        impulse = np.zeros((20, 1))
        impulse[10 - taps.shift + offset] = 1.0  # the sample that this column is for, seen from sample 10
        total = np.zeros(2)
        for start, stop in ((0.0, delayed), (delayed, H)):
            if stop - start < 1e-12:
                continue
            s = np.linspace(start, stop, 201)
            inner = np.clip(s, start + 1e-9, stop - 1e-9)  # the value within the piece, not at its edge
            u = between(impulse, 10 * H + inner - delay, H, hold)[:, 0]
            response = expm(A * (H - s)[:, None, None]) @ b[:, 0]
            weights = np.ones(201)
            weights[1:-1:2], weights[2:-1:2] = 4, 2
            total += (weights * u) @ response * (stop - start) / 200 / 3
        np.testing.assert_allclose(column[:, 0], total, rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("hold", ["zoh", "foh"])
@pytest.mark.parametrize("whole", [1, 2, 3])
def test_a_whole_sample_is_a_shift_and_met_from_both_sides(hold, whole):
    """Response to an input, with its lags as they are, is the same from just below and just above."""

    def by_lag(delay):
        taps = delayed_taps(A, b, delay, H, hold)
        lags = np.zeros((2, whole + 4))
        for j, column in enumerate(taps.columns):
            lags[:, taps.shift + j] += column[:, 0]  # lag shift - 1 + j, counted from -1
        return lags

    at = by_lag(whole * H)
    undelayed = delayed_taps(A, b, 0.0, H, hold)
    for j, column in enumerate(undelayed.columns[:2]):
        np.testing.assert_allclose(at[:, whole + j], column[:, 0], atol=1e-12)
    np.testing.assert_allclose(by_lag(whole * H - 1e-9), at, atol=1e-7)
    np.testing.assert_allclose(by_lag(whole * H + 1e-9), at, atol=1e-7)


def test_a_negative_delay_is_refused():
    with pytest.raises(UsageError, match=r"delay = -0\.1 s; it must not be negative"):
        delayed_taps(A, b, -0.1, H, "zoh")


# ---- models ----

B = np.array([[0.3, 0.0], [-0.5, 0.8]])
LATE = np.array([[0.4, 1.0], [1.5, -0.7]])
DELAY = np.array([0.27, 0.033])
MODEL = LinearModel(A, B, [[1.0, 0.5], [0.0, 2.0]], [[0.1, 0.0], [0.0, 0.2]], B_delayed=LATE, delay=DELAY)


@pytest.mark.parametrize("holds", [("zoh", "zoh"), ("foh", "foh"), ("foh", "zoh")])
@pytest.mark.parametrize("delay", [DELAY, [0.0, 0.1], [0.2, 0.35]], ids=str)
def test_simulation_against_brute_force(holds, delay):
    model = LinearModel(MODEL.A, MODEL.B, MODEL.C, MODEL.D, B_delayed=LATE, delay=delay)
    u, x0 = smooth(40, seed=3), np.array([0.5, -1.0])
    x = states_by_integration(A, B, LATE, np.asarray(delay), u, H, holds, x0)
    expected = x @ model.C.T + u @ model.D.T
    simulated = model.simulate(u, H, initial_state=x0, intersample=holds)
    np.testing.assert_allclose(simulated, expected, rtol=1e-9, atol=1e-10)


def test_the_frequency_response_has_the_phase_of_the_delay():
    f = np.array([0.0, 0.1, 0.7, 3.0, 40.0])
    s = 2j * np.pi * f[:, None, None]
    states = np.linalg.solve(s * np.eye(2) - A, B + LATE * np.exp(-s * DELAY))
    np.testing.assert_allclose(MODEL.frequency_response(f), MODEL.C @ states + MODEL.D, rtol=1e-12)
    np.testing.assert_allclose(MODEL.static_gain(), MODEL.frequency_response(0.0)[0].real, rtol=1e-12)
    alone = LinearModel(A, 0 * B, MODEL.C, np.zeros((2, 2)), B_delayed=LATE, delay=DELAY)
    prompt = LinearModel(A, LATE, MODEL.C, np.zeros((2, 2)))
    ratio = alone.frequency_response(f) / prompt.frequency_response(f)
    np.testing.assert_allclose(ratio, np.broadcast_to(np.exp(-s * DELAY), ratio.shape), rtol=1e-10)


def test_pade_comes_to_the_exact_delay_with_its_order():
    f = np.linspace(0, 1.5, 40)
    exact = MODEL.frequency_response(f)
    errors = [np.abs(with_pade(MODEL, order).frequency_response(f) - exact).max() for order in (1, 2, 3, 4, 5, 6)]
    assert errors[0] > 1e-2
    ratios = np.divide(errors[1:], errors[:-1])
    assert (ratios < 0.15).all()
    assert (np.diff(ratios) < 0).all()  # ever faster
    assert errors[-1] < 2e-8
    for order in (1, 4):
        model = with_pade(MODEL, order)
        assert (model.n_states, model.delay, model.B_delayed) == (2 + 2 * order, None, None)
        np.testing.assert_allclose(model.static_gain(), MODEL.static_gain(), rtol=1e-12)
        assert len(set(model.state_names)) == model.n_states
    # A smooth input sees no difference in time either.
    u = np.sin(0.1 * np.arange(200))[:, None] * [1.0, -0.4] * np.minimum(np.arange(200) / 60, 1)[:, None] ** 3
    fine = [m.simulate(u, H, intersample="foh") for m in (MODEL, with_pade(MODEL, 8))]
    np.testing.assert_allclose(fine[1], fine[0], atol=1e-4 * np.abs(fine[0]).max())


def test_pade_of_what_needs_none():
    plain = LinearModel(A, B, MODEL.C, MODEL.D)
    assert with_pade(plain) is plain
    partly = LinearModel(A, B, MODEL.C, MODEL.D, B_delayed=LATE, delay=[0.0, 0.2])
    approximated = with_pade(partly, 3)
    assert approximated.n_states == 5
    f = [0.0, 0.2, 0.5]
    np.testing.assert_allclose(approximated.frequency_response(f), partly.frequency_response(f), rtol=1e-5)
    with pytest.raises(UsageError, match="Pade order 0"):
        with_pade(MODEL, 0)


@pytest.mark.parametrize("holds", [("zoh", "zoh"), ("foh", "zoh"), ("foh", "foh")])
def test_prediction_is_the_plain_loop(holds):
    K = np.array([[0.8, 0.1], [-0.2, 1.1]])
    model = LinearModel(A, B, MODEL.C, MODEL.D, K=K, B_delayed=LATE, delay=DELAY)
    u, y, x0 = smooth(60, seed=4), smooth(60, seed=5), np.array([0.5, -1.0])
    # Inputs and errors superpose: what the inputs do by integration, what the errors do by a held loop.
    F, Kd = expm(A * H), discretise(A, K, H, "zoh").G_now
    driven = states_by_integration(A, B, LATE, DELAY, u, H, holds, np.zeros(2))
    x, rows = x0, []
    for k in range(len(u)):
        yhat = model.C @ (x + driven[k]) + model.D @ u[k]
        rows.append(yhat)
        x = F @ x + Kd @ (y[k] - yhat)
    predicted = model.predict(u, y, H, initial_state=x0, intersample=holds)
    np.testing.assert_allclose(predicted, rows, rtol=1e-8, atol=1e-10)
    without = LinearModel(A, B, MODEL.C, MODEL.D, B_delayed=LATE, delay=DELAY)
    same = without.simulate(u, H, initial_state=x0, intersample=holds)
    np.testing.assert_array_equal(without.predict(u, y, H, initial_state=x0, intersample=holds), same)


WRONG = {
    "without B_delayed": ({"delay": [0.1, 0.1]}, "give both delay and B_delayed, or neither"),
    "without delay": ({"B_delayed": LATE}, "give both delay and B_delayed, or neither"),
    "one delay": ({"B_delayed": LATE, "delay": [0.1]}, r"delay has shape \(1,\), expected \(2,\)"),
    "small B_delayed": ({"B_delayed": [[1.0, 2.0]], "delay": [0.1, 0.1]}, r"B_delayed has shape \(1, 2\), expected"),
    "negative": ({"B_delayed": LATE, "delay": [0.1, -0.1]}, "delays cannot be negative"),
    "not finite": ({"B_delayed": LATE, "delay": [0.1, np.nan]}, "delay holds entries that are not finite"),
    "discrete": ({"B_delayed": LATE, "delay": DELAY, "dt": 0.1}, "a sampled model has no exact delays"),
}


@pytest.mark.parametrize("what", WRONG)
def test_wrong_delays_are_refused(what):
    fields, text = WRONG[what]
    with pytest.raises(UsageError, match=text):
        LinearModel(A, B, MODEL.C, MODEL.D, **fields)


def test_wrong_use_of_a_delayed_model_is_refused():
    with pytest.raises(UsageError, match=r"replace them by Pade approximations first: with_pade\(model, order\)"):
        MODEL.discretise(H)
    with pytest.raises(UsageError, match=r"outputs have shape \(5, 1\), expected \(5, 2\)"):
        MODEL.predict(np.zeros((5, 2)), np.zeros((5, 1)), H)
    with pytest.raises(UsageError, match="outputs hold values that are not finite"):
        MODEL.predict(np.zeros((5, 2)), np.full((5, 2), np.nan), H)


# ---- structures ----

FREQUENCIES = np.array([0.0, 20.0, 126.6, 400.0])


def test_rotor_bearing_with_exact_delays():
    exact = evaluate(RotorBearing(delay="exact"), {**KEY, **GAINS})
    assert exact.n_states == 4
    np.testing.assert_allclose(exact.delay, [KEY["tau_x"], KEY["tau_y"]])
    pade = evaluate(RotorBearing(pade_order=8), {**KEY, **GAINS})
    np.testing.assert_allclose(
        exact.frequency_response(FREQUENCIES), pade.frequency_response(FREQUENCIES), rtol=1e-9, atol=1e-15
    )
    np.testing.assert_allclose(exact.modes(), pade.modes()[:2], rtol=1e-9)
    np.testing.assert_array_equal(exact.K[2:4], [[3e4, -4e3], [2e3, 5e4]])
    u = piezo_motion(800)
    a, b = (m.simulate(u, TS, intersample="foh") for m in (exact, pade))
    np.testing.assert_allclose(a, b, atol=1e-4 * np.abs(b).max())


def test_wrong_words_for_a_delay_are_refused():
    with pytest.raises(UsageError, match="delay = 'none'; give 'exact', 'pade' or None"):
        RotorBearing(delay="none")
    with pytest.raises(UsageError, match="pade_order is for delay = 'pade'; exact delays have no order"):
        RotorBearing(delay="exact", pade_order=2)


def test_delays_are_exact_unless_an_order_is_given():
    assert RotorBearing() == RotorBearing(delay="exact")
    assert Plant().bearing.delay == "exact"
    assert RotorBearing(delay="pade") == RotorBearing(pade_order=1) != RotorBearing(pade_order=2)


LAG = LinearStructure(
    "lag",
    [Parameter(name) for name in ("a", "b", "c", "tau", "k")],
    lambda p: {
        "A": [[-p.a]],
        "B": [[p.b, 0]],
        "B_delayed": [[0, p.c]],
        "delay": [0, p.tau],
        "C": [[1]],
        "K": [[p.k]],
    },
)
LAG_AT = {"a": 1.5, "b": 0.7, "c": 2.0, "tau": 0.234, "k": 0.9}


@pytest.mark.parametrize("focus", ["prediction", "simulation"])
@pytest.mark.parametrize("holds", [("zoh", "foh"), ("foh", "zoh")])
@pytest.mark.parametrize("tau", [0.0, 0.04, 0.2, 0.234])
def test_the_predictor_is_that_of_the_model(focus, holds, tau):
    """The fit's recursion with its lagged regressors, in blocks, against the model's own predict."""
    values = {**LAG_AT, "tau": tau}
    predictor = build_predictor(LAG, {}, H, holds, focus)
    u, y, x0 = smooth(90, seed=6), smooth(90, 1, seed=7), np.array([[0.4]])
    at = predictor.at(np.array([values[q.name] for q in predictor.free]))
    blocks = cut(fit_data([(u, y)], H), predictor, None, longest_block=16)
    computed = y - blocks.by_segment(PortableLinearKernel().predict(at, blocks, x0).errors)[0]
    model = evaluate(LAG, values if focus == "prediction" else {**values, "k": 0.0})
    expected = model.predict(u, y, H, initial_state=x0[0], intersample=holds)
    np.testing.assert_allclose(computed, expected, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize(
    ("structure", "values", "h", "hold"),
    [
        (LAG, LAG_AT, H, ("foh", "foh")),
        (RotorBearing(delay="exact"), {**KEY, **GAINS}, TS, "foh"),
        (Plant(RotorBearing(delay="exact")), {**ACTUATORS, **KEY, **GAINS}, TS, "zoh"),
    ],
    ids=["lag", "rotor", "plant"],
)
def test_derivatives_of_the_predictor_by_all_parameters(structure, values, h, hold):
    predictor = build_predictor(structure, {}, h, hold, "prediction")
    theta = np.array([values[q.name] for q in predictor.free])
    at = predictor.at(theta)
    for i, q in enumerate(predictor.free):
        step = np.zeros(len(theta))
        step[i] = 1e-5 * abs(theta[i])
        plus, minus = predictor.at(theta + step), predictor.at(theta - step)
        assert plus.shift == minus.shift == at.shift
        for letter in "FGCH":
            a, b = getattr(plus, letter), getattr(minus, letter)
            expected = (a - b) / (2 * step[i])
            size = np.abs(expected).max(axis=1, keepdims=True)
            rounding = 1e-15 * np.abs(a).max(axis=1, keepdims=True) / step[i]
            error = np.abs(getattr(at, "d" + letter)[i] - expected)
            assert (error <= 1e-6 * size + 20 * rounding).all(), f"d{letter} by {q.name}"


def test_a_structure_with_a_delay_of_another_shape_is_refused():
    wrong = LinearStructure(
        "wrong",
        [Parameter("a", 1.0)],
        lambda p: {"A": [[-p.a]], "B": [[1]], "C": [[1]], "delay": [1, 2], "B_delayed": [[1]]},
    )
    with pytest.raises(UsageError, match=r"delay has shape \(2, 1\), expected \(1, 1\)"):
        evaluate(wrong, {"a": 1.0})
