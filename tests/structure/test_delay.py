"""Pade delays against the closed form of the polynomials, and the properties of an all-pass."""

from fractions import Fraction
from math import factorial, pi

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gbid.core.errors import UsageError
from gbid.structure import pade_delay

ORDERS = range(1, 9)


def numbers(tau, order):
    """A, B, C, D as arrays."""
    return [np.array(ca.DM(m)) for m in pade_delay(tau, order)[:4]]


def response(tau, order, omega):
    A, B, C, D = numbers(tau, order)
    s = 1j * np.atleast_1d(omega)
    system = s[:, None, None] * np.eye(order) - A
    return (C @ np.linalg.solve(system, np.broadcast_to(B.astype(complex), (len(s), order, 1))) + D)[:, 0, 0]


def coefficients(n):
    """Denominator of the [n/n] Pade approximation of e^-s: (2n-k)! n! / ((2n)! k! (n-k)!) at s^k, exactly."""
    return [
        Fraction(factorial(2 * n - k) * factorial(n), factorial(2 * n) * factorial(k) * factorial(n - k))
        for k in range(n + 1)
    ]


def exact_value(n, s):
    """The approximation at a rational point."""
    terms = [c * s**k for k, c in enumerate(coefficients(n))]
    return sum((-1) ** k * t for k, t in enumerate(terms)) / sum(terms)


def solve_exactly(A, b):
    """Gauss with fractions."""
    rows = [[*map(Fraction, row), Fraction(v)] for row, v in zip(A, b, strict=True)]
    for i in range(len(rows)):
        pivot = next(r for r in range(i, len(rows)) if rows[r][i] != 0)
        rows[i], rows[pivot] = rows[pivot], rows[i]
        rows[i] = [v / rows[i][i] for v in rows[i]]
        for r in range(len(rows)):
            if r != i:
                rows[r] = [v - rows[r][i] * w for v, w in zip(rows[r], rows[i], strict=True)]
    return [row[-1] for row in rows]


@pytest.mark.parametrize("order", ORDERS)
def test_transfer_function_is_the_pade_approximation_exactly(order):
    """A rational function of order n is settled by 2n + 1 points; entries of a unit delay are integers."""
    A, B, C, D = (m.astype(int) for m in numbers(1.0, order))
    for m, unit in zip((A, B, C, D), numbers(1.0, order), strict=True):
        np.testing.assert_array_equal(m, unit)
    for j in range(2 * order + 1):
        s = Fraction(j + 1, 3)
        system = [[(s if r == c else 0) - int(A[r, c]) for c in range(order)] for r in range(order)]
        x = solve_exactly(system, [int(v) for v in B[:, 0]])
        found = sum(int(c) * v for c, v in zip(C[0], x, strict=True)) + int(D[0, 0])
        assert found == exact_value(order, s)


@pytest.mark.parametrize("order", ORDERS)
def test_poles_are_the_roots_of_the_denominator_and_stable(order):
    tau = 3e-4
    poles = np.linalg.eigvals(numbers(tau, order)[0])
    roots = np.roots([float(c) for c in reversed(coefficients(order))]) / tau
    assert (poles.real < 0).all()
    distance = np.abs(poles[:, None] - roots[None, :])
    assert distance.min(0).max() < 1e-5 * np.abs(roots).max()
    assert distance.min(1).max() < 1e-5 * np.abs(roots).max()


@settings(max_examples=60, deadline=None)
@given(order=st.integers(1, 8), tau=st.floats(1e-6, 1.0), omega_tau=st.floats(0, 1e3))
def test_all_frequencies_pass_with_gain_one(order, tau, omega_tau):
    assert abs(response(tau, order, omega_tau / tau)[0]) == pytest.approx(1, abs=1e-10)


@pytest.mark.parametrize("order", ORDERS)
def test_the_phase_is_that_of_the_delay_to_order_2n_plus_1(order):
    tau = 2e-4
    # Small, but above rounding; the leading term is (n!)^2 / ((2n)! (2n+1)!) (omega tau)^(2n+1).
    leading = factorial(order) ** 2 / (factorial(2 * order) * factorial(2 * order + 1))
    top = (1e-9 / leading) ** (1 / (2 * order + 1))
    x = top * np.array([0.7, 1.0])
    error = np.abs(response(tau, order, x / tau) - np.exp(-1j * x))
    slope = np.log(error[1] / error[0]) / np.log(x[1] / x[0])
    assert slope == pytest.approx(2 * order + 1, abs=0.35)
    assert error[0] == pytest.approx(leading * x[0] ** (2 * order + 1), rel=0.15)


@pytest.mark.parametrize("order", [1, 2, 3, 5])
def test_derivative_with_respect_to_the_delay(order):
    tau, omega = ca.SX.sym("tau"), 2 * pi * 200.0
    m = pade_delay(tau, order)
    assert m.K.nnz() == 0
    # (j omega I - A)^-1 in real form
    eye = omega * np.eye(order)
    system = ca.blockcat([[-m.A, -ca.SX(eye)], [ca.SX(eye), -m.A]])
    x = ca.solve(system, ca.vertcat(m.B, ca.SX(order, 1)))
    value = ca.vertcat(m.C @ x[:order] + m.D, m.C @ x[order:])
    jacobian = ca.Function("d", [tau], [value, ca.jacobian(value, tau)])
    at, step = 5e-4, 1e-8
    found = np.array(jacobian(at)[1])[:, 0]
    plus, minus = (response(at + d, order, omega)[0] for d in (step, -step))
    expected = (plus - minus) / (2 * step)
    np.testing.assert_allclose(found[0] + 1j * found[1], expected, rtol=1e-7)
    np.testing.assert_allclose(np.array(jacobian(at)[0])[0, 0], response(at, order, omega)[0].real, rtol=1e-12)


@pytest.mark.parametrize("order", [0, -1])
def test_orders_below_one_are_refused(order):
    with pytest.raises(UsageError, match=f"Pade order {order}; it must be at least 1"):
        pade_delay(1e-3, order)
