"""Errors and notes on nonlinear structures that are wrong, overflow, or have parts without effect."""

import casadi as ca
import numpy as np
import pytest
from nonlinear_cases import DUFFING, duffing_recording

import gbid
from gbid import NonlinearStructure, Parameter
from gbid.core.errors import DataError, UsageError

K = [Parameter("k", 1.0)]


def _made(dynamics, output=lambda x, u, p: x[0], parameters=K, **more):
    return NonlinearStructure("mine", parameters, ["x", "v"], dynamics, output, **more)


@pytest.mark.parametrize(
    ("structure", "text"),
    [
        (_made(lambda x, u, p: [x[1]]), r"dynamics\(x, u, p\) returns 1 expressions, one for each state is needed: 2"),
        (_made(lambda x, u, p: [x[1], "fast"]), r"returns list, which is no CasADi expression"),
        (_made(lambda x, u, p: [x[1], float(x[0])]), "dynamics contains nan: a function that is not casadi's"),
        (_made(lambda x, u, p: [x[1], -p.q * x[0]]), "no parameter 'q'; choose from k"),
        (_made(lambda x, u, p: [x[1], -p.k * x[0] + ca.SX.sym("w")]), "contains unknown symbols: w"),
        (_made(lambda x, u, p: [x[1], -p.k * x[0]], lambda x, u, p: x), "output.* returns 2 expressions"),
        (_made(lambda x, u, p: [x[1], -p.k * x[0]], disturbance_gain=lambda p: [p.k]), r"has shape \(1, 1\), expected"),
        (
            _made(lambda x, u, p: [x[1], u[0]], delay=lambda p: [p.k, 0]),
            r"delay\(p\) returns 2 expressions, one",
        ),
        (_made(lambda x, u, p: [x[1], u[0]], lambda x, u, p: u[0], delay=lambda p: p.k), "output contains the delayed"),
        (_made(lambda x, u, p: [x[1], u[0] - x[0]]), "equations do not contain the parameter k"),
        (_made(lambda x, u, p: [x[1], u[0] - p.k * ca.log(-1 - x[0] ** 2)]), "equations have no finite value"),
    ],
)
def test_what_is_wrong_with_the_equations_is_named(structure, text):
    with pytest.raises(UsageError, match=text):
        gbid.fit(structure, duffing_recording(0, n=100))


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"integrator": "euler"}, "integrator = 'euler'; choose 'rk4' or 'implicit'"),
        ({"steps": 0}, "steps = 0; give a number from 1 to 256 or 'auto'"),
        ({"disturbance_gain": [[1.0], [0.0]]}, "disturbance_gain = .*; give a function or None"),
        ({"delay": 0.1}, "delay = 0.1; give a function or None"),
    ],
)
def test_options_of_a_structure_are_checked(change, text):
    with pytest.raises(UsageError, match=text):
        _made(lambda x, u, p: [x[1], -p.k * x[0]], **change)


def test_parameters_without_effect_in_the_data_are_named():
    def spring(x, u, p):
        return [x[1], u[0] - 0.2 * x[1] - p.k * x[0] - 0.5 * x[0] ** 3 + p.w * (p.k - p.k)]

    with pytest.raises(UsageError, match="do not contain the parameter w"):
        gbid.fit(_made(spring, parameters=[*K, Parameter("w", 1.0)]), duffing_recording(0, n=200))
    silent = _made(
        lambda x, u, p: [x[1], u[0] - 0.2 * x[1] - p.k * x[0] - 0.5 * x[0] ** 3 + p.g * u[1]],
        parameters=[*K, Parameter("g", 1.0)],
        inputs=("u", "w"),
    )
    recording = duffing_recording(0, n=200)
    zero = np.zeros_like(recording.signal("u"))
    with pytest.raises(DataError, match="determine g"):
        gbid.fit(silent, gbid.Recording({**recording.signals, "w": zero}, 0.1, name="still"))


def test_a_jump_is_said_and_works():
    def slide(x, u, p):
        return [x[1], u[0] - 0.2 * x[1] - p.k * x[0] - ca.if_else(x[0] > 0, 0.5, 0.4) * x[0] ** 3]

    truth = _made(slide, parameters=[Parameter("k", 1.3)])
    from gbid.structure import nonlinear_model

    u = duffing_recording(0, n=300).signal("u")
    y = nonlinear_model(truth, {"k": 1.0}, steps=8).simulate(u, 0.1)
    y = y + 0.01 * np.random.default_rng(0).normal(size=y.shape)
    result = gbid.fit(truth, gbid.Recording({"u": u, "y": y}, 0.1, name="slide"))
    assert abs(result.parameters["k"] - 1.0) < 4 * result.std["k"]
    assert any("jumps or kinks (<, if_else)" in note for note in result.notes)


def test_a_model_that_overflows_is_fitted_in_shorter_windows():
    far = gbid.fit(DUFFING, duffing_recording(1, n=400), start={"c": -3.0, "k": -2.0})
    near = gbid.fit(DUFFING, duffing_recording(1, n=400))
    assert any("windows" in note for note in far.notes)
    assert far.success
    assert far.parameters["c"] == pytest.approx(near.parameters["c"], rel=1e-4)


def test_random_starts_of_equations_without_a_value_there_are_counted_as_such():
    def spring(x, u, p):
        return [x[1], u[0] - 0.2 * x[1] - ca.sqrt(p.k) * x[0]]

    structure = _made(spring, parameters=[Parameter("k", 1.0)])
    multistart = gbid.fit_multistart(structure, duffing_recording(0, n=100), starts=5, reach=3.0, seed=1)
    assert 0 < np.isnan(multistart.losses).sum() < 4  # negative k
    assert multistart.best.multi_start.starts == 5
    assert (
        sorted(i for m in multistart.minima for i in m.starts) == np.flatnonzero(~np.isnan(multistart.losses)).tolist()
    )
    with pytest.raises(UsageError, match="no search for start values in the data"):
        gbid.fit(structure, duffing_recording(0, n=100), start="data")


def test_one_state_and_one_dimensional_signals():
    leak = NonlinearStructure("leak", K, "x", lambda x, u, p: u[0] - p.k * x[0], lambda x, u, p: x[0])
    recording = duffing_recording(0, n=100)
    u = recording.signal("u")
    from gbid.structure import nonlinear_model

    model = nonlinear_model(leak, {"k": 1.3}, steps=4)
    y = model.simulate(u[:, 0], 0.1)
    np.testing.assert_array_equal(model.predict(u[:, 0], y[:, 0], 0.1), y)
    result = gbid.fit(leak, gbid.Recording({"u": u, "y": y}, 0.1, name="leak"))
    assert result.parameters["k"] == pytest.approx(1.3, rel=1e-3)
