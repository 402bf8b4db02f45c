"""A short look at a foreign file: is it whole, has it the columns, how long is it, how fast was it sampled."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from gbid.errors import DataError
from gbid.recording.importers.csv_file import peek_csv
from gbid.recording.importers.importing import file_reader, time_factor
from gbid.recording.importers.mapping import ImportMapping


@dataclass(frozen=True)
class Peek:
    """What a short look at a file shows.

    Attributes
    ----------
    n_samples : int
        That the recording will have.
    sample_time : float
        [s].
    """

    n_samples: int
    sample_time: float


def peek(path: Path, mapping: ImportMapping) -> Peek:
    """Look at a file that is to be imported, without converting what is in it.

    A csv file is judged by its header, its first and its last row; of npz and mat files the columns are read.

    Parameters
    ----------
    path : pathlib.Path
    mapping : ImportMapping

    Returns
    -------
    Peek

    Raises
    ------
    DataError
        When the file is truncated or of another kind, lacks a column, or does not have the samples asked for.
    UsageError
        When the unit of the time column is no time.
    """
    try:
        if path.suffix.lower() == ".csv":
            n, columns = peek_csv(path, mapping.all_columns())
        else:
            columns = file_reader(path)(path, mapping.all_columns())
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
        assert mapping.time is not None  # ImportMapping sees to that
        values = columns[mapping.time].values
        span = float(values[-1] - values[0]) * time_factor(path, mapping, columns[mapping.time])
        if not span > 0 or n < 2:
            raise DataError(f"{path}: time column {mapping.time!r} does not rise; name the right column")
        sample_time = span / (n - 1)
    return Peek(stop - start, sample_time)
