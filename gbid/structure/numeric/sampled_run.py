"""Preparation of a simulation over sampled inputs: state transition, forcing and initial state."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from gbid.arrays import FloatArray
from gbid.discretise import Hold, check_holds, delayed_taps, discretise
from gbid.errors import UsageError
from gbid.structure.numeric.state_space import StateSpace


def sampled_run(
    model: StateSpace,
    inputs: npt.ArrayLike,
    sample_time: float | None,
    initial_state: npt.ArrayLike | None,
    intersample: str | Sequence[str],
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return the recursion ``x[k+1] = F x[k] + f[k]`` of a simulation, after a check of its inputs.

    Parameters
    ----------
    model : StateSpace
        The model.
    inputs : (n_samples, n_inputs) array
        Input signals.
    sample_time : float, optional
        Time between samples [s]; a discrete model has its own.
    initial_state : (n,) array, optional
        State at the first sample; zero when not given.
    intersample : {"zoh", "foh"} or sequence of these
        Inter-sample behaviour of the inputs.

    Returns
    -------
    F : (n, n) array
        State transition.
    f : (n_samples, n) array
        Effect of the inputs on the state, with delayed inputs.
    inputs : (n_samples, n_inputs) array
        Inputs as a float array.
    initial_state : (n,) array
        State at the first sample.

    Raises
    ------
    UsageError
        As for `LinearModel.simulate`.
    """
    u = channels(model.name, "inputs", inputs, model.B.shape[1])
    if model.dt is None:
        if sample_time is None:
            raise UsageError(f"model {model.name!r} is continuous: give the sample time [s]")
        check_sample_time(model.name, sample_time)
        F, now, following = discretise(np.array(model.A), np.array(model.B), sample_time, intersample)
    else:
        if sample_time is not None and not np.isclose(sample_time, model.dt, rtol=1e-9):
            raise UsageError(f"model {model.name!r} has sample time {model.dt} s, not {sample_time} s")
        if any(hold != "zoh" for hold in check_holds(intersample, model.B.shape[1])):
            raise UsageError(f"model {model.name!r} is discrete: its inputs cannot be interpolated")
        F, now, following = model.A, model.B, np.zeros_like(model.B)
    x0 = np.zeros(len(model.A)) if initial_state is None else np.asarray(initial_state, float)
    if x0.shape != (len(model.A),):
        raise UsageError(f"model {model.name!r}: initial_state has shape {x0.shape}, expected ({len(model.A)},)")
    forcing = u @ now.T
    forcing[:-1] += u[1:] @ following.T
    if model.delay is not None and sample_time is not None:
        forcing += _delayed_forcing(model, u, sample_time, check_holds(intersample, u.shape[1]))
    return F, forcing, u, x0


def _delayed_forcing(model: StateSpace, u: FloatArray, sample_time: float, holds: Sequence[Hold]) -> FloatArray:
    """Return the effect of the delayed inputs on the state; before the record they have their first value."""
    assert model.delay is not None
    assert model.B_delayed is not None
    forcing = np.zeros((len(u), len(model.A)))
    for i, hold in enumerate(holds):
        taps = delayed_taps(np.array(model.A), model.B_delayed[:, [i]], float(model.delay[i]), sample_time, hold)
        for j, column in enumerate(taps.columns):
            rows = np.clip(np.arange(len(u)) - taps.shift + 1 - j, 0, len(u) - 1)
            forcing += u[rows, i : i + 1] @ column.T
    return forcing


def channels(model: str, what: str, values: npt.ArrayLike, count: int, n_samples: int | None = None) -> FloatArray:
    """Return signals as finite numbers, (n_samples, count); one channel may come as (n_samples,).

    Parameters
    ----------
    model, what : str
        Name of the model and word for the signals, for the text of an error.
    values : array
        The signals.
    count : int
        Number of channels.
    n_samples : int, optional
        Number of samples; any when left out.

    Raises
    ------
    UsageError
        For another shape, or values that are not finite.
    """
    found = np.asarray(values, float)
    if found.ndim == 1 and count == 1:
        found = found[:, None]
    if found.ndim != 2 or found.shape[1] != count or n_samples not in (None, len(found)):
        expected = "n_samples" if n_samples is None else n_samples
        raise UsageError(f"model {model!r}: {what} have shape {found.shape}, expected ({expected}, {count})")
    if not np.isfinite(found).all():
        raise UsageError(f"model {model!r}: {what} hold values that are not finite")
    return found


def check_sample_time(model: str, sample_time: float) -> None:
    """Refuse sample times that are not positive numbers."""
    if not (np.isfinite(sample_time) and sample_time > 0):
        raise UsageError(f"model {model!r}: sample time {sample_time} s; it must be a positive number")
