"""A time delay as a rational all-pass filter in state space."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from gbid.errors import UsageError
from gbid.structure.linear import Matrices


def pade_delay(tau: Any, order: int = 1) -> Matrices:
    """Diagonal Pade approximation of ``e^(-tau s)``, of any order, without polynomials.

    Parameters
    ----------
    tau : casadi.SX or float
        Delay [s].
    order : int
        Order, at least 1; order 1 is the paper's Eq. 9.

    Returns
    -------
    Matrices
        A (order, order), B (order, 1), C (1, order), D (1, 1), and an empty K.

    Raises
    ------
    UsageError
        When the order is below 1.

    Notes
    -----
    ``e^(-s) = (1 - tanh(s/2)) / (1 + tanh(s/2))``, and Lambert's continued fraction
    ``tanh(s/2) = 1/(2/s + 1/(6/s + 1/(10/s + ...)))`` cut off after n terms gives the [n/n] Pade
    approximation. Read as a ladder of integrators with gains 2, 6, 10, ..., 4n - 2, it is a realisation
    with small integers as entries, all divided by tau: well scaled at every order, where the coefficients of
    the Pade polynomials grow like factorials.
    """
    if order < 1:
        raise UsageError(f"Pade order {order}; it must be at least 1")
    A, b, c, d = _unit_ladder(order)
    nothing = ca.SX(order, 1)
    return Matrices(
        ca.SX(ca.sparsify(ca.DM(A))) / tau,
        ca.SX(ca.DM(b)) / tau,
        ca.SX(ca.DM(c)),
        ca.SX(d),
        nothing,
        nothing,
        ca.SX(0, 1),
    )


def _unit_ladder(order: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Matrices of the approximation of a unit delay.

    The ladder has a "current" i and a "voltage" v = tanh(s/2) i, driven by w = i + v; its output is i - v.
    Odd states sum to i, even ones to v; which of the two follows from w - (the other) depends on the last
    element's side.
    """
    k = np.arange(1, order + 1)
    gain = 4.0 * k - 2.0
    driven = k % 2 == order % 2  # the states fed by w: those on the side of the last element
    A = np.zeros((order, order))
    for row in range(order):
        if driven[row]:
            A[row] = -driven.astype(float)  # w minus the sum of the driven side
            A[row, :row] -= ~driven[:row]  # minus what the ladder before it has taken
        else:
            A[row, row + 1 :] = driven[row + 1 :]
    sign = -1.0 if order % 2 else 1.0
    b = driven.astype(float)
    c = -2.0 * sign * driven
    return gain[:, None] * A, (gain * b)[:, None], c[None, :], sign
