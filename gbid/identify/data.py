"""Inputs and outputs of a fit, selected from recordings and checked."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from gbid.core.arrays import BoolArray, FloatArray
from gbid.core.errors import DataError
from gbid.recording import Recording
from gbid.recording.recording import without_gaps


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
    missing : (n_samples, n_outputs) boolean array or None
        Outputs that are missing; None when none is. In their place `outputs` has straight lines between neighbours,
        which only start values and scales use.
    time : (n_samples,) array or None
        Irregular times of the samples from the first one [s]; None for even ones.
    """

    name: str
    inputs: FloatArray
    outputs: FloatArray
    conditions: Mapping[str, float] = field(default_factory=dict)
    missing: BoolArray | None = None
    time: FloatArray | None = None

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
        Time between samples [s]; the mean one where times are irregular.
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

    def with_outputs(self, kept: Sequence[int]) -> FitData:
        """Return the data with a selection of the outputs."""
        records = (
            replace(
                record,
                outputs=np.ascontiguousarray(record.outputs[:, kept]),
                missing=None if record.missing is None else record.missing[:, kept],
            )
            for record in self.records
        )
        names, units = ([each[i] for i in kept] for each in (self.output_names, self.output_units))
        return replace(self, records=tuple(records), output_names=tuple(names), output_units=tuple(units))

    @property
    def n_samples(self) -> int:
        """Number of samples in all records."""
        return sum(record.n_samples for record in self.records)

    @property
    def is_irregular(self) -> bool:
        """Whether the times of any record are irregular; then all records have times."""
        return any(record.time is not None for record in self.records)

    def time_of(self, record: Record) -> FloatArray:
        """Return the times of the samples of one record, counted from its first sample [s], (n_samples,)."""
        return np.asarray(self.sample_time * np.arange(record.n_samples)) if record.time is None else record.time

    def at_even_times(self) -> FitData:
        """Return the data interpolated linearly from irregular to even times; for start values only."""
        if not self.is_irregular:
            return self
        records = []
        for record in self.records:
            time = self.time_of(record)
            even = self.sample_time * np.arange(int(time[-1] / self.sample_time) + 1)
            inputs, outputs = (
                np.stack([np.interp(even, time, column) for column in values.T], axis=1)
                if values.size
                else np.zeros((len(even), 0))
                for values in (record.inputs, record.outputs)
            )
            records.append(Record(record.name, inputs, outputs, record.conditions))
        return replace(self, records=tuple(records))


def select(
    recording: Recording, names: Sequence[str], *, gaps: bool = False, irregular: bool = False
) -> tuple[FloatArray, list[str], list[str]]:
    """Return signals or single channels of a recording as columns of one array.

    Parameters
    ----------
    recording : Recording
        The recording.
    names : sequence of str
        Signals (``"p"``: all channels) or channels (``"p.x"``). A signal with exactly this name comes first.
    gaps, irregular : bool
        Whether samples may be missing (NaN), and their times irregular.

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
        values, channels = recording.signal(signal, gaps=gaps, irregular=irregular), recording.channels[signal]
        if channel and channel not in channels:
            raise DataError(
                f"recording {recording.name!r}: signal {signal!r} has no channel {channel!r}; "
                f"it has {', '.join(channels)}"
            )
        picked = [channels.index(channel)] if channel else list(range(values.shape[1]))
        columns.append(values[:, picked] if channel else values)
        labels += [f"{signal}_{channels[i]}" if len(channels) > 1 else signal for i in picked]
        units += [recording.units[signal]] * len(picked)
    columns = columns or [np.zeros((recording.n_samples, 0))]
    return np.hstack(columns) if len(columns) > 1 else columns[0], labels, units


def _meant(recording: Recording, name: str) -> tuple[str, str]:
    """Return the signal and channel that a name means (channel empty for all); both names may contain points."""
    at = [i for i, letter in enumerate(name) if letter == "."]
    readings = [(name, ""), *((name[:i], name[i + 1 :]) for i in at)]
    known = [each for each in readings if each[0] in recording.signals]
    return known[0] if known else readings[1 if at else 0]


def same_columns(
    recordings: Sequence[Recording], names: Sequence[str], *, gaps: bool = False, irregular: bool = False
) -> tuple[list[FloatArray], list[str], list[str]]:
    """Return signals or channels of several recordings as columns, with channel names and units; see `select`.

    Raises
    ------
    DataError
        When there are no recordings, or sample times or channels differ.
    """
    if not recordings:
        raise DataError("no recordings; give at least one")
    columns = [select(recording, names, gaps=gaps, irregular=irregular) for recording in recordings]
    first, (_, labels, units) = recordings[0], columns[0]
    any_clock = irregular and any(recording.stamps is not None for recording in recordings)
    for recording, (_, others, _) in zip(recordings, columns, strict=True):
        if not any_clock and not np.isclose(recording.sample_time, first.sample_time, rtol=1e-6, atol=0):
            raise DataError(
                f"recordings {first.name!r} and {recording.name!r} have different sample times: "
                f"{first.sample_time:g} s and {recording.sample_time:g} s; resample one, or use them separately"
            )
        if others != labels:
            raise DataError(
                f"recordings {first.name!r} and {recording.name!r} have different channels, {', '.join(labels)} and "
                f"{', '.join(others)}"
            )
    return [values for values, *_ in columns], labels, units


def gather(
    recordings: Sequence[Recording],
    inputs: Sequence[str],
    outputs: Sequence[str],
    minimum: int,
    *,
    gaps: bool = False,
    irregular: bool = False,
) -> FitData:
    """Return the data of a fit, selected from recordings and checked.

    Parameters
    ----------
    recordings : sequence of Recording
        The recordings.
    inputs, outputs : sequence of str
        Signals or channels.
    minimum : int
        Smallest number of samples of a record.
    gaps, irregular : bool
        Whether outputs may be missing (NaN), and the times of samples irregular. Recordings at irregular times may have
        different rates.

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
    u, input_names, _ = same_columns(recordings, inputs, irregular=irregular)
    y, output_names, output_units = same_columns(recordings, outputs, gaps=gaps, irregular=irregular)
    any_clock, records = any(recording.stamps is not None for recording in recordings), []
    for recording, u_columns, y_columns in zip(recordings, u, y, strict=True):
        if recording.n_samples < minimum:
            raise DataError(
                f"recording {recording.name!r} has {recording.n_samples} samples; this fit needs at least {minimum}"
            )
        y_columns, missing = without_gaps(y_columns)
        for label in np.array(output_names)[~moves(y_columns)].tolist():
            value = y_columns[0, output_names.index(label)]
            raise DataError(
                f"recording {recording.name!r}: channel {label!r} is {value:g} throughout; the output is "
                "constant: is the sensor connected"
            )
        arrays = np.ascontiguousarray(u_columns), np.ascontiguousarray(y_columns)
        time = recording.time if any_clock else None
        records.append(Record(recording.name, *arrays, recording.conditions, missing, time))
    names = tuple(input_names), tuple(output_names), tuple(output_units)
    return FitData(tuple(records), recordings[0].sample_time, *names)


