"""Sample time of an import: from the mapping, from a time column, or as the file states it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gbid.errors import DataError, UsageError
from gbid.recording.importers.columns import MAX_JITTER, FileColumn
from gbid.recording.importers.file_units import file_unit, unit_factor
from gbid.recording.importers.mapping import ImportMapping

MAX_DISAGREEMENT = 1e-3
"""Largest relative difference between sample_time, the time column and what the file states."""


def sample_time_of(path: Path, mapping: ImportMapping, columns: dict[str, FileColumn], start: int) -> float:
    """Return the sample time [s]; check that all that give one agree.

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
        When the clock jumps, or when two sources of the sample time contradict each other.
    UsageError
        When nothing gives the sample time, or when the unit of the time column is not a unit of time.
    """
    if mapping.time is None:
        return untimed_sample_time(path, mapping, columns)
    time = columns[mapping.time].values * time_factor(path, mapping, columns[mapping.time])
    if len(time) < 2:
        raise DataError(f"{path}: time column {mapping.time!r} has one sample; at least two make a sample time")
    steps = np.diff(time)
    median = float(np.median(steps))
    bad = np.flatnonzero((steps <= 0) | (np.abs(steps - median) > MAX_JITTER * abs(median)))
    if bad.size:
        k = bad[0]
        raise DataError(
            f"{path}: time column {mapping.time!r} jumps at sample {start + k + 1}: step {steps[k]:g} s, "
            f"median step {median:g} s ({bad.size} such steps); cut them off with samples, or give sample_time "
            "instead if only the column is rounded"
        )
    # Rounded to twelve digits: rounding in the column would make equal sample times differ in the last bits.
    mean = float(f"{(time[-1] - time[0]) / len(steps):.12g}")
    if mapping.sample_time is None:
        return mean
    if abs(mean - mapping.sample_time) > MAX_DISAGREEMENT * mapping.sample_time:
        raise DataError(
            f"{path}: sample_time = {mapping.sample_time:g} s, but time column {mapping.time!r} has steps of "
            f"{mean:g} s; correct or leave out one of them"
        )
    return mapping.sample_time


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
                f"{path}: neither sample_time nor time is given, and the file states no sample time; "
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
            f"{path}: sample_time = {mapping.sample_time:g} s, but the file states {first:g} s; leave it out"
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
