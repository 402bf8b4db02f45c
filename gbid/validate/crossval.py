"""Cross-validation: simulation of a model on a recording to which it was not fitted (paper, Sec. 3.8)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gbid.arrays import BoolArray, FloatArray
from gbid.discretise import discretise, propagate
from gbid.errors import DataError
from gbid.identify import FitResult, select
from gbid.recording import Recording
from gbid.structure import LinearModel
from gbid.validate.fit_percent import fit_percent

Ranges = Sequence[tuple[int, int]]
"""Ranges of samples (start, stop); the stop sample is not part of the range."""
Selection = tuple[FloatArray, list[str], list[str]]


@dataclass(frozen=True, eq=False)
class Validation:
    """Measured and simulated response of one recording.

    Attributes
    ----------
    recording : str
        Name of the validation recording.
    fitted_to : tuple of str
        Recordings to which the model was fitted.
    fit_percent : (n_outputs,) array
        ``100 (1 - |y - yhat| / |y - mean y|)``.
    infinity_norm : (n_outputs,) array
        Largest deviation, in the units of the outputs.
    measured, simulated : (n_samples, n_outputs) array
        Outputs, also at samples that do not count for the figures above.
    inputs : (n_samples, n_inputs) array
        Inputs of the simulation.
    time : (n_samples,) array
        Time from the first sample [s].
    initial_state : (n_states,) array
        Initial state, estimated on this recording.
    input_names, output_names, input_units, output_units : tuple of str
        Names and units of the channels.
    conditions : dict of str to float
        Operating point of the recording.
    """

    recording: str
    fitted_to: tuple[str, ...]
    fit_percent: FloatArray
    infinity_norm: FloatArray
    measured: FloatArray
    simulated: FloatArray
    inputs: FloatArray
    time: FloatArray
    initial_state: FloatArray
    input_names: tuple[str, ...]
    output_names: tuple[str, ...]
    input_units: tuple[str, ...]
    output_units: tuple[str, ...]
    conditions: dict[str, float]


def cross_validate(result: FitResult, recording: Recording, left_out: Ranges = ()) -> Validation:
    """Return the simulation of a fitted model on a recording, with its fit percent and largest deviation.

    The initial state is estimated from the measured outputs, and so are the offsets of the outputs when the fit
    estimated offsets. Otherwise the simulation uses the inputs only.

    Parameters
    ----------
    result : FitResult
        Fit with the model, the signals and the inter-sample behaviour of the inputs.
    recording : Recording
        Validation recording.
    left_out : sequence of (start, stop)
        Ranges of samples whose outputs do not count, as in `gbid.fit`. The model is simulated through them.

    Returns
    -------
    Validation

    Raises
    ------
    DataError
        When the recording lacks a signal or has another sample time, when no sample counts, or when the simulation
        overflows.
    """
    (u, input_names, input_units), (y, output_names, output_units) = selected(result, recording)
    model, between, offsets = result.model, result.options.intersample, result.options.offsets
    if (len(input_names), len(output_names)) != (len(model.input_names), len(model.output_names)):
        raise DataError(
            f"recording {recording.name!r} gives the inputs {', '.join(input_names)} and the outputs "
            f"{', '.join(output_names)}; the model has {', '.join(model.input_names)} and "
            f"{', '.join(model.output_names)}"
        )
    counted = counted_samples(recording, left_out)
    with np.errstate(over="ignore", invalid="ignore"):
        try:
            state = estimate_initial_state(
                model, u, y, recording.sample_time, between, offsets=offsets, counted=counted
            )
            simulated = model.simulate(u, recording.sample_time, initial_state=state, intersample=between)
            if offsets:
                simulated = simulated + _kept(y - simulated, counted).mean(axis=0)
        except np.linalg.LinAlgError:  # the free responses overflow
            simulated = np.full_like(y, np.inf)
    if not np.isfinite(simulated).all():
        raise DataError(f"the model of {', '.join(result.recordings)} overflows on recording {recording.name!r}")
    kept, explained = _kept(y, counted), _kept(simulated, counted)
    return Validation(
        recording=recording.name,
        fitted_to=result.recordings,
        fit_percent=fit_percent(kept, explained),
        infinity_norm=np.abs(kept - explained).max(axis=0),
        measured=y,
        simulated=simulated,
        inputs=u,
        time=recording.time,
        initial_state=state,
        input_names=tuple(input_names),
        output_names=tuple(output_names),
        input_units=tuple(input_units),
        output_units=tuple(output_units),
        conditions=dict(recording.conditions),
    )


def selected(result: FitResult, recording: Recording) -> tuple[Selection, Selection]:
    """Return the inputs and outputs of a fit from a recording, each as values, names and units.

    Raises
    ------
    DataError
        When the recording lacks a signal or has another sample time.
    """
    if not np.isclose(recording.sample_time, result.sample_time, rtol=1e-6, atol=0):
        raise DataError(
            f"recording {recording.name!r} has sample time {recording.sample_time:g} s; the model was fitted at "
            f"{result.sample_time:g} s: resample the recording"
        )
    return select(recording, result.options.inputs), select(recording, result.options.outputs)


def counted_samples(recording: Recording, left_out: Ranges) -> BoolArray | None:
    """Return which samples count when some ranges are left out; None when all count.

    Raises
    ------
    DataError
        When a range lies outside the recording, or when no sample remains.
    """
    counted = np.ones(recording.n_samples, dtype=bool)
    for start, stop in left_out:
        if not 0 <= start < stop <= recording.n_samples:
            raise DataError(
                f"recording {recording.name!r}: left out samples {start} to {stop} are not within its "
                f"{recording.n_samples}; correct them"
            )
        counted[start:stop] = False
    if not counted.any():
        raise DataError(f"recording {recording.name!r}: all samples are left out; keep some")
    return None if counted.all() else counted


def _kept(values: FloatArray, counted: BoolArray | None) -> FloatArray:
    return values if counted is None else values[counted]


def estimate_initial_state(
    model: LinearModel,
    inputs: FloatArray,
    outputs: FloatArray,
    sample_time: float,
    intersample: str | Sequence[str] = "zoh",
    *,
    offsets: bool = False,
    counted: BoolArray | None = None,
) -> FloatArray:
    """Return the initial state whose simulation is closest to the measured outputs, by least squares.

    Parameters
    ----------
    model : LinearModel
        Model in continuous time.
    inputs : (n_samples, n_inputs) array
        Input signals.
    outputs : (n_samples, n_outputs) array
        Measured outputs.
    sample_time : float
        Time between samples [s].
    intersample : {"zoh", "foh"} or sequence of these
        Inter-sample behaviour of the inputs.
    offsets : bool
        Whether a constant offset of each output is estimated together with the state. The offset is the mean of the
        residual of the simulation from this state.
    counted : (n_samples,) array of bool, optional
        Samples whose outputs count; all by default.

    Returns
    -------
    (n_states,) array
        Least-squares solution of smallest norm.
    """
    n = model.n_states
    rest = outputs - model.simulate(inputs, sample_time, intersample=intersample)
    F = discretise(np.array(model.A), np.zeros((n, 1)), sample_time).F
    silent = np.zeros((len(outputs), n))
    free = np.stack([propagate(F, silent, unit) @ model.C.T for unit in np.eye(n)], axis=2)
    if counted is not None:
        free, rest = free[counted], rest[counted]
    if offsets:  # without means, the constant offsets drop out of the problem
        free, rest = free - free.mean(axis=0), rest - rest.mean(axis=0)
    columns = free.reshape(-1, n)
    size = np.linalg.norm(columns, axis=0)
    size[size == 0] = 1.0
    return np.asarray(np.linalg.lstsq(columns / size, rest.ravel(), rcond=None)[0] / size)
