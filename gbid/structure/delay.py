"""Padé approximation of a time delay: a rational all-pass filter in state space."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np

from gbid.core.errors import UsageError
from gbid.structure.linear import LoopParts, Matrices, constant_like
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
    A, b, c, d = unit_ladder(order)
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


def unit_ladder(order: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Return the state-space matrices of the Padé approximation of a delay of one.

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


def with_filters(plant: LoopParts, B_delayed: Any, delays: Mapping[int, Any], order: int) -> LoopParts:
    """Return a plant with Padé filters at its delayed inputs; casadi.SX or arrays.

    Parameters
    ----------
    plant : LoopParts
        The plant without its delayed inputs.
    B_delayed : (n, n_inputs) casadi.SX or array
        Input matrix of the delayed inputs.
    delays : dict of int to casadi.SX or float
        Delay of each delayed input [s], by the column of `B_delayed`.
    order : int
        Order of the filters; each adds as many states, which follow those of the plant.
    """
    if not delays:
        return plant
    filters = [pade_delay(delay, order) for delay in delays.values()]
    A, B, C, D = (ca.diagcat(*(getattr(each, letter) for each in filters)) for letter in "ABCD")
    if not isinstance(plant.A, ca.SX):
        A, B, C, D = (np.asarray(ca.DM(matrix), float) for matrix in (A, B, C, D))
    n, n_all, n_u = plant.A.shape[0], plant.A.shape[0] + A.shape[0], plant.B.shape[1]
    x_in, z_in, chosen = (
        constant_like(plant.A, matrix) for matrix in (np.eye(n_all, n), np.eye(n_all)[:, n:], np.eye(n_u)[list(delays)])
    )
    drive = B_delayed @ chosen.T
    return LoopParts(
        x_in @ (plant.A @ x_in.T + drive @ C @ z_in.T) + z_in @ A @ z_in.T,
        x_in @ (plant.B + drive @ D @ chosen) + z_in @ B @ chosen,
        plant.C @ x_in.T,
        plant.D,
        x_in @ plant.K,
    )


def with_pade(model: LinearModel, order: int = 3) -> LinearModel:
    """Return a model with Padé approximations of its exact input delays, for eigenvalues and control loops.

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
    delayed = model.B_delayed.any(axis=0) & (model.delay > 0)
    delays = {int(i): float(model.delay[i]) for i in np.flatnonzero(delayed)}
    K = np.zeros((model.n_states, len(model.C))) if model.K is None else model.K
    plant = LoopParts(model.A, model.B + np.where(delayed, 0.0, model.B_delayed), model.C, model.D, K)
    A, B, C, D, K = with_filters(plant, model.B_delayed, delays, order)
    names = tuple(f"delay_{model.input_names[i]}_{k + 1}" for i in delays for k in range(order))
    return replace(
        model,
        A=A,
        B=B,
        C=C,
        D=D,
        K=None if model.K is None else K,
        state_names=(*model.state_names, *names),
        B_delayed=None,
        delay=None,
    )


def pade_matrices(m: Matrices, order: int) -> Matrices:
    """Return the matrices with a Padé filter at each delayed input, without exact delays.

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
    delays = {i: m.delay[i] for i in sorted(set(m.B_delayed.sparsity().get_triplet()[1]))}
    parts = with_filters(LoopParts(m.A, m.B, m.C, m.D, m.K), m.B_delayed, delays, order)
    n, added = parts.A.shape[0], parts.A.shape[0] - m.A.shape[0]
    return m._replace(
        **parts._asdict(),
        B_delayed=ca.SX(n, m.B.shape[1]),
        delay=ca.SX(0, 1),
        x0=ca.vertcat(m.x0, ca.SX(added, 1)) if m.x0.numel() else m.x0,
    )
