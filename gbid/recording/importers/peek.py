"""Quick check of a file before its import: its completeness, columns, length and sample time."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from gbid.errors import DataError
from gbid.recording.importers.importing import file_format, time_factor
from gbid.recording.importers.mapping import ImportMapping


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


def peek(path: Path, mapping: ImportMapping) -> Peek:
    """Return the length and sample time of a file that is to be imported, without importing it.

    Of a csv file the header, the first and the last row are read. Of npz and mat files the columns are read.

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
    sample_time = mapping.sample_time
    if sample_time is None:
        assert mapping.time is not None  # checked by ImportMapping
        values = columns[mapping.time].values
        span = float(values[-1] - values[0]) * time_factor(path, mapping, columns[mapping.time])
        if not span > 0 or n < 2:
            raise DataError(f"{path}: time column {mapping.time!r} does not rise; name the right column")
        sample_time = span / (n - 1)
    return Peek(stop - start, sample_time)
