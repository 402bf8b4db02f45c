"""Types for readers of file formats: formats, channels, open files and stored arrays."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from gbid.core.arrays import ComplexArray, FloatArray
from gbid.core.errors import DataError, GbidError
from gbid.core.files import in_one_line
from gbid.recording.clock import MAX_RESAMPLED, even_step, jitter_ppm
from gbid.recording.columns import FileColumn, pick_column, split_reference
from gbid.recording.mapping import FilePart


@dataclass(frozen=True)
class FileChannel:
    """Channel of a file, as shown in its list of channels.

    Attributes
    ----------
    name : str
        Name as a mapping gives it, with index and group.
    n_samples : int
        Number of samples.
    unit : str or None
        Unit given by the file.
    sample_time : float or None
        Time between samples that the file states [s].
    step : float or None
        Step of a column that rises evenly, in its own unit. Such a column may be the time column.
    remark : str
        Reason why it is no signal, or the value of a single number.
    jitter_ppm : float or None
        Jitter of such a column in millionths of its step (rms), where it is more than rounding.
    first : tuple of float
        First numbers.
    """

    name: str
    n_samples: int
    unit: str | None = None
    sample_time: float | None = None
    step: float | None = None
    remark: str = ""
    jitter_ppm: float | None = None
    first: tuple[float, ...] = ()


class PairResponse(NamedTuple):
    """Frequency response from one input to one output, read from a file.

    Attributes
    ----------
    frequency_hz : (n,) array
        Frequencies [Hz].
    values : (n,) complex array
        The response.
    quality : (n,) array or None
        Standard deviation or coherence.
    """

    frequency_hz: FloatArray
    values: ComplexArray
    quality: FloatArray | None


SPREAD = "standard deviation of the real part, and of the imaginary part"
"""First line of a function with the standard deviations of a frequency response: the format has no type for them."""

Reader = Callable[..., dict[str, FileColumn]]
"""From a file (pathlib.Path) and references to columns (sequence of str) to these columns. The reader of a text format
takes `TextOptions` as a third argument."""


@dataclass(frozen=True)
class FileFormat:
    """File format for the import of recordings: endings and reading functions.

    Attributes
    ----------
    endings : tuple of str
        File endings, lower case, with the dot.
    read : callable
        From the path and the references of an `ImportMapping` to the columns by reference. Raises DataError.
    channels : callable
        From the path to the channels of the file, for the listing. Raises DataError.
    peek : callable, optional
        From the same to the number of samples and columns that hold no more than some first samples and the last one,
        where this is faster than reading the file.
    states_sample_time : bool
        Whether such files may state the sample time of their channels, so that a mapping need not give it.
    may_crash : bool
        Whether the library that reads such files may crash, hang or fill the memory when a file is damaged. Its
        functions then run in a process of their own.
    takes_part : bool
        Whether `read` takes a `FilePart` by the name ``part``.
    packages : tuple of str
        Optional or large packages that its functions import.
    layout : callable, optional
        For text formats: from the path to the layout of the table, as plain values for the listing. The functions of
        such a format take `TextOptions` as their last argument.
    responses : callable, optional
        For formats of frequency responses: from the path to a `PairResponse` by output and input, and whether their
        quality is the coherence. Raises DataError.
    """

    endings: tuple[str, ...]
    read: Reader
    channels: Callable[..., list[FileChannel]]
    peek: Callable[..., tuple[int, dict[str, FileColumn]]] | None = None
    states_sample_time: bool = False
    may_crash: bool = False
    takes_part: bool = False
    packages: tuple[str, ...] = ()
    layout: Callable[..., dict[str, Any]] | None = None
    responses: Callable[[Path], tuple[dict[tuple[str, str], PairResponse], bool]] | None = None


MAX_COLUMNS = 256
"""Largest number of columns of an array that are listed one by one."""
SHOWN = 3
"""Number of first samples that a listing shows."""


def with_values(channel: FileChannel, values: FloatArray) -> FileChannel:
    """Return a channel with its first numbers, and with step and jitter if it may be a time column."""
    first = tuple(values[:SHOWN].tolist())
    step = even_step(values, MAX_RESAMPLED)
    even = step is None or even_step(values) is not None
    return replace(channel, step=step, first=first, jitter_ppm=None if even else jitter_ppm(values))


class StoredArray(NamedTuple):
    """Array stored under a name in a file.

    Attributes
    ----------
    values : object
        What the library of the format returns.
    unit : str or None
        Unit given by the file.
    sample_time : float or None
        Time between samples that the file states [s].
    fault : str
        Why it cannot be imported, and what to do; empty where it can.
    remark : str
        The same in short for the listing; empty where its numbers are listed.
    first : int or None
        Number of the first sample of `values`, where they are some of the samples.
    total : int or None
        Number of all samples, where `values` are some of them.
    clock, start_ns : int or None
        As of a `FileColumn`.
    unscaled : str
        As of a `FileColumn`.
    """

    values: Any
    unit: str | None = None
    sample_time: float | None = None
    fault: str = ""
    remark: str = ""
    first: int | None = None
    total: int | None = None
    clock: int | None = None
    start_ns: int | None = None
    unscaled: str = ""


ALL = FilePart()
"""The whole file."""


def rows_of(part: FilePart) -> tuple[slice, int | None]:
    """Return the slice of samples to read, and the index of the first one unless all are read."""
    return (slice(None), None) if part.samples is None else (slice(*part.samples), part.samples[0])


def index_of(shape: tuple[int, ...], part: FilePart) -> tuple[tuple[slice, ...], int | None, int | None]:
    """Return the index of the samples to read from an array, the first sample's number, and the total.

    All are read, without numbers, where no samples are named or the axis of time is not the longer one.
    """
    if not (len(shape) == 1 or (len(shape) == 2 and shape[part.axis] == max(shape))):
        return (), None, None
    axis, (rows, first) = part.axis * (len(shape) - 1), rows_of(part)
    return (*[slice(None)] * axis, rows), first, shape[axis]


StoredReader = Callable[[], StoredArray]
"""Function that reads an array of an open file."""


class OpenFile(NamedTuple):
    """Open file with named arrays.

    Attributes
    ----------
    get : callable
        From the name of an array, and the samples that are to be read, to the `StoredArray`. Raises DataError for a
        name that is not there.
    every : callable
        Returns the name of each, in the order of the listing, and a function that returns its `StoredArray`.
    """

    get: Callable[[str, FilePart], StoredArray]
    every: Callable[[], Iterable[tuple[str, StoredReader]]]


Opener = Callable[[Path, Sequence[str] | None], AbstractContextManager[OpenFile]]
"""From a file and the names that are wanted (None: all) to a context with the open file."""


def array_format(
    endings: tuple[str, ...], what: str, opener: Opener, *packages: str, states_sample_time: bool = False
) -> FileFormat:
    """Return a format of files with named arrays, read in a separate process because the library may crash.

    Parameters
    ----------
    endings, packages, states_sample_time
        As for `FileFormat`.
    what : str
        Kind of file in words, for messages.
    opener : callable
        Function of a module that opens such a file. What its library raises becomes a DataError.
    """
    return FileFormat(
        endings,
        partial(_read_arrays, opener, what),
        partial(_list_arrays, opener, what),
        states_sample_time=states_sample_time,
        may_crash=True,
        takes_part=True,
        packages=packages,
    )


def _read_arrays(
    opener: Opener, what: str, path: Path, references: Sequence[str], part: FilePart = ALL
) -> dict[str, FileColumn]:
    names = {reference: split_reference(reference)[0] for reference in references}
    columns, totals = {}, dict[str, int]()
    with _opened(opener, what, path, list(names.values())) as file:
        for reference, name in names.items():
            stored = file.get(name, part)
            if stored.fault:
                raise DataError(f"{path}: column {reference!r}: {stored.fault}")
            if part.samples is not None and stored.total is not None:
                totals[name] = stored.total
                if part.samples[1] > stored.total:
                    text = f"samples {part.samples[0]} to {part.samples[1]} are not within its {stored.total} samples"
                    raise DataError(f"{path}: {name}: {text}")
            values = pick_column(path, reference, stored.values, part.axis, is_part=stored.first is not None)
            columns[reference] = FileColumn(
                values,
                stored.unit,
                stored.sample_time,
                first=stored.first,
                clock=stored.clock,
                start_ns=stored.start_ns,
                unscaled=stored.unscaled,
            )
    if len(set(totals.values())) > 1 and any(column.start_ns is None for column in columns.values()):
        text = ", ".join(f"{name} {total}" for name, total in totals.items())
        raise DataError(f"{path}: columns have different numbers of samples: {text}")
    return columns


def _list_arrays(opener: Opener, what: str, path: Path) -> list[FileChannel]:
    channels, faults, reads = [], list[Exception](), 0
    with _opened(opener, what, path, None) as file:
        for name, read in file.every():
            reads += 1
            try:
                channels += _array_channels(name, read())
            except MemoryError:
                raise
            except Exception as error:  # of one array: the others are listed
                faults.append(error)
                reason = str(error).removeprefix(f"{path}: ") if isinstance(error, GbidError) else in_one_line(error)
                channels.append(FileChannel(name, 0, remark=f"not read: {reason}"))
        if faults and len(faults) == reads:
            raise faults[0]
    return channels


@contextmanager
def _opened(opener: Opener, what: str, path: Path, names: Sequence[str] | None) -> Iterator[OpenFile]:
    with path.open("rb"):  # libraries wrap the error of a file that is not there
        pass
    try:
        with opener(path, names) as file:
            yield file
    except (GbidError, MemoryError):
        raise
    except Exception as error:  # a damaged file can raise any kind of error in the library
        text = f"not a readable {what} (truncated, damaged or of another format)"
        raise DataError(f"{path}: {text}: {in_one_line(error)}") from None


def _array_channels(name: str, stored: StoredArray) -> list[FileChannel]:
    """Return the channels of an array with names for `pick_column`; unusable ones have a remark."""
    value, unit, sample_time, _, remark, *_ = stored
    if remark:
        return [FileChannel(name, int(np.size(value)), unit, sample_time, remark=remark)]
    if not isinstance(value, np.ndarray) or value.dtype.kind not in "fiub":
        kind = f"array of {value.dtype}" if isinstance(value, np.ndarray) else type(value).__name__
        return [FileChannel(name, int(np.size(value)), unit, sample_time, remark=f"{kind}: not numbers")]
    if value.size == 1:
        return [FileChannel(name, 1, unit, sample_time, remark=f"one number: {value.flat[0]:g}")]
    if value.size == 0 or value.ndim > 2:
        return [FileChannel(name, 0, unit, sample_time, remark=f"shape {value.shape}: no column of samples")]
    columns = np.asarray(value, float).reshape(len(value), -1)
    rows, count = columns.shape
    if rows < count or count > MAX_COLUMNS:
        which = (
            "more columns than rows: axis: 1 where they are samples" if rows < count else f"name columns {name}[0] ..."
        )
        return [FileChannel(name, rows, unit, sample_time, remark=f"shape {value.shape}: {which}")]
    names = [name] if count == 1 else [f"{name}[{i}]" for i in range(count)]
    return [
        with_values(FileChannel(each, rows, unit, sample_time), column)
        for each, column in zip(names, columns.T, strict=True)
    ]
