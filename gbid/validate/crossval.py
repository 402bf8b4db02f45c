"""A model against a recording that it was not fitted to: paper, Sec. 3.8."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from gbid.discretise import discretise, propagate
from gbid.errors import DataError
from gbid.identify import FitResult, select
from gbid.recording import Recording
from gbid.structure import LinearModel
from gbid.validate.fit_percent import fit_percent

FloatArray = npt.NDArray[np.float64]


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


def cross_validate(result: FitResult, recording: Recording) -> Validation:
    """Simulate a fitted model on a recording, its initial state estimated there.

    The measured outputs are used for the initial state alone, and for the outputs' offsets when the fit estimated
    offsets; the model then runs on the inputs.

    Parameters
    ----------
    result : FitResult
        Says model, signals and the behaviour of the inputs between samples.
    recording : Recording

    Returns
    -------
    Validation

    Raises
    ------
    DataError
        When the recording lacks a signal or has another sample time, or the simulation overflows.
    """
    inputs, outputs = result.options["inputs"].split(), result.options["outputs"].split()
    if not np.isclose(recording.sample_time, result.sample_time, rtol=1e-6, atol=0):
        raise DataError(
            f"recording {recording.name!r} has sample time {recording.sample_time:g} s; the model was fitted at "
            f"{result.sample_time:g} s, and its delays are tied to it"
        )
    u, input_names, input_units = select(recording, inputs)
    y, output_names, output_units = select(recording, outputs)
    hold = result.options["intersample"].split()
    model = result.model
    between = hold[0] if len(hold) == 1 else hold
    if (len(input_names), len(output_names)) != (len(model.input_names), len(model.output_names)):
        raise DataError(
            f"recording {recording.name!r} gives the inputs {', '.join(input_names)} and the outputs "
            f"{', '.join(output_names)}; the model has {', '.join(model.input_names)} and "
            f"{', '.join(model.output_names)}"
        )
    with np.errstate(over="ignore", invalid="ignore"):
        try:
            state = estimate_initial_state(model, u, y, recording.sample_time, between, offsets=has_offsets(result))
            simulated = model.simulate(u, recording.sample_time, initial_state=state, intersample=between)
            if has_offsets(result):
                simulated = simulated + (y - simulated).mean(axis=0)
        except np.linalg.LinAlgError:  # the free responses overflow
            simulated = np.full_like(y, np.inf)
    if not np.isfinite(simulated).all():
        raise DataError(f"the model of {', '.join(result.recordings)} overflows on recording {recording.name!r}")
    return Validation(
        recording=recording.name,
        fitted_to=result.recordings,
        fit_percent=fit_percent(y, simulated),
        infinity_norm=np.abs(y - simulated).max(axis=0),
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


def has_offsets(result: FitResult) -> bool:
    """Whether a fit estimated an offset of each output, as `fit` does with ``offsets=True``."""
    free = {name.partition("[")[0] for name in result.free}
    return all(f"offset_{name}" in free for name in result.model.output_names)


def estimate_initial_state(
    model: LinearModel,
    inputs: FloatArray,
    outputs: FloatArray,
    sample_time: float,
    intersample: str | list[str] = "zoh",
    *,
    offsets: bool = False,
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
    if offsets:  # taking means off leaves what no offset explains
        free, rest = free - free.mean(axis=0), rest - rest.mean(axis=0)
    columns = free.reshape(-1, n)
    size = np.linalg.norm(columns, axis=0)
    size[size == 0] = 1.0
    return np.asarray(np.linalg.lstsq(columns / size, rest.ravel(), rcond=None)[0] / size)
