"""Poles, static gain and frequency response of a linear model."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from gbid.arrays import ComplexArray, FloatArray
from gbid.errors import UsageError
from gbid.poles import poles_of_samples
from gbid.structure.numeric.state_space import StateSpace


def continuous_poles(model: StateSpace) -> ComplexArray:
    """Return the poles in continuous time [rad/s], shape (n,), by rising magnitude."""
    poles = np.linalg.eigvals(model.A).astype(complex)
    if model.dt is not None:
        poles = poles_of_samples(poles, model.dt)
    return poles[np.lexsort((poles.imag, np.abs(poles)))]


def static_gain(model: StateSpace) -> FloatArray:
    """Return the static gain, shape (n_outputs, n_inputs); see `LinearModel.static_gain`."""
    system = -model.A if model.dt is None else np.eye(len(model.A)) - model.A
    if len(model.A) and np.linalg.cond(system) > 1e15:
        raise UsageError(f"model {model.name!r} has an integrator, so it has no static gain")
    B = model.B if model.B_delayed is None else model.B + model.B_delayed
    return np.asarray(model.C @ np.linalg.solve(system, B) + model.D)


def frequency_response(model: StateSpace, frequency_hz: npt.ArrayLike) -> ComplexArray:
    """Return the frequency response (n_frequencies, n_outputs, n_inputs); see `LinearModel.frequency_response`."""
    s = 2j * np.pi * np.atleast_1d(np.asarray(frequency_hz, float))
    if not np.isfinite(s).all():
        raise UsageError(f"model {model.name!r}: frequency_hz holds values that are not finite")
    B = np.broadcast_to(model.B, (len(s), *model.B.shape)).astype(complex)
    if model.delay is not None:
        B = B + model.B_delayed * np.exp(-s[:, None] * model.delay)[:, None]
    if model.dt is not None:
        s = np.exp(s * model.dt)
    system = s[:, None, None] * np.eye(len(model.A)) - model.A
    try:
        states = np.linalg.solve(system, B)
    except np.linalg.LinAlgError:
        raise UsageError(f"model {model.name!r} has a pole at one of the given frequencies") from None
    return np.asarray(model.C @ states + model.D)
