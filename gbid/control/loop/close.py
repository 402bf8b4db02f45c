"""Closed loop of plant and controller, smallest damping factor, force input, and discretisation."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import replace
from math import ceil, inf, isfinite, pi
from typing import Literal

import numpy as np
import scipy

from gbid.core.arrays import FloatArray, is_real
from gbid.core.errors import UsageError
from gbid.discretise.exact import delayed_taps
from gbid.structure import LinearModel


def close_loop(plant: LinearModel, controller: LinearModel) -> LinearModel:
    """Return the closed loop with the sign of the paper, ``r = K p`` (Eqs. 21 and 22): positive feedback.

    The output of the controller is added to the input of the plant without a change of sign. So negative feedback
    needs a controller that contains the minus sign. For an external input w at the input of the plant,

    .. math:: p = G (w + K p) = (I - G K)^{-1} G w = S_o G w

    Parameters
    ----------
    plant : LinearModel
        G, from r to p.
    controller : LinearModel
        K, from p to r.

    Returns
    -------
    LinearModel
        ``S_o G``, from w to p; states of the plant, then of the controller. Disturbance gains (`K` of either
        model) are left out, because they describe prediction errors of a fit.

    Raises
    ------
    UsageError
        When sizes, channel names or sample times do not fit together, or when the loop is not well posed
        (``I - D_K D_G`` is singular).
    """
    loop = loop_with_disturbances(plant, controller)
    n_p, n_r = plant.D.shape
    return replace(
        loop,
        B=loop.B[:, :n_r],
        C=loop.C[:n_p],
        D=loop.D[:n_p, :n_r],
        input_names=plant.input_names,
        output_names=plant.output_names,
    )


def loop_with_disturbances(plant: LinearModel, controller: LinearModel) -> LinearModel:
    r"""Return the closed loop from (w, d), added to r and to p, to (p, r); raises as `close_loop`.

    .. math:: p = G r + d, \quad r = K p + w, \qquad
              r = M (C_K x_K + D_K C_G x_G + w + D_K d), \quad M = (I - D_K D_G)^{-1}
    """
    _check_fit(plant, controller)
    n_p, n_r = plant.D.shape
    direct = np.eye(n_r) - controller.D @ plant.D
    # the tolerance is relative to the terms that may cancel, not to their sum
    scale = 1.0 + float(np.abs(controller.D) @ np.abs(plant.D) @ np.ones(n_r) @ np.ones(n_r))
    if np.linalg.svd(direct, compute_uv=False)[-1] <= 1e-12 * scale:
        raise UsageError(
            f"loop of {plant.name!r} and {controller.name!r} is not well posed: I - D_K D_G is singular; "
            "give one of them no direct feedthrough, a low-pass for instance"
        )
    n = plant.n_states + controller.n_states
    # columns by the states of plant and controller, w, d
    r = np.linalg.solve(direct, np.hstack([controller.D @ plant.C, controller.C, np.eye(n_r), controller.D]))
    p = plant.D @ r
    p[:, : plant.n_states] += plant.C
    p[:, n + n_r :] += np.eye(n_p)
    rates = np.vstack([plant.B @ r, controller.B @ p])
    rates[:, :n] += scipy.linalg.block_diag(plant.A, controller.A)
    outputs = np.vstack([p, r])
    return LinearModel(
        rates[:, :n],
        rates[:, n:],
        outputs[:, :n],
        outputs[:, n:],
        dt=plant.dt,
        input_names=(*plant.input_names, *(f"d_{name}" for name in plant.output_names)),
        output_names=(*plant.output_names, *plant.input_names),
        state_names=(*plant.state_names, *(f"{controller.name}.{s}" for s in controller.state_names)),
        name=f"{plant.name}, closed by {controller.name}",
    )


def _check_fit(plant: LinearModel, controller: LinearModel) -> None:
    """Refuse a plant and a controller whose channels or sample times do not fit each other."""
    where = f"loop of {plant.name!r} and {controller.name!r}"
    if plant.dt != controller.dt:
        kinds = ["continuous" if m.dt is None else f"sampled at {m.dt:g} s" for m in (plant, controller)]
        raise UsageError(f"{where}: the plant is {kinds[0]}, the controller {kinds[1]}; bring both to one time")
    for what, given, taken in (
        ("plant outputs to the controller", plant.output_names, controller.input_names),
        ("controller outputs to the plant", controller.output_names, plant.input_names),
    ):
        if len(given) != len(taken):
            raise UsageError(f"{where}: {len(given)} {what}, which takes {len(taken)} ({', '.join(taken)})")
        if given != taken and sorted(given) == sorted(taken):
            raise UsageError(f"{where}: {what} come in another order: {', '.join(given)} to {', '.join(taken)}")


def smallest_damping(model: LinearModel) -> float:
    """Return the smallest damping factor over all modes; 1 without oscillation, -1 for an unstable real pole.

    Parameters
    ----------
    model : LinearModel
        Model in continuous time, or sampled. Of a sampled model only modes that last longer than a sample count,
        ``|eigenvalue| > 1/e``. Faster modes, most of them from the delays, have a damping factor but do not oscillate
        visibly.
    """
    poles = model.poles()
    real = poles[is_real(poles)].real
    if (real >= 0).any():
        return -1.0
    lasting = inf if model.dt is None else 1 / model.dt
    return min((damping for hz, damping in model.modes() if 2 * pi * hz * damping < lasting), default=1.0)


# ---- Input matrix of a force on the rotor, which acts without delay and actuators (paper, Sec. 5.1).


def force_entry(plant: LinearModel) -> FloatArray:
    r"""Return the input matrix of a force per mass on the rotor.

    Parameters
    ----------
    plant : LinearModel
        Continuous model. Its outputs must be positions that are states, and their derivatives must be states as well:
        any model of `gbid.RotorBearing` or `gbid.Plant` with the output p.

    Returns
    -------
    (n, n_outputs) array
        E of :math:`\dot x = A x + B r + E f / m`: one in the row of each velocity.

    Raises
    ------
    UsageError
        When positions and velocities cannot be identified in the matrices, or when the model is sampled.
    """
    where = f"force on model {plant.name!r}"
    if plant.dt is not None:
        raise UsageError(f"{where}: it is sampled; give the continuous model")
    entry = np.zeros((plant.n_states, plant.C.shape[0]))
    for i, row in enumerate(plant.C):
        position = _only_one(row)
        velocity = None if position is None else _only_one(plant.A[position])
        if velocity is None or plant.D[i].any():
            raise UsageError(
                f"{where}: output {plant.output_names[i]!r} is not a position whose velocity is a state; "
                "give the entry of the force yourself"
            )
        entry[velocity, i] = 1.0
    return entry


def static_force_gain(plant: LinearModel) -> FloatArray:
    """Return the static motion per force and mass with constant references: the open-loop compliance times the mass.

    Parameters
    ----------
    plant : LinearModel
        Continuous model; a force enters as in `force_entry`.

    Returns
    -------
    (n_outputs, n_outputs) array
        Static gain [m kg/N].
    """
    return np.asarray(-plant.C @ np.linalg.solve(plant.A, force_entry(plant)))


def _only_one(row: FloatArray) -> int | None:
    """Return the index of the only nonzero entry of a row, if this entry is 1."""
    places = np.flatnonzero(row)
    return int(places[0]) if len(places) == 1 and row[places[0]] == 1.0 else None


# ---- Discretisation of plants (exact) and controllers (Tustin or zero-order hold).

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
    _check_sampling(plant, sample_time)
    longest_delay = computation_s + (0.0 if plant.delay is None else float(np.max(plant.delay)))
    if longest_delay > MOST_SAMPLES * sample_time:
        raise UsageError(
            f"sampling of {plant.name!r}: computation and delays take {longest_delay:g} s, more than "
            f"{MOST_SAMPLES} samples of sample_time = {sample_time:g} s; all are in seconds"
        )
    if not (isfinite(computation_s) and computation_s >= 0):
        raise UsageError(f"sampling of {plant.name!r}: computation_s = {computation_s} s; it must not be negative")
    n, n_u = plant.B.shape
    prompt = ceil(computation_s / sample_time - 1e-9)  # delay of the direct feedthrough D u in samples
    matrices: defaultdict[int, FloatArray] = defaultdict(lambda: np.zeros((n, n_u)))  # of the inputs k samples ago
    for i in range(n_u):
        parts = [(plant.B[:, [i]], 0.0)]
        if plant.delay is not None and plant.B_delayed is not None:
            parts.append((plant.B_delayed[:, [i]], float(plant.delay[i])))
        for column, delay in parts:
            if not column.any():
                continue
            samples = (delay + computation_s) / sample_time
            if abs(samples - round(samples)) < 1e-9:  # avoids rounding errors at whole samples
                samples = round(samples)
            shift, taps = delayed_taps(plant.A, column, samples * sample_time, sample_time, "zoh")
            for back, tap in enumerate(taps, shift - 1):
                if np.any(tap):
                    matrices[back][:, [i]] += tap
    depth = max([*matrices, prompt if plant.D.any() else 0])
    # shift registers: the states after x are u[k-1], u[k-2], ..., u[k-depth]
    A = np.zeros((n + depth * n_u,) * 2)
    B = np.zeros((len(A), n_u))
    C, D = np.hstack([plant.C, np.zeros((len(plant.C), depth * n_u))]), np.zeros(plant.D.shape)
    A[:n, :n], B[:n] = scipy.linalg.expm(plant.A * sample_time), matrices[0]
    for k in range(depth):
        A[:n, n + k * n_u : n + (k + 1) * n_u] = matrices[k + 1]
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


def too_slow_for(law: LinearModel, sample_time: float) -> str:
    """Return a text if a continuous controller has a pole beyond half the sampling frequency; else an empty text.

    Parameters
    ----------
    law : LinearModel
        Controller in continuous time.
    sample_time : float
        Time between samples [s].
    """
    fastest = float(np.abs(np.linalg.eigvals(law.A)).max(initial=0.0)) / (2 * np.pi)
    if fastest < 0.5 / sample_time:
        return ""
    return (
        f"sample_time = {sample_time:g} s is too slow for its pole at {fastest:.4g} Hz; at most {0.5 / fastest:.3g} s, "
        "better a tenth of that"
    )


def sample_controller(controller: LinearModel, sample_time: float, method: Method = "tustin") -> LinearModel:
    """Return a continuous controller discretised by the trapezoidal rule (Tustin) or with zero-order hold.

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
        return controller.discretise(sample_time, intersample="zoh")
    _check_sampling(controller, sample_time)
    continuous = controller.A, controller.B, controller.C, controller.D
    A, B, C, D, dt = scipy.signal.cont2discrete(continuous, sample_time, "bilinear")
    return replace(controller, A=A, B=B, C=C, D=D, K=None, dt=dt, intersample=None)


def _check_sampling(model: LinearModel, sample_time: float) -> None:
    if model.dt is not None:
        raise UsageError(f"model {model.name!r} is sampled already, at {model.dt:g} s")
    if not (isfinite(sample_time) and sample_time > 0):
        raise UsageError(f"sampling of {model.name!r}: sample_time = {sample_time} s; give a positive number")
