"""Steps of a time column: gaps, doubled samples and jitter."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from gbid.arrays import FloatArray
from gbid.errors import DataError

MAX_JITTER = 0.01
"""Largest relative deviation of a time step from the median step that is taken as rounding of the time column."""
MAX_RESAMPLED = 0.2
"""Largest relative deviation of a time step from the median step for which samples are interpolated."""
_GAP = 1.5  # a step is a gap from here on, in median steps
_NAMED = 3  # largest number of faults that are named
_DOUBLED = 0.05  # share of equal times from which the column is called rounded


@dataclass(frozen=True)
class ClockPiece:
    """Samples of a file that one even clock describes.

    Attributes
    ----------
    rows : (n_samples,) array of int
        Numbers of the samples, from 0.
    number, of : int
        Number of the piece from 1, and how many there are.
    faults : tuple of str
        Gaps and doubled samples of the whole file.
    """

    rows: np.ndarray[tuple[int], np.dtype[np.intp]]
    number: int = 1
    of: int = 1
    faults: tuple[str, ...] = ()


def even_step(values: FloatArray, tolerance: float = MAX_JITTER) -> float | None:
    """Return the median step of a column that rises in even steps, as a time column does; otherwise None.

    Parameters
    ----------
    values : (n_samples,) array
        The column.
    tolerance : float
        Largest relative deviation of a step from the median step.
    """
    steps = np.diff(values)
    if not steps.size or not np.isfinite(steps).all():
        return None
    median = float(np.median(steps))
    even = median > 0 and bool((np.abs(steps - median) <= tolerance * median).all())
    return median if even else None


def largest_deviation(time: FloatArray) -> float:
    """Return the largest relative deviation of a time step from the median step."""
    steps = np.diff(time)
    median = np.median(steps)
    return float(np.max(np.abs(steps - median)) / median)


def even_pieces(
    path: Path, what: str, time: FloatArray, columns: Mapping[str, FloatArray], start: int
) -> list[ClockPiece]:
    """Return the pieces without gap of a recording; doubled samples are left out.

    A sample is doubled when it has the time and the values of the one before. A gap is a step of more than 1.5 median
    steps, a step back, or two samples of one time with different values.

    Parameters
    ----------
    path : pathlib.Path
        The file, for messages.
    what : str
        Name of the time column, for messages.
    time : (n_samples,) array
        Times [s].
    columns : dict of str to (n_samples,) array
        All columns of the import.
    start : int
        Number of the first sample in the file.

    Returns
    -------
    list of ClockPiece
        In the order of time, without pieces of one sample.

    Raises
    ------
    DataError
        When the times do not rise, or when many are equal.
    """
    steps = np.diff(time)
    median = float(np.median(steps))
    if median <= 0 or np.mean(steps == 0) > _DOUBLED:
        k = int(np.flatnonzero(steps <= 0)[0])
        raise DataError(
            f"{path}: time column {what!r} does not rise at sample {start + k + 1}: step {steps[k]:g} s "
            f"({np.sum(steps <= 0)} such steps); name the right column, or give sample_time_s instead if only the "
            "column is rounded"
        )
    same = steps == 0
    for values in columns.values():
        same &= np.diff(values) == 0
    kept = np.flatnonzero(np.concatenate([[True], ~same]))
    steps = np.diff(time[kept])
    at = np.flatnonzero((steps <= 0) | (steps > _GAP * median))
    faults = [_gap(float(steps[k]), median, float(time[kept[k]]), start + int(kept[k])) for k in at[:_NAMED]]
    if len(at) > _NAMED:
        faults.append(f"{len(at) - _NAMED} more gaps")
    doubled = np.flatnonzero(same) + 1
    if doubled.size:
        faults.append(f"{doubled.size} doubled samples left out, the first is sample {start + doubled[0]}")
    edges = [0, *(at + 1).tolist(), len(kept)]
    pieces = [kept[a:b] for a, b in pairwise(edges) if b - a > 1]
    if not pieces:
        raise DataError(f"{path}: time column {what!r} does not rise evenly anywhere; name the right column")
    return [ClockPiece(rows, i, len(pieces), tuple(faults)) for i, rows in enumerate(pieces, start=1)]


def _gap(step: float, median: float, time: float, sample: int) -> str:
    after = f"after sample {sample} ({time:g} s)"
    if step <= 0:
        return f"the clock goes back by {-step:g} s {after}" if step < 0 else f"two samples of one time {after}"
    missing = step / median - 1
    if abs(missing - round(missing)) < MAX_RESAMPLED:
        return f"{round(missing)} samples missing {after}"
    return f"a gap of {step:g} s {after}"
