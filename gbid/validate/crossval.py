"""A model against a recording that it was not fitted to: paper, Sec. 3.8."""

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
"""Stretches of samples, each from its first to before its second number."""
Selection = tuple[FloatArray, list[str], list[str]]


@dataclass(frozen=True, eq=False)
class Validation:
    """Measured and simulated response of one recording.

    Attributes
    ----------
    recording : str
        Recording that the model was put to.
    fitted_to : tuple of str
        Recordings that the model came from.
    fit_percent : (n_outputs,) array
        ``100 (1 - |y - yhat| / |y - mean y|)``.
    infinity_norm : (n_outputs,) array
        Largest deviation, in the outputs' units.
    measured, simulated : (n_samples, n_outputs) array
        Samples that were left out are there too; they count for nothing above.
    inputs : (n_samples, n_inputs) array
    time : (n_samples,) array
        From the first sample [s].
    initial_state : (n_states,) array
        Estimated on this recording.
    input_names, output_names, input_units, output_units : tuple of str
    conditions : dict of str to float
        Those of the recording.
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
    """Simulate a fitted model on a recording, its initial state estimated there.

    The measured outputs are used for the initial state alone, and for the outputs' offsets when the fit estimated
    offsets; the model then runs on the inputs.

    Parameters
    ----------
    result : FitResult
        Says model, signals and the behaviour of the inputs between samples.
    recording : Recording
    left_out : sequence of (start, stop)
        Stretches of samples whose outputs do not count, as in `gbid.fit`; the model runs through them.

    Returns
    -------
    Validation

    Raises
    ------
    DataError
        When the recording lacks a signal or has another sample time, no sample counts, or the simulation overflows.
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
    """Take a fit's inputs and outputs from a recording.

    Raises
    ------
    DataError
        When the recording lacks a signal or has another sample time.
    """
    if not np.isclose(recording.sample_time, result.sample_time, rtol=1e-6, atol=0):
        raise DataError(
            f"recording {recording.name!r} has sample time {recording.sample_time:g} s; the model was fitted at "
            f"{result.sample_time:g} s, and its delays are tied to it"
        )
    return select(recording, result.options.inputs), select(recording, result.options.outputs)


def counted_samples(recording: Recording, left_out: Ranges) -> BoolArray | None:
    """Tell which samples count when some stretches are left out; None when all do.

    Raises
    ------
    DataError
        When a stretch lies beyond the recording, or no sample is left.
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
    """Find the initial state with which a simulation comes nearest to the measured outputs.

    Parameters
    ----------
    model : LinearModel
        In continuous time.
    inputs : (n_samples, n_inputs) array
    outputs : (n_samples, n_outputs) array
    sample_time : float
        Time between samples [s].
    intersample : {"zoh", "foh"} or list of these
    offsets : bool
        Whether a constant offset of each output is estimated beside it. It is the mean of what a simulation from
        this state leaves over.
    counted : (n_samples,) array of bool, optional
        Samples whose outputs count; all by default.

    Returns
    -------
    (n_states,) array
        The least-squares solution of smallest norm.
    """
    n = model.n_states
    rest = outputs - model.simulate(inputs, sample_time, intersample=intersample)
    F = discretise(np.array(model.A), np.zeros((n, 1)), sample_time).F
    silent = np.zeros((len(outputs), n))
    free = np.stack([propagate(F, silent, unit) @ model.C.T for unit in np.eye(n)], axis=2)
    if counted is not None:
        free, rest = free[counted], rest[counted]
    if offsets:  # taking means off leaves what no offset explains
        free, rest = free - free.mean(axis=0), rest - rest.mean(axis=0)
    columns = free.reshape(-1, n)
    size = np.linalg.norm(columns, axis=0)
    size[size == 0] = 1.0
    return np.asarray(np.linalg.lstsq(columns / size, rest.ravel(), rcond=None)[0] / size)