def channels_of(recording: Recording, names: Sequence[str]) -> tuple[str, ...]:
    """Return the channels that signal or channel names mean, such as ``p.x``; one for each column."""
    each = [(name, *_meant(recording, name)) for name in names]
    return tuple(
        name if channel or len(recording.channels[signal]) == 1 else f"{signal}.{one}"
        for name, signal, channel in each
        for one in ([channel] if channel else recording.channels[signal])
    )


_DEPENDENT = 1e-5  # of the size of an output: what others may leave of it; above, no error is so small in comparison


@dataclass(frozen=True, eq=False)
class Dependence:
    """Output that is, in all records, a linear combination of the outputs before it.

    Attributes
    ----------
    name : str
        Channel.
    weights : dict of str to float
        Weights of the other outputs, by channel.
    left, size : float
        Standard deviation of what they leave of it, and of the output itself.
    """

    name: str
    weights: Mapping[str, float]
    left: float
    size: float


def dependent_outputs(data: FitData) -> tuple[Dependence, ...]:
    """Return the outputs that are linear combinations of the outputs before them, within a relative 1e-5."""
    rows = [centred_rows(record.outputs) for record in data.records]
    products = np.asarray(sum(each @ each.T for each in rows))
    size = np.sqrt(np.diag(products))
    if len(size) < 2 or not np.linalg.eigvalsh(products / np.outer(size, size))[0] < _DEPENDENT**2:
        return ()
    columns, kept, found = np.hstack(rows).T / size, [0], list[Dependence]()
    for i in range(1, len(size)):
        weights = np.linalg.lstsq(columns[:, kept], columns[:, i])[0]
        left = float(np.linalg.norm(columns[:, i] - columns[:, kept] @ weights))
        if left > _DEPENDENT:
            kept.append(i)
            continue
        unit = size[i] / np.sqrt(data.n_samples)
        named = {data.output_names[k]: w * size[i] / size[k] for k, w in zip(kept, weights.tolist(), strict=True)}
        found.append(Dependence(data.output_names[i], named, left * unit, unit))
    return tuple(found)


def moves(values: FloatArray) -> BoolArray:
    """Return whether each column (n, n_columns), or the single signal (n,), varies."""
    return np.array([(column != column[0]).any() for column in np.atleast_2d(values.T)], bool)


def column_means(values: FloatArray) -> FloatArray:
    """Return the mean of each column of samples (n, n_columns), ten times as fast as ``numpy.mean``."""
    return np.array([column.mean() for column in values.T])


def column_variances(values: FloatArray) -> FloatArray:
    """Return the variance of each column of samples (n, n_columns)."""
    squares, variances = np.empty(len(values)), []
    for column in values.T:
        np.square(np.subtract(column, column.mean(), out=squares), out=squares)
        variances.append(squares.mean())
    return np.array(variances)


def centred_rows(values: FloatArray) -> FloatArray:
    """Return the columns of samples (n, n_columns) without their means, as rows of a new array (n_columns, n)."""
    rows = np.array(values.T, order="C")
    rows -= rows.mean(axis=1)[:, None]
    return rows
