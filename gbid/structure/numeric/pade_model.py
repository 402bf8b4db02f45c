"""Models with exact delays converted to Pade approximations."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
from scipy.linalg import block_diag

from gbid.structure.delay import pade_delay
from gbid.structure.numeric.linear_model import LinearModel


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
