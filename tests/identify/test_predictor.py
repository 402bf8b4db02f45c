"""The one-step-ahead predictor against a plain loop with scipy's exponential, its derivatives against differences."""

import casadi as ca
import numpy as np
import pytest
from compilers import NEEDS_COMPILER
from fit_cases import ACTUATORS, EVERY, EVERY_AT, KEY, MODE, MODE_AT, TS, H, fit_data, piezo_motion, predicted, smooth

from gbid.discretise import exact
from gbid.identify import predictor as predictors
from gbid.identify.disturbances import Disturbances, Trend
from gbid.identify.kernel.blocks import cut
from gbid.identify.kernel.linear import PortableLinearKernel
from gbid.identify.predictor import build_predictor
from gbid.structure import LinearStructure, Parameter, PiezoPair, Plant, RotorBearing, evaluate

GAINS = {"bd_xx": 3e4, "bd_xy": -4e3, "bd_yx": 2e3, "bd_yy": 5e4}
ROTOR_AT = {**KEY, **GAINS}
PIEZO_AT = {**ACTUATORS, "bd1_x": 9.0, "bd2_x": 8.0, "bd1_y": 7.0, "bd2_y": 6.0}


def predictor_of(structure, h=H, hold="zoh", focus="prediction", fixed=None):
    return build_predictor(structure, fixed or {}, h, hold, focus)


def theta_of(predictor, values):
    return np.array([values[q.name] for q in predictor.free])


def predictions(predictor, values, u, y, x0, h=H):
    """Outputs of the predictor run over one record as one window."""
    data = fit_data([(u, y)], h)
    blocks = cut(data, predictor, None)
    error = PortableLinearKernel().predict(predictor.at(theta_of(predictor, values)), blocks, np.atleast_2d(x0)).errors
    return y - blocks.by_segment(error)[0]


@pytest.mark.parametrize("focus", ["prediction", "simulation"])
@pytest.mark.parametrize("holds", [("zoh", "zoh"), ("foh", "foh"), ("zoh", "foh"), ("foh", "zoh")])
def test_predictions_are_those_of_the_plain_loop(focus, holds):
    u, y = smooth(60, seed=1), smooth(60, seed=2)
    x0 = np.array([0.4, -1.0])
    predictor = predictor_of(EVERY, hold=holds, focus=focus)
    computed = predictions(predictor, EVERY_AT, u, y, x0)
    expected = predicted(evaluate(EVERY, EVERY_AT), u, y, H, holds, x0, focus == "prediction")
    np.testing.assert_allclose(computed, expected, rtol=1e-10, atol=1e-12)
    assert predictor.feeds_back is (focus == "prediction")
    ahead = u[1:, [i for i, hold in enumerate(holds) if hold == "foh"]]  # u[k+1] follows u[k] where it is on a line
    np.testing.assert_array_equal(predictor.regressors(u, y, ())[:-1, 2 : 2 + ahead.shape[1]], ahead)
    assert predictor.regressors(u, y, ()).shape == (60, 2 + ahead.shape[1] + 2 * (focus == "prediction"))


@pytest.mark.parametrize(
    ("structure", "values", "h", "hold", "focus"),
    [
        (EVERY, EVERY_AT, H, ("zoh", "foh"), "prediction"),
        (EVERY, EVERY_AT, H, "foh", "simulation"),
        (MODE, {**MODE_AT, "l1": 0.4, "l2": -0.2}, H, "zoh", "prediction"),
        (RotorBearing(pade_order=1), ROTOR_AT, TS, "foh", "prediction"),
        (RotorBearing(pade_order=3), ROTOR_AT, TS, "zoh", "prediction"),
        (PiezoPair(disturbance_gain="full"), PIEZO_AT, TS, "zoh", "prediction"),
        (Plant(RotorBearing(pade_order=2)), {**ROTOR_AT, **ACTUATORS}, TS, "zoh", "prediction"),
    ],
    ids=["every-mixed", "every-simulation", "mode", "rotor", "rotor-pade-3", "piezo", "plant"],
)
def test_derivatives_are_those_of_central_differences(structure, values, h, hold, focus):
    predictor = predictor_of(structure, h, hold, focus)
    theta = theta_of(predictor, values)
    at = predictor.at(theta)
    n, n_y, n_p = predictor.n_states, predictor.n_outputs, len(theta)
    n_z = predictor.regressors(np.ones((9, predictor.n_inputs)), np.ones((9, n_y)), at.shift).shape[1]
    for letter, shape in (("F", (n, n)), ("G", (n, n_z)), ("C", (n_y, n)), ("H", (n_y, n_z))):
        assert getattr(at, letter).shape == shape
        computed = getattr(at, "d" + letter)
        assert computed.shape == (n_p, *shape)
        for i in range(n_p):
            step = np.zeros(n_p)
            step[i] = 1e-5 * abs(theta[i])
            plus, minus = (getattr(predictor.at(theta + sign * step), letter) for sign in (1, -1))
            expected = (plus - minus) / (2 * step[i])
            # Rows of positions and velocities differ by orders of magnitude: each has a size of its own.
            size = np.abs(expected).max(axis=1, keepdims=True)
            rounding = 1e-15 * np.abs(plus).max(axis=1, keepdims=True) / step[i]
            error = np.abs(computed[i] - expected)
            assert (error <= 1e-6 * size + 20 * rounding).all(), f"d{letter} by {predictor.free[i].name}"


DISTURBED = Disturbances(("p_x", "p_y"), (Trend(1), Trend(0, random_walk=True)), (50.0,))


