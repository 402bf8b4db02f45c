"""Observer of a structure: the steady Kalman filter for assumed noise.

A predictor with this gain is stable for any detectable model, also for an unstable plant. Its errors depend smoothly on
the parameters, so that a fit with it converges from far away.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import casadi as ca
import numpy as np
from scipy.linalg import solve_discrete_are

from gbid.arrays import FloatArray
from gbid.discretise import discretise
from gbid.structure import LinearModel, LinearStructure, Parameter, Structure, symbolic_matrices

_LONGEST = 256  # samples of the observer's memory
_FLAT = 1e-12  # smallest information on a state, as a part of the largest


def observer_gain(model: LinearModel, sample_time: float, noise: FloatArray, reach: float) -> FloatArray | None:
    """Return the disturbance gain K of the steady Kalman filter for assumed noise.

    The measurement noise is as given. The process noise of a sample is what makes the filter's memory about as long as
    `reach` over the model's fastest rate: the covariance of a state that is known from so many samples alone, over
    their number.

    Parameters
    ----------
    model : LinearModel
        Model in continuous time; its own disturbance gain is not used.
    sample_time : float
        Time between samples [s].
    noise : (n_outputs,) array
        Assumed standard deviations of the measurement noise.
    reach : float
        Memory, in units of the time constant of the fastest mode.

    Returns
    -------
    (n, n_outputs) array or None
        Gain in continuous time; with a hold of one sample it is the filter's gain. None when the outputs do not observe
        an unstable state.
    """
    n = len(model.A)
    fastest = float(np.abs(np.linalg.eigvals(model.A)).max()) * sample_time
    memory = int(np.clip(reach / max(fastest, 1e-12), 2 * n, _LONGEST))
    held = discretise(model.A, np.eye(n), sample_time, ["zoh"] * n)
    F = held.F
    seen, rows = np.zeros((n, n)), model.C / noise[:, None]
    for _ in range(memory):
        seen += rows.T @ rows
        rows = rows @ F
    if not np.isfinite(seen).all():
        return None
    scale = np.sqrt(np.maximum(np.diag(seen), np.finfo(float).tiny))
    size, axes = np.linalg.eigh(seen / np.outer(scale, scale))
    Q = axes / np.maximum(size, _FLAT * size[-1]) @ axes.T / memory  # of states in units of 1 / scale
    step, out = F * scale[:, None] / scale, model.C / noise[:, None] / scale
    try:
        P = solve_discrete_are(step.T, out.T, Q, np.eye(len(noise)))
        filtered = np.linalg.solve(out @ P @ out.T + np.eye(len(noise)), out @ P @ step.T).T
        return np.asarray(np.linalg.solve(held.G_now, filtered / scale[:, None] / noise))
    except (np.linalg.LinAlgError, ValueError):  # scipy's error for eigenvalues that cannot be told apart
        return None


def with_gain(structure: Structure, gain: FloatArray) -> LinearStructure:
    """Return a structure with a given disturbance gain, (n, n_outputs), in place of its own."""

    def matrices(p: Any) -> Mapping[str, Any]:
        return {**structure.matrices(p), "K": gain}

    return LinearStructure(
        structure.name,
        structure.parameters,
        matrices,
        structure.inputs,
        structure.outputs,
        intersample=structure.intersample,
    )


def gain_parameters(
    structure: Structure, parameters: tuple[Parameter, ...], values: Mapping[str, float], gain: FloatArray
) -> dict[str, float]:
    """Return free parameters of the disturbance gain with which it is nearest to a given one, within their bounds.

    Parameters
    ----------
    structure : Structure
    parameters : tuple of Parameter
        Parameters with the fixed values and bounds of the fit.
    values : dict of str to float
        Values of the other parameters.
    gain : (n, n_outputs) array
        Gain to come near to, by least squares relative to its entries.

    Returns
    -------
    dict of str to float
        Empty for a structure without parameters of its own for the gain.
    """
    p, m = symbolic_matrices(structure)
    elsewhere = {symbol.name() for symbol in ca.symvar(ca.veccat(*m.besides_gain))}
    names = {symbol.name() for symbol in ca.symvar(m.K)} - elsewhere
    own = [i for i, q in enumerate(parameters) if not q.fixed and q.name in names]
    if not own:
        return {}
    at = np.array([values[q.name] for q in parameters], float)
    entries = ca.vec(ca.densify(m.K))
    function = ca.Function("gain", [p], [entries, ca.densify(ca.jacobian(entries, p))])
    wanted = gain.T.ravel()  # CasADi stacks columns
    weight = 1 / (np.abs(wanted) + 1e-3 * np.abs(wanted).max() + np.finfo(float).tiny)
    for _ in range(3):  # one is enough where the gain is linear in its parameters
        there, slopes = (np.asarray(v, float) for v in function(at))
        step = np.linalg.lstsq(slopes[:, own] * weight[:, None], (wanted - there[:, 0]) * weight, rcond=None)[0]
        at[own] = np.clip(at[own] + step, [parameters[i].lower for i in own], [parameters[i].upper for i in own])
    return {parameters[i].name: float(at[i]) for i in own}
