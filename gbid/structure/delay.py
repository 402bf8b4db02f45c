"""Time delay as a rational all-pass filter in state space."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from gbid.errors import UsageError
from gbid.structure.linear import Matrices


def pade_delay(tau: Any, order: int = 1) -> Matrices:
    """Return the diagonal Pade approximation of ``e^(-tau s)`` in state space, of any order, without polynomials.

    Parameters
    ----------
    tau : casadi.SX or float
        Delay [s].
    order : int
        Order, at least 1; order 1 is Eq. 9 of the paper.

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
    The starting point is ``e^(-s) = (1 - tanh(s/2)) / (1 + tanh(s/2))``. Lambert's continued fraction ``tanh(s/2) =
    1/(2/s + 1/(6/s + 1/(10/s + ...)))``, truncated after n terms, gives the [n/n] Pade approximation. The continued
    fraction is a ladder of integrators with the gains 2, 6, 10, ..., 4n - 2. Its state-space matrices have small
    integers as entries, all divided by tau. So they are well scaled at every order, while the coefficients of the Pade
    polynomials grow like factorials.
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
        ca.SX(0, 1),
    )


def _unit_ladder(order: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Return the matrices of the approximation of a unit delay.

    The ladder has a "current" i and a "voltage" v = tanh(s/2) i. Its input is w = i + v, its output is i - v. The
    odd-numbered states sum to i, the even-numbered ones to v. The side of the last element is computed from the input w
    minus the sum of the other side.
    """
    k = np.arange(1, order + 1)
    gain = 4.0 * k - 2.0
    driven = k % 2 == order % 2  # the states on the side of the last element, which have w as input
    A = np.zeros((order, order))
    for row in range(order):
        if driven[row]:
            A[row] = -driven.astype(float)  # w minus the sum of the states on this side
            A[row, :row] -= ~driven[:row]  # minus the preceding states of the other side
        else:
            A[row, row + 1 :] = driven[row + 1 :]
    sign = -1.0 if order % 2 else 1.0
    b = driven.astype(float)
    c = -2.0 * sign * driven
    return gain[:, None] * A, (gain * b)[:, None], c[None, :], sign
