"""Matrices with derivatives: every operation, and discretisation as a whole, against finite differences."""

import numpy as np
import pytest

from gbid.discretise import delayed_taps, discretise
from gbid.discretise.dual import Dual, constant, side_by_side

STEP = 1e-6
N_P = 3
RANDOM = np.random.default_rng(7)
X0 = {name: RANDOM.normal(size=shape) for name, shape in {"A": (3, 3), "B": (3, 2), "s": (1, 1), "row": (1, 2)}.items()}
TURN = {name: RANDOM.normal(size=(N_P, N_P, *value.shape)) for name, value in X0.items()}
SLOPE = {name: RANDOM.normal(size=(N_P, *value.shape)) for name, value in X0.items()}


def value_at(name, theta):
    """A matrix that depends on the parameters to second order."""
    linear = np.tensordot(theta, SLOPE[name], 1)
    return X0[name] + linear + 0.5 * np.tensordot(theta, np.tensordot(theta, TURN[name], 1), 1)


def dual_at(name, theta):
    """The same with its exact derivatives."""
    turn = 0.5 * (np.tensordot(theta, TURN[name], 1) + np.tensordot(theta, TURN[name].swapaxes(0, 1), 1))
    return Dual(value_at(name, theta), SLOPE[name] + turn)


AT = np.array([0.3, -0.2, 0.1])
M = RANDOM.normal(size=(2, 3))
OPERATIONS = {
    "input": lambda x: x("B"),
    "dual @ dual": lambda x: x("A") @ x("B"),
    "dual @ array": lambda x: x("B") @ M,
    "array @ dual": lambda x: M @ x("B"),
    "dual + dual": lambda x: x("A") + x("A") @ x("A"),
    "dual + array": lambda x: x("A") + np.eye(3),
    "array + dual": lambda x: np.eye(3) + x("A"),
    "dual - dual": lambda x: x("B") - x("A") @ x("B"),
    "dual - array": lambda x: x("A") - 2.0 * np.eye(3),
    "array - dual": lambda x: np.eye(3) - x("A"),
    "number - dual": lambda x: 1.5 - x("s"),
    "minus dual": lambda x: -x("A"),
    "dual * number": lambda x: x("A") * 3.0,
    "number * dual": lambda x: 3.0 * x("A"),
    "dual / number": lambda x: x("A") / 8.0,
    "dual * scalar dual": lambda x: x("A") * x("s"),
    "scalar dual squared": lambda x: x("A") * x("s") * x("s"),
    "dual * row": lambda x: x("B") * x("row"),
}


def differences(function, theta):
    """Central differences of an array by the parameters, (n_p, ...)."""
    steps = STEP * np.eye(len(theta))
    return np.array([(function(theta + s) - function(theta - s)) / (2 * STEP) for s in steps])


@pytest.mark.parametrize("what", OPERATIONS)
def test_operations(what):
    operation = OPERATIONS[what]
    computed = operation(lambda name: dual_at(name, AT))
    assert isinstance(computed, Dual)

    def plain(theta):
        return operation(lambda name: value_at(name, theta))

    np.testing.assert_array_equal(computed.value, plain(AT))
    assert computed.shape == computed.value.shape
    np.testing.assert_allclose(computed.slope, differences(plain, AT), rtol=1e-7, atol=1e-8)


def test_columns_and_joining():
    B, A = dual_at("B", AT), dual_at("A", AT)
    joined = side_by_side([B, A])
    np.testing.assert_array_equal(joined.value, np.hstack([B.value, A.value]))
    np.testing.assert_array_equal(joined.slope, np.concatenate([B.slope, A.slope], axis=2))
    for index in ([1], [1, 0], slice(0, 2), slice(3, None), []):
        part = joined.columns(index)
        np.testing.assert_array_equal(part.value, joined.value[:, index])
        np.testing.assert_array_equal(part.slope, joined.slope[:, :, index])


def test_a_constant_has_no_derivatives():
    computed = constant(X0["A"], N_P)
    np.testing.assert_array_equal(computed.value, X0["A"])
    assert computed.slope.shape == (N_P, 3, 3)
    assert not computed.slope.any()


@pytest.mark.parametrize("hold", ["zoh", "foh", ("zoh", "foh")])
@pytest.mark.parametrize("h", [0.05, 2.0])
def test_discretisation(hold, h):
    computed = discretise(dual_at("A", AT), dual_at("B", AT), h, hold)
    for i, part in enumerate(computed):

        def plain(theta, i=i):
            return discretise(value_at("A", theta), value_at("B", theta), h, hold)[i]

        np.testing.assert_allclose(part.value, plain(AT), rtol=1e-13, atol=1e-14)
        expected = differences(plain, AT)
        np.testing.assert_allclose(part.slope, expected, rtol=1e-6, atol=1e-7 * max(np.abs(expected).max(), 1))


@pytest.mark.parametrize("hold", ["zoh", "foh"])
@pytest.mark.parametrize("delay", [0.013, 0.05, 0.247])
def test_delayed_taps(hold, delay):
    """By the matrix, the input column and the delay together."""
    h = 0.1

    def at(theta, pick):
        tau = np.array([[delay]]) + 1e-3 * (pick("s", theta) - value_at("s", AT))
        return pick("A", theta), pick("B", theta)[:, [0]] if pick is value_at else pick("B", theta).columns([0]), tau

    A, b, tau = at(AT, dual_at)
    computed = delayed_taps(A, b, tau, h, hold)

    def plain(theta):
        A, b, tau = at(theta, value_at)
        taps = delayed_taps(A, b, float(tau[0, 0]), h, hold)
        assert taps.shift == computed.shift
        return np.hstack(taps.columns)

    np.testing.assert_allclose(np.hstack([c.value for c in computed.columns]), plain(AT), rtol=1e-13, atol=1e-15)
    slope = np.concatenate([c.slope for c in computed.columns], axis=2)
    np.testing.assert_allclose(slope, differences(plain, AT), rtol=1e-6, atol=1e-8)
