"""Pade delays against the closed form of the polynomials, and their derivative."""

from fractions import Fraction
from math import factorial, pi

import casadi as ca
import numpy as np
import pytest

from gbid.core.errors import UsageError
from gbid.structure.delay import pade_delay

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


@pytest.mark.parametrize("order", ORDERS)
def test_transfer_function_is_the_pade_approximation_and_stable(order):
    """A rational function of order n is settled by 2n + 1 points; the closed form is an all-pass by its signs."""
    tau, omega_tau = 3e-4, np.linspace(0, 4 * order, 2 * order + 1)
    terms = np.array([[float(c) * (1j * x) ** k for k, c in enumerate(coefficients(order))] for x in omega_tau])
    expected = (terms * (-1.0) ** np.arange(order + 1)).sum(axis=1) / terms.sum(axis=1)
    np.testing.assert_allclose(response(tau, order, omega_tau / tau), expected, rtol=1e-9)
    assert (np.linalg.eigvals(numbers(tau, order)[0]).real < 0).all()


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
    values = np.array(jacobian(at)[1])[:, 0]
    plus, minus = (response(at + d, order, omega)[0] for d in (step, -step))
    expected = (plus - minus) / (2 * step)
    np.testing.assert_allclose(values[0] + 1j * values[1], expected, rtol=1e-7)
    np.testing.assert_allclose(np.array(jacobian(at)[0])[0, 0], response(at, order, omega)[0].real, rtol=1e-12)


@pytest.mark.parametrize("order", [0, -1])
def test_orders_below_one_are_refused(order):
    with pytest.raises(UsageError, match=f"Pade order {order}; it must be at least 1"):
        pade_delay(1e-3, order)
