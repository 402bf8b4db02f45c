"""Channels of a stored array, for the listing of a file."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from gbid.arrays import FloatArray
from gbid.recording.importers.clock.resampling import jitter_ppm
from gbid.recording.importers.clock.time_steps import MAX_RESAMPLED, even_step
from gbid.recording.importers.file_format import FileChannel

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
