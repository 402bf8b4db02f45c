"""Time delay as a rational all-pass filter in state space."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
from scipy.linalg import block_diag

from gbid.core.errors import UsageError
from gbid.structure.linear import Matrices
from gbid.structure.models import LinearModel


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


# ---- Models with exact delays converted to Pade approximations.


def with_pade(model: LinearModel, order: int = 3) -> LinearModel:
    """Return a model whose exact input delays are replaced by Pade approximations, for eigenvalues and control loops.

    Parameters
    ----------
    model : LinearModel
        Model in continuous time; a model without delays is returned unchanged.
    order : int
        Order of the approximation.

    Returns
    -------
    LinearModel
        Model with `order` more states for each delayed input.

    Raises
    ------
    UsageError
        When the order is below 1.
    """
    if model.delay is None or model.B_delayed is None:
        return model
    late = [i for i in range(model.B.shape[1]) if model.B_delayed[:, i].any() and model.delay[i] > 0]
    prompt = np.setdiff1d(np.arange(model.B.shape[1]), late)
    parts = [pade_delay(float(model.delay[i]), order) for i in late]
    A_tau, B_tau, C_tau, D_tau = (
        block_diag(*(np.asarray(ca.DM(getattr(part, letter)), float) for part in parts)) if parts else np.zeros((0, 0))
        for letter in "ABCD"
    )
    n, n_tau = model.n_states, len(A_tau)
    B = np.array(model.B)
    B[:, prompt] += model.B_delayed[:, prompt]
    into = np.zeros((n_tau, B.shape[1]))
    if late:
        B[:, late] += model.B_delayed[:, late] @ D_tau
        into[:, late] = B_tau
    drive = model.B_delayed[:, late] @ C_tau if late else np.zeros((n, 0))
    names = tuple(f"delay_{model.input_names[i]}_{k + 1}" for i in late for k in range(order))
    return replace(
        model,
        A=np.block([[model.A, drive], [np.zeros((n_tau, n)), A_tau]]),
        B=np.vstack([B, into]),
        C=np.hstack([model.C, np.zeros((model.C.shape[0], n_tau))]),
        K=None if model.K is None else np.vstack([model.K, np.zeros((n_tau, model.K.shape[1]))]),
        state_names=(*model.state_names, *names),
        B_delayed=None,
        delay=None,
    )


# ---- Symbolic matrices whose exact delays are replaced by Padé filters.


def pade_matrices(m: Matrices, order: int) -> Matrices:
    """Return the matrices without exact delays: the signal of each delayed input passes a Padé filter.

    In a loop the delayed signal is not known in advance, so the delay must be a part of the state.

    Parameters
    ----------
    m : Matrices
        Matrices of a structure; without exact delays they are returned unchanged.
    order : int
        Order of the filters; each adds as many states for each delayed input, after those of the structure.
    """
    if not m.has_delay:
        return m
    late = sorted(set(m.B_delayed.sparsity().get_triplet()[1]))
    filters = [pade_delay(m.delay[i], order) for i in late]
    A, B, C, D = (ca.diagcat(*(getattr(each, letter) for each in filters)) for letter in "ABCD")
    n, n_u, n_y, added = m.A.shape[0], m.B.shape[1], m.C.shape[0], order * len(late)
    into = ca.SX(len(late), n_u)
    for row, i in enumerate(late):
        into[row, i] = 1
    drive = m.B_delayed[:, late]
    return Matrices(
        A=ca.blockcat([[m.A, drive @ C], [ca.SX(added, n), A]]),
        B=ca.vertcat(m.B + drive @ D @ into, B @ into),
        C=ca.horzcat(m.C, ca.SX(n_y, added)),
        D=m.D,
        K=ca.vertcat(m.K, ca.SX(added, n_y)),
        B_delayed=ca.SX(n + added, n_u),
        delay=ca.SX(0, 1),
        x0=ca.vertcat(m.x0, ca.SX(added, 1)) if m.x0.numel() else m.x0,
    )
