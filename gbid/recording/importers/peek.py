"""Look into a file before its import: its channels; its completeness, length and sample time."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gbid.errors import DataError
from gbid.recording.importers.clock.sample_time import read_clock, time_factor, untimed_sample_time
from gbid.recording.importers.columns import FileColumn
from gbid.recording.importers.file_format import FileChannel
from gbid.recording.importers.importing import check_finite, file_format, sample_range
from gbid.recording.importers.mapping import ImportMapping
from gbid.recording.importers.text.text_options import TextOptions

_ALIKE = 2e-3  # largest relative difference between the mean step and that of the first rows of a clock without gap


@dataclass(frozen=True)
class Peek:
    """Number of samples and sample time of a file.

    Attributes
    ----------
    n_samples : int
        Number of samples that the recording will have.
    sample_time : float
        Time between samples [s].
    """

    n_samples: int
    sample_time: float


def list_channels(path: Path, options: TextOptions | None = None) -> list[FileChannel]:
    """Return all channels of a file of another program, with their names, lengths, units and sample times.

    Parameters
    ----------
    path : pathlib.Path
        The file; its ending decides the reader.
    options : TextOptions, optional
        Layout of a text file, as far as it is given.

    Returns
    -------
    list of FileChannel
        In the order of the file. Names are those that a mapping takes.

    Raises
    ------
    DataError
        When the file cannot be read, is damaged or of another kind.
    UsageError
        When the package that reads the format is not installed.
    """
    try:
        return file_format(path, options).channels(path)
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror or error}") from None


def read_layout(path: Path, options: TextOptions | None = None) -> dict[str, Any]:
    """Return the layout of a text file as it is given or found: encoding, delimiter, decimal sign and lines.

    Returns
    -------
    dict
        Empty for a file of another kind.

    Raises
    ------
    DataError
        When the file cannot be read as text.
    """
    layout = file_format(path, options).layout
    return {} if layout is None else layout(path)


def peek(path: Path, mapping: ImportMapping) -> Peek:
    """Return the length and sample time of a file that is to be imported, without importing it.

    Of a csv file the header, the first rows and the last one are read, unless they show a gap of the clock. Of other
    files the columns are read.

    Parameters
    ----------
    path : pathlib.Path
        The file.
    mapping : ImportMapping
        The mapping of the import.

    Returns
    -------
    Peek

    Raises
    ------
    DataError
        When the file is truncated or of another kind, or when it lacks a column or the requested samples.
    UsageError
        When the unit of the time column is not a unit of time.
    """
    try:
        kind = file_format(path, mapping.text_options)
        if kind.peek is not None:
            found = _from_ends(path, mapping, *kind.peek(path, mapping.all_columns()))
            if found is not None:
                return found
        columns = kind.read(path, mapping.all_columns())
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror or error}") from None
    start, stop = sample_range(path, mapping, columns)
    columns = {name: c._replace(values=c.values[start:stop]) for name, c in columns.items()}
    if mapping.time is not None:
        check_finite(path, {mapping.time: columns[mapping.time]}, start)
    clock = read_clock(path, mapping, columns, start)
    return Peek(len(clock.rows), clock.sample_time)


def _from_ends(path: Path, mapping: ImportMapping, n: int, columns: dict[str, FileColumn]) -> Peek | None:
    """Return length and sample time by the first rows and the last one; None where they show a gap of the clock."""
    if mapping.time is None:
        sample_time = untimed_sample_time(path, mapping, columns)
    else:
        time = columns[mapping.time].values * time_factor(path, mapping, columns[mapping.time])
        sample_time = float(time[-1] - time[0]) / (n - 1)
        steps = np.diff(time[:-1])
        typical = float(np.median(steps)) if steps.size else sample_time
        if mapping.piece is not None or not abs(sample_time - typical) <= _ALIKE * typical:
            return None
        sample_time = mapping.sample_time or sample_time
    times = (mapping.from_s or 0.0, math.inf if mapping.to_s is None else mapping.to_s)
    start, stop = mapping.samples or (min(n, math.ceil(t / sample_time - 1e-6)) if t < math.inf else n for t in times)
    stop = n if stop is None else stop
    if not start < stop <= n:
        raise DataError(f"{path}: samples {start} to {stop} are not within its {n} samples; correct them")
    return Peek(stop - start, sample_time)