@pytest.mark.parametrize("options", [{}, {"disturbances": DISTURBED}], ids=["plain", "hum"])
def test_several_points_at_once_are_each_by_itself(options):
    """Exact delays, too; a delay that is moved over a whole sample keeps the regressors of the first point."""
    structure = RotorBearing(delay="exact", disturbance_gain="full")
    predictor = build_predictor(structure, {}, TS, "foh", "prediction", **options)
    theta = np.array([{**KEY, **GAINS}.get(q.name, 0.3) for q in predictor.free])
    points = theta * (1 + 1e-4 * np.random.default_rng(6).normal(size=(4, len(theta))))
    for computed, point in zip(predictor.at_each(points), points, strict=True):
        expected = predictor.at(point)
        assert computed.shift == expected.shift
        for a, b in zip(computed[:8], expected[:8], strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-10, atol=1e-12 * np.abs(b).max(initial=0))
    delayed = [q.name for q in predictor.free].index("tau_x")
    kink = np.tile(theta, (3, 1))
    kink[:, delayed] = TS * np.array([1.0, 1.0 - 1e-9, 1.0 + 1e-9])
    at, before, after = predictor.at_each(kink)
    assert at.shift == before.shift == after.shift
    np.testing.assert_allclose(before.G + after.G, 2 * at.G, rtol=0, atol=1e-12 * np.abs(at.G).max())


def test_a_gain_of_zero_entries_is_no_feedback():
    predictor = predictor_of(RotorBearing(pade_order=1, disturbance_gain="none"), TS, "foh")
    assert not predictor.feeds_back
    assert predictor.regressors(piezo_motion(30), smooth(30), ()).shape == (30, 4)


def test_a_pole_that_grows_by_orders_of_magnitude_stays_exact():
    lag = LinearStructure("lag", [Parameter("a")], lambda p: {"A": [[-p.a]], "B": [[p.a]], "C": [[1]]})
    predictor = build_predictor(lag, {}, H, "zoh", "simulation")
    for a in (1.0, 20.0, 50.0, 1000.0):
        at = predictor.at(np.array([a]))
        np.testing.assert_allclose(at.F, [[np.exp(-a * H)]], rtol=1e-12, atol=1e-15)
        np.testing.assert_allclose(at.G, [[-np.expm1(-a * H)]], rtol=1e-12)
        np.testing.assert_allclose(at.dF[0], [[-H * np.exp(-a * H)]], rtol=1e-11, atol=1e-15)
        np.testing.assert_allclose(at.dG[0], [[H * np.exp(-a * H)]], rtol=1e-11, atol=1e-15)


def with_everything(n):
    """A structure of n states whose entries all depend on parameters: two prompt inputs, two delayed ones, x0, K."""
    random = np.random.default_rng(n)
    a, b, c, d, k, late, x0 = (
        random.normal(size=shape) for shape in ((n, n), (n, 4), (2, n), (2, 4), (n, 2), (n, 4), n)
    )

    def matrices(p):
        return {
            "A": p.a * ca.DM(a) - p.s * ca.DM.eye(n),
            "B": p.b * ca.sparsify(ca.DM(b * [1, 1, 0, 0])),
            "B_delayed": p.b * p.a * ca.sparsify(ca.DM(late * [1, 0, 0, 1])),
            "delay": [p.early, 0, 0, p.late],
            "C": p.c * ca.DM(c),
            "D": p.d * ca.sparsify(ca.DM(d * [1, 0, 1, 0])),
            "K": p.k * p.a * ca.DM(k),
            "x0": p.x * ca.DM(x0),
        }

    values = {"a": 0.8, "s": 2.0, "b": 0.6, "c": 1.1, "d": 0.2, "k": 0.3, "x": 0.5, "early": 0.4 * H, "late": 7.3 * H}
    return LinearStructure("all", [Parameter(q, v) for q, v in values.items()], matrices, "u", "y")


@NEEDS_COMPILER
@pytest.mark.parametrize("focus", ["prediction", "simulation"])
@pytest.mark.parametrize("holds", ["zoh", "foh", ("foh", "zoh", "foh", "foh")])
@pytest.mark.parametrize("n", [1, 2, 4, 7, 12])
def test_a_compiled_predictor_is_that_of_numpy(monkeypatch, n, holds, focus):
    """In every part, at one point and at several, and with inputs that are fewer: the formulas exist twice."""
    structure = with_everything(n)
    disturbances = Disturbances(("a", "b"), (Trend(2), Trend(0, random_walk=True)), (1.3,))
    options = {"disturbances": disturbances, "released": (True,) * n}
    for more in ({}, options):
        predictor = build_predictor(structure, {}, H, holds, focus, **more)
        theta = np.array([q.start or 0.3 for q in predictor.free])
        points = theta * np.linspace(1, 1 + 1e-6, 3)[:, None]
        with monkeypatch.context() as numpy_alone:
            expected = predictor.at(theta), *predictor.at_each(points)
            numpy_alone.setattr(predictors, "compiled", lambda _: None)
            numpy_alone.setattr(exact, "compiled", lambda _: None)
            computed = predictor.at(theta), *predictor.at_each(points)
        for ours, theirs in zip(computed, expected, strict=True):
            assert ours.shift == theirs.shift == (0, 7)
            for name in ("F", "G", "C", "H", "dF", "dG", "dC", "dH"):
                mine, other = getattr(ours, name), getattr(theirs, name)
                np.testing.assert_allclose(mine, other, rtol=0, atol=1e-13 * np.abs(other).max(), err_msg=name)
