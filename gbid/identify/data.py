"""Inputs and outputs of a fit, selected from recordings and checked."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from gbid.core.arrays import BoolArray, FloatArray
from gbid.core.errors import DataError
from gbid.recording import Recording


class Channels(NamedTuple):
    """Signals or channels of a recording: inputs and outputs of its structure."""

    inputs: tuple[str, ...]
    outputs: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class Record:
    """Inputs and outputs of one recording.

    Attributes
    ----------
    name : str
        Name of the recording.
    inputs : (n_samples, n_inputs) array
        Inputs in SI units.
    outputs : (n_samples, n_outputs) array
        Outputs in SI units.
    conditions : dict of str to float
        Operating point of the recording.
    """

    name: str
    inputs: FloatArray
    outputs: FloatArray
    conditions: Mapping[str, float] = field(default_factory=dict)

    @property
    def n_samples(self) -> int:
        """Number of samples."""
        return len(self.outputs)


@dataclass(frozen=True, eq=False)
class FitData:
    """Data of a fit: one or several records with the same channels and sample time.

    Attributes
    ----------
    records : tuple of Record
        Inputs and outputs of each recording.
    sample_time : float
        Time between samples [s].
    input_names, output_names : tuple of str
        Names of the channels, such as ``u_x``.
    output_units : tuple of str
        Units of the outputs.
    """

    records: tuple[Record, ...]
    sample_time: float
    input_names: tuple[str, ...]
    output_names: tuple[str, ...]
    output_units: tuple[str, ...]

    @property
    def n_samples(self) -> int:
        """Number of samples in all records."""
        return sum(record.n_samples for record in self.records)


def select(recording: Recording, names: Sequence[str]) -> tuple[FloatArray, list[str], list[str]]:
    """Return signals or single channels of a recording as columns of one array.

    Parameters
    ----------
    recording : Recording
        The recording.
    names : sequence of str
        Signals (``"p"``: all channels) or channels (``"p.x"``). A signal with exactly this name comes first.

    Returns
    -------
    values : (n_samples, n) array
        The channels as columns.
    channel_names : list of str
        Names of the channels, such as ``p_x``.
    units : list of str
        Units of the channels.

    Raises
    ------
    DataError
        When the recording has no such signal or channel.
    """
    columns: list[FloatArray] = []
    labels: list[str] = []
    units: list[str] = []
    for name in names:
        signal, channel = _meant(recording, name)
        values, channels = (
            recording.signal(signal),
            recording.channels[signal],
        )
        if channel and channel not in channels:
            raise DataError(
                f"recording {recording.name!r}: signal {signal!r} has no channel {channel!r}; "
                f"it has {', '.join(channels)}"
            )
        picked = [channels.index(channel)] if channel else list(range(values.shape[1]))
        columns.append(values[:, picked])
        labels += [f"{signal}_{channels[i]}" if len(channels) > 1 else signal for i in picked]
        units += [recording.units[signal]] * len(picked)
    return (np.hstack(columns) if columns else np.zeros((recording.n_samples, 0))), labels, units


def _meant(recording: Recording, name: str) -> tuple[str, str]:
    """Return the signal and channel of a name, the channel empty for all; both names may contain points."""
    at = [i for i, letter in enumerate(name) if letter == "."]
    readings = [(name, ""), *((name[:i], name[i + 1 :]) for i in at)]
    there = [each for each in readings if each[0] in recording.signals]
    return there[0] if there else readings[1 if at else 0]


def gather(recordings: Sequence[Recording], inputs: Sequence[str], outputs: Sequence[str], minimum: int) -> FitData:
    """Return the data of a fit from recordings, after checks.

    Parameters
    ----------
    recordings : sequence of Recording
        The recordings.
    inputs, outputs : sequence of str
        Signals or channels.
    minimum : int
        Smallest number of samples of a record.

    Returns
    -------
    FitData
        Data of all recordings.

    Raises
    ------
    DataError
        When there are no recordings, sample times or channels differ, a record is too short, or an output is constant.
        An input may be constant or zero: see `gbid.identify.problem.states`.
    """
    if not recordings:
        raise DataError("no recordings to fit; give at least one")
    first = recordings[0]
    records = []
    names: tuple[list[str], list[str]] | None = None
    for recording in recordings:
        _check_sample_time(first, recording)
        u, u_names, _ = select(recording, inputs)
        y, y_names, y_units = select(recording, outputs)
        if names is not None and names != (u_names, y_names):
            raise DataError(f"recordings {first.name!r} and {recording.name!r} have different channels")
        names = (u_names, y_names)
        if recording.n_samples < minimum:
            raise DataError(
                f"recording {recording.name!r} has {recording.n_samples} samples; this fit needs at least {minimum}"
            )
        for label, column in zip(y_names, y.T, strict=True):
            if not moves(column):
                raise DataError(
                    f"recording {recording.name!r}: channel {label!r} is {column[0]:g} throughout; the output is "
                    "constant: is the sensor connected"
                )
        records.append(Record(recording.name, np.ascontiguousarray(u), np.ascontiguousarray(y), recording.conditions))
    assert names is not None
    return FitData(tuple(records), first.sample_time, tuple(names[0]), tuple(names[1]), tuple(y_units))


def moves(values: FloatArray) -> BoolArray:
    """Return whether each column of samples (n, n_columns), or a single one (n,), is not constant."""
    return np.array([(column != column[0]).any() for column in np.atleast_2d(values.T)], bool)


def column_means(values: FloatArray) -> FloatArray:
    """Return the mean of each column of samples (n, n_columns): a tenth of the time that numpy takes along columns."""
    return np.asarray(np.ascontiguousarray(values.T).mean(axis=1))


def gather_own(recordings: Sequence[Recording], channels: Sequence[Channels], minimum: int) -> FitData:
    """Return the data of a fit in which each recording has inputs of its own; the outputs are the same signals.

    Parameters and errors are those of `gather`. The names of the inputs are those of the first recording.
    """
    own = [gather([r], *names, minimum) for r, names in zip(recordings, channels, strict=True)]
    if not own:
        raise DataError("no recordings to fit; give at least one")
    for recording, one in zip(recordings, own, strict=True):
        _check_sample_time(recordings[0], recording)
        if one.output_names != own[0].output_names:
            raise DataError(
                f"recordings {recordings[0].name!r} and {recording.name!r} have different outputs, "
                f"{', '.join(own[0].output_names)} and {', '.join(one.output_names)}; give their structures the same"
            )
    return replace(own[0], records=tuple(one.records[0] for one in own))


def _check_sample_time(first: Recording, other: Recording) -> None:
    if not np.isclose(other.sample_time, first.sample_time, rtol=1e-6, atol=0):
        raise DataError(
            f"recordings {first.name!r} and {other.name!r} have different sample times: "
            f"{first.sample_time:g} s and {other.sample_time:g} s; resample one, or fit them separately"
        )
