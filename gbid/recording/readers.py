"""Parts of an importer: the file format, its channels, and the listing of arrays."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from gbid.core.arrays import FloatArray
from gbid.recording.clock import MAX_RESAMPLED, even_step, jitter_ppm
from gbid.recording.text_files import FileColumn


@dataclass(frozen=True)
class FileChannel:
    """Channel of a file, as its listing shows it.

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


Reader = Callable[..., dict[str, FileColumn]]
"""From a file (pathlib.Path) and references to columns (sequence of str) to these columns. The reader of a text format
takes `TextOptions` as a third argument."""


@dataclass(frozen=True)
class FileFormat:
    """A format of files that recordings are imported from.

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
    layout : callable, optional
        For text formats: from the path to the layout of the table, as plain values for the listing. The functions of
        such a format take `TextOptions` as their last argument.
    """

    endings: tuple[str, ...]
    read: Reader
    channels: Callable[..., list[FileChannel]]
    peek: Callable[..., tuple[int, dict[str, FileColumn]]] | None = None
    states_sample_time: bool = False
    may_crash: bool = False
    layout: Callable[..., dict[str, Any]] | None = None


# ---- Channels of a stored array, for the listing of a file.

MAX_COLUMNS = 256
"""Largest number of columns of an array that are listed one by one."""
SHOWN = 3
"""Number of first samples that a listing shows."""


def with_values(channel: FileChannel, values: FloatArray) -> FileChannel:
    """Return a channel with its first numbers, and with its step and jitter where it may be a time column."""
    first = tuple(values[:SHOWN].tolist())
    step = even_step(values, MAX_RESAMPLED)
    even = step is None or even_step(values) is not None
    return replace(channel, step=step, first=first, jitter_ppm=None if even else jitter_ppm(values))


def array_channels(
    name: str, value: Any, *, unit: str | None = None, sample_time: float | None = None, row_vectors: bool = False
) -> list[FileChannel]:
    """Return the channels of an array, each with the name that `pick_column` takes.

    Parameters
    ----------
    name : str
        Name of the array in the file.
    value : object
        The array. What is no array of real numbers is one channel with a remark.
    unit : str, optional
        Unit given by the file.
    sample_time : float, optional
        Time between samples that the file states [s].
    row_vectors : bool
        Whether a (1, n_samples) array is a vector, as MATLAB stores one.
    """
    if not isinstance(value, np.ndarray) or value.dtype.kind not in "fiub":
        kind = f"array of {value.dtype}" if isinstance(value, np.ndarray) else type(value).__name__
        return [FileChannel(name, int(np.size(value)), unit, sample_time, remark=f"{kind}: not numbers")]
    if value.size == 1:
        return [FileChannel(name, 1, unit, sample_time, remark=f"one number: {value.flat[0]:g}")]
    if value.size == 0 or value.ndim > 2:
        return [FileChannel(name, 0, unit, sample_time, remark=f"shape {value.shape}: no column of samples")]
    if value.ndim == 1 or value.shape[1] == 1 or (row_vectors and value.shape[0] == 1):
        column = np.asarray(value, float).reshape(-1)
        return [with_values(FileChannel(name, column.size, unit, sample_time), column)]
    rows, columns = value.shape
    if rows < columns or columns > MAX_COLUMNS:
        remark = f"shape {value.shape}: " + (
            "more columns than rows" if rows < columns else f"name columns {name}[0] ..."
        )
        return [FileChannel(name, rows, unit, sample_time, remark=remark)]
    return [
        with_values(FileChannel(f"{name}[{i}]", rows, unit, sample_time), np.asarray(value[:, i], float))
        for i in range(columns)
    ]
