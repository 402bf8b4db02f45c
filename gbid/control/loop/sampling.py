"""Discretisation of plants (exact) and controllers (Tustin or zero-order hold)."""

from __future__ import annotations

from dataclasses import replace
from math import ceil, isfinite
from typing import Literal

import numpy as np
from scipy.linalg import expm

from gbid.arrays import FloatArray
from gbid.discretise import delayed_taps
from gbid.errors import UsageError
from gbid.structure import LinearModel

Method = Literal["tustin", "zoh"]


MOST_SAMPLES = 300
"""Largest delay of a sampled loop, in samples: each of them is a state for every input."""


def sample_plant(plant: LinearModel, sample_time: float, computation_s: float = 0.0) -> LinearModel:
    """Return the exact discretisation of a plant with held inputs, exact delays and computation time.

    Parameters
    ----------
    plant : LinearModel
        Continuous plant; may have exact delays.
    sample_time : float
        T_s [s].
    computation_s : float
        Time from the sample of p to the change of r [s]; all inputs are delayed by it.

    Returns
    -------
    LinearModel
        Sampled plant; earlier inputs that still have an effect are states.

    Raises
    ------
    UsageError
        When the plant is sampled already, when the sample time is not positive, when the computation time is
        negative, or when computation and delays take more than `MOST_SAMPLES` samples.
    """
    if plant.dt is not None:
        raise UsageError(f"model {plant.name!r} is sampled already, at {plant.dt:g} s")
    if not (isfinite(sample_time) and sample_time > 0):
        raise UsageError(f"sampling of {plant.name!r}: sample_time = {sample_time} s; give a positive number")
    late_s = computation_s + (0.0 if plant.delay is None else float(np.max(plant.delay)))
    if late_s > MOST_SAMPLES * sample_time:
        raise UsageError(
            f"sampling of {plant.name!r}: computation and delays take {late_s:g} s, more than {MOST_SAMPLES} samples "
            f"of sample_time = {sample_time:g} s; all are in seconds"
        )
    if not (isfinite(computation_s) and computation_s >= 0):
        raise UsageError(f"sampling of {plant.name!r}: computation_s = {computation_s} s; it must not be negative")
    A, n_u = np.array(plant.A), plant.B.shape[1]
    prompt = ceil(computation_s / sample_time - 1e-9)  # delay of the direct feedthrough D u in samples
    weights: dict[tuple[int, int], FloatArray] = {}  # (samples back, input) -> column of the states
    for i in range(n_u):
        parts = [(plant.B[:, [i]], 0.0)]
        if plant.delay is not None and plant.B_delayed is not None:
            parts.append((plant.B_delayed[:, [i]], float(plant.delay[i])))
        for column, delay in parts:
            if not column.any():
                continue
            late = (delay + computation_s) / sample_time
            late = round(late) if abs(late - round(late)) < 1e-9 else late  # avoids rounding errors at whole samples
            shift, taps = delayed_taps(A, column, late * sample_time, sample_time, "zoh")
            for j, tap in enumerate(taps):
                if np.any(tap):
                    key = (shift - 1 + j, i)
                    weights[key] = weights.get(key, np.zeros((len(A), 1))) + tap
    depth = max([back for back, _ in weights] + [prompt if plant.D.any() else 0], default=0)
    return _with_registers(plant, expm(A * sample_time), weights, prompt, depth, sample_time)


def sample_controller(controller: LinearModel, sample_time: float, method: Method = "tustin") -> LinearModel:
    """Return a sampled controller.

    Parameters
    ----------
    controller : LinearModel
        Continuous controller.
    sample_time : float
        T_s [s].
    method : {"tustin", "zoh"}
        The trapezoidal rule (Tustin), which interpolates p linearly and adds no delay, or zero-order hold of p, which
        adds a delay of half a sample.

    Returns
    -------
    LinearModel

    Raises
    ------
    UsageError
        When the method is unknown, when the controller is sampled already, or when the sample time is not positive.
    """
    if method == "zoh":
        return controller.discretise(sample_time)
    if method != "tustin":
        raise UsageError(f"method = {method!r}; choose 'tustin' or 'zoh'")
    if controller.dt is not None:
        raise UsageError(f"model {controller.name!r} is sampled already, at {controller.dt:g} s")
    if not (isfinite(sample_time) and sample_time > 0):
        raise UsageError(f"sampling of {controller.name!r}: sample_time = {sample_time} s; give a positive number")
    A, h = np.array(controller.A), sample_time
    eye = np.eye(len(A))
    solve = np.linalg.solve(eye - h / 2 * A, np.hstack([eye + h / 2 * A, h * controller.B]))
    F, G = solve[:, : len(A)], solve[:, len(A) :]
    C = np.linalg.solve((eye - h / 2 * A).T, controller.C.T).T
    D = controller.D + C @ controller.B * (h / 2)
    A, B, C, D = (np.asarray(matrix, np.float64) for matrix in (F, G, C, D))
    return replace(controller, A=A, B=B, C=C, D=D, K=None, dt=h)


def _with_registers(
    plant: LinearModel,
    F: FloatArray,
    weights: dict[tuple[int, int], FloatArray],
    prompt: int,
    depth: int,
    sample_time: float,
) -> LinearModel:
    """Return the plant with shift registers: the states after x are u[k-1], u[k-2], ..., u[k-depth]."""
    n, n_u = len(F), plant.B.shape[1]
    A = np.zeros((n + depth * n_u,) * 2)
    B = np.zeros((len(A), n_u))
    C, D = np.hstack([plant.C, np.zeros((len(plant.C), depth * n_u))]), np.zeros(plant.D.shape)
    A[:n, :n] = F
    for (back, i), column in weights.items():
        if back == 0:
            B[:n, i] += column[:, 0]
        else:
            A[:n, n + (back - 1) * n_u + i] += column[:, 0]
    if depth:
        B[n : n + n_u] = np.eye(n_u)
        A[n + n_u :, n:-n_u] += np.eye((depth - 1) * n_u)
    if prompt:
        C[:, n + (prompt - 1) * n_u : n + prompt * n_u] += plant.D if plant.D.any() else 0.0
    else:
        D = np.array(plant.D)
    held = tuple(f"{name}_before_{k + 1}" for k in range(depth) for name in plant.input_names)
    return LinearModel(
        A,
        B,
        C,
        D,
        dt=sample_time,
        input_names=plant.input_names,
        output_names=plant.output_names,
        state_names=(*plant.state_names, *held),
        name=f"{plant.name}, sampled",
    )
