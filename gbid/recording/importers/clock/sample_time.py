"""Sample time of an import: from the mapping, from a time column, or as the file states it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gbid.arrays import FloatArray
from gbid.errors import DataError, UsageError
from gbid.recording.importers.clock.resampling import jitter_ppm
from gbid.recording.importers.clock.time_steps import (
    MAX_JITTER,
    MAX_RESAMPLED,
    ClockPiece,
    even_pieces,
    largest_deviation,
)
from gbid.recording.importers.columns import FileColumn
from gbid.recording.importers.file_units import file_unit, unit_factor
from gbid.recording.importers.mapping import ImportMapping

MAX_DISAGREEMENT = 1e-3
"""Largest relative difference between sample_time_s, the time column and what the file states."""
_ADJUSTED = 1e-4  # largest relative difference to a round sample time that interpolation corrects
_LISTED = 6  # largest number of pieces that are listed


@dataclass(frozen=True, eq=False)
class Clock:
    """Clock of an imported recording.

    Attributes
    ----------
    rows : (n_samples,) array of int
        Samples to take, counted from the first of the range.
    sample_time : float
        Time between samples [s].
    time : (n_samples,) array or None
        Times at which the samples were taken [s], where they jitter so much that signals must be interpolated.
    remarks : tuple of str
        What was found and done.
    """

    rows: np.ndarray[tuple[int], np.dtype[np.intp]]
    sample_time: float
    time: FloatArray | None = None
    remarks: tuple[str, ...] = ()


def read_clock(path: Path, mapping: ImportMapping, columns: dict[str, FileColumn], start: int) -> Clock:
    """Return the samples to take and their sample time; check that all that give one agree.

    Parameters
    ----------
    path : pathlib.Path
        The file, for messages.
    mapping : ImportMapping
        The mapping of the import.
    columns : dict of str to FileColumn
        Columns by reference.
    start : int
        Number of the first sample, for messages.

    Raises
    ------
    DataError
        When the clock is too uneven, or when two sources of the sample time contradict each other.
    UsageError
        When nothing gives the sample time, when the unit of the time column is not a unit of time, or when there is no
        piece of that number.
    """
    if mapping.time is None:
        if mapping.piece is not None:
            raise UsageError(f"{path}: piece needs the time column, which shows the gaps; name it (time: ...)")
        n = len(next(iter(columns.values())).values)
        return Clock(np.arange(n), untimed_sample_time(path, mapping, columns))
    time = columns[mapping.time].values * time_factor(path, mapping, columns[mapping.time])
    if len(time) < 2:
        raise DataError(f"{path}: time column {mapping.time!r} has one sample; at least two make a sample time")
    found = even_pieces(path, mapping.time, time, {name: c.values for name, c in columns.items()}, start)
    taken, remarks = _chosen(path, mapping, found, time, start)
    time = time[taken.rows]
    uneven = largest_deviation(time)
    if uneven > MAX_RESAMPLED:
        raise DataError(
            f"{path}: time column {mapping.time!r}: steps differ from the median step by up to {uneven:.0%}; "
            f"samples can be interpolated up to {MAX_RESAMPLED:.0%}. If the samples were taken evenly and only their "
            "time stamps are late, leave time out and give sample_time_s; otherwise let the clock of the converter "
            "time them"
        )
    # Rounded to twelve digits: rounding in the column would make equal sample times differ in the last bits.
    mean = float(f"{(time[-1] - time[0]) / (len(time) - 1):.12g}")
    if mapping.sample_time is not None and abs(mean - mapping.sample_time) > MAX_DISAGREEMENT * mapping.sample_time:
        raise DataError(
            f"{path}: sample_time_s = {mapping.sample_time:g} s, but time column {mapping.time!r} has steps of "
            f"{mean:g} s; correct or leave out one of them"
        )
    jitters = uneven > MAX_JITTER
    # What the times leave open: their rounding over the whole length, or nothing that interpolation does not correct.
    open_share = _ADJUSTED if jitters else uneven / (len(time) - 1)
    sample_time = _round_time(mean, open_share) if mapping.sample_time is None else mapping.sample_time
    if not jitters:
        return Clock(taken.rows, sample_time, None, remarks)
    text = (
        f"time jitters by {jitter_ppm(time):.0f} ppm of the sample time (rms): signals interpolated to even times by "
        "band-limited interpolation"
    )
    return Clock(taken.rows, sample_time, time - time[0], (*remarks, text))


def _round_time(mean: float, share: float) -> float:
    """Return the nearest round sample time or rate within a relative distance, so that files of one logger agree."""
    candidates = [float(f"{mean:.4g}"), 1 / float(f"{1 / mean:.4g}")]
    nearest = min(candidates, key=lambda each: abs(each - mean))
    return nearest if abs(nearest - mean) <= share * mean else mean


def _chosen(
    path: Path, mapping: ImportMapping, found: list[ClockPiece], time: FloatArray, start: int
) -> tuple[ClockPiece, tuple[str, ...]]:
    """Return the piece that the mapping names, else the longest, with what was found and done."""
    if mapping.piece is not None and mapping.piece > len(found):
        raise UsageError(f"{path}: piece: there is no piece {mapping.piece}; the clock has {len(found)} without gap")
    taken = found[mapping.piece - 1] if mapping.piece else max(found, key=lambda each: len(each.rows))
    if taken.of == 1:
        return taken, taken.faults
    listed = ", ".join(
        f"{q.number}: samples {start + q.rows[0]} to {start + q.rows[-1]}, {time[q.rows[-1]] - time[q.rows[0]]:.4g} s"
        for q in found[:_LISTED]
    )
    more = f" and {len(found) - _LISTED} more" if len(found) > _LISTED else ""
    which = "the one asked for" if mapping.piece else "the longest; piece: ... takes another"
    text = f"{taken.of} pieces without gap ({listed}{more}), of which piece {taken.number} is taken ({which})"
    return taken, (*taken.faults, text)


def untimed_sample_time(path: Path, mapping: ImportMapping, columns: dict[str, FileColumn]) -> float:
    """Return the sample time [s] of an import without time column: that of the mapping, or as the file states it.

    Raises
    ------
    DataError
        When columns have different sample times, or when mapping and file contradict each other.
    UsageError
        When neither gives one.
    """
    stated = {name: column.sample_time for name, column in columns.items() if column.sample_time is not None}
    if not stated:
        if mapping.sample_time is None:
            raise UsageError(
                f"{path}: neither sample_time_s nor time is given, and the file states no sample time; "
                "give the sample time or the time column"
            )
        return mapping.sample_time
    first = min(stated.values())
    if max(stated.values()) - first > MAX_DISAGREEMENT * first:
        text = ", ".join(f"{name} {value:g} s" for name, value in stated.items())
        raise DataError(f"{path}: columns have different sample times: {text}; import columns of one rate together")
    if mapping.sample_time is None:
        return float(f"{first:.12g}")  # times that are stored with rounding give equal sample times
    if abs(first - mapping.sample_time) > MAX_DISAGREEMENT * mapping.sample_time:
        raise DataError(
            f"{path}: sample_time_s = {mapping.sample_time:g} s, but the file states {first:g} s; leave it out"
        )
    return mapping.sample_time


def time_factor(path: Path, mapping: ImportMapping, column: FileColumn) -> float:
    """Return the number of seconds in one unit of the time column.

    Raises
    ------
    DataError
        When file and mapping give different units.
    UsageError
        When the unit is not a unit of time.
    """
    what = f"time column {mapping.time!r}"
    return unit_factor(path, what, file_unit(path, what, mapping.time_unit, column.unit) or "s", "s")
