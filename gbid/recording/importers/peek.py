"""Look into a file before its import: its channels; its completeness, length and sample time."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from gbid.errors import DataError
from gbid.recording.importers.file_format import FileChannel
from gbid.recording.importers.importing import file_format
from gbid.recording.importers.mapping import ImportMapping
from gbid.recording.importers.sample_time import time_factor, untimed_sample_time


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


def list_channels(path: Path) -> list[FileChannel]:
    """Return all channels of a file of another program, with their names, lengths, units and sample times.

    Parameters
    ----------
    path : pathlib.Path
        The file; its ending decides the reader.

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
        return file_format(path).channels(path)
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror or error}") from None


def peek(path: Path, mapping: ImportMapping) -> Peek:
    """Return the length and sample time of a file that is to be imported, without importing it.

    Of a csv file the header, the first and the last row are read. Of other files the columns are read.

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
        kind = file_format(path)
        if kind.peek is not None:
            n, columns = kind.peek(path, mapping.all_columns())
        else:
            columns = kind.read(path, mapping.all_columns())
            lengths = {name: len(column.values) for name, column in columns.items()}
            n = next(iter(lengths.values()))
            if set(lengths.values()) != {n}:
                text = ", ".join(f"{name} {length}" for name, length in lengths.items())
                raise DataError(f"{path}: columns have different numbers of samples: {text}; write them whole")
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror or error}") from None
    start, stop = mapping.samples or (0, None)
    stop = n if stop is None else stop
    if not start < stop <= n:
        raise DataError(f"{path}: samples {start} to {stop} are not within its {n} samples; correct them")
    if mapping.time is None:
        sample_time = untimed_sample_time(path, mapping, columns)
    elif mapping.sample_time is not None:
        sample_time = mapping.sample_time
    else:
        values = columns[mapping.time].values
        span = float(values[-1] - values[0]) * time_factor(path, mapping, columns[mapping.time])
        if not span > 0 or n < 2:
            raise DataError(f"{path}: time column {mapping.time!r} does not rise; name the right column")
        sample_time = span / (n - 1)
    return Peek(stop - start, sample_time)
