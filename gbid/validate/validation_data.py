"""Signals of a recording on which models are validated, and the samples that count."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gbid.arrays import BoolArray, FloatArray
from gbid.errors import DataError
from gbid.identify import FitResult, select
from gbid.recording import Recording

Ranges = Sequence[tuple[int, int]]
"""Ranges of samples (start, stop); the stop sample is not part of the range."""


@dataclass(frozen=True, eq=False)
class ValidationData:
    """Inputs and outputs of one recording, arranged for the simulation of many models.

    Attributes
    ----------
    name : str
        Name of the recording.
    conditions : dict of str to float
        Operating point of the recording.
    sample_time : float
        Time between samples [s].
    inputs : (n_inputs, n_samples) array
        Input signals.
    outputs : (n_outputs, n_samples) array
        Measured outputs.
    counted : (n_samples,) array of bool or None
        Samples that count; None when all count.
    input_names, output_names, input_units, output_units : tuple of str
        Names and units of the channels.
    spread : (n_outputs,) array
        Norm of each output about its mean.
    """

    name: str
    conditions: dict[str, float]
    sample_time: float
    inputs: FloatArray
    outputs: FloatArray
    counted: BoolArray | None
    input_names: tuple[str, ...]
    output_names: tuple[str, ...]
    input_units: tuple[str, ...]
    output_units: tuple[str, ...]
    spread: FloatArray


def validation_data(result: FitResult, recording: Recording, left_out: Ranges = ()) -> ValidationData:
    """Return the signals of a recording on which the models of a fit are validated.

    Parameters
    ----------
    result : FitResult
        Any fit of these models; it names the signals.
    recording : Recording
        Validation recording.
    left_out : sequence of (start, stop)
        Ranges of samples that do not count.

    Raises
    ------
    DataError
        When the recording lacks a signal, or has no sample that counts.
    """
    u, input_names, input_units = select(recording, result.options.inputs)
    y, output_names, output_units = select(recording, result.options.outputs)
    counted = counted_samples(recording, left_out)
    kept = y if counted is None else y[counted]
    return ValidationData(
        recording.name,
        dict(recording.conditions),
        recording.sample_time,
        np.ascontiguousarray(u.T),
        np.ascontiguousarray(y.T),
        counted,
        tuple(input_names),
        tuple(output_names),
        tuple(input_units),
        tuple(output_units),
        np.linalg.norm(kept - kept.mean(axis=0), axis=0),
    )


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
