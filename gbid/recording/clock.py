"""Clocks of imported recordings: sample time, units of times, columns with different clocks, gaps and jitter."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import numpy.typing as npt
import scipy

from gbid.core.arrays import FloatArray
from gbid.core.errors import DataError, UsageError
from gbid.recording.columns import FileColumn, file_unit, unit_factor
from gbid.recording.mapping import ImportMapping

DEGREE = 9
"""Degree of the interpolating splines. With rising degree they approach the interpolation by sinc functions. At this
one the error is below 2e-5 of a sine of a fifth of the sampling rate, at a jitter of 10 % of the sample time."""
FEW_LEVELS = 16
"""A signal with at most this number of distinct values is a command that is held; it keeps its values."""
_BEYOND = 0.1  # largest extrapolation at the end, in sample times
_TURN = 2 * np.pi


def jitter_ppm(time: FloatArray) -> float:
    """Return the rms deviation of sample times from evenly spaced ones, in millionths of the sample time."""
    index = np.arange(len(time), dtype=float)
    steps = (time - time[0]) / np.median(np.diff(time))  # no time is too long for its square
    slope, offset = np.polyfit(index, steps, 1)
    return float(1e6 * np.std(steps - slope * index - offset) / slope)


def resampled(values: FloatArray, unit: str, time: FloatArray, sample_time: float) -> FloatArray:
    """Return signals interpolated to evenly spaced times, from the first to the last time.

    Parameters
    ----------
    values : (n_samples, n_channels) array
        Signals at the times of the file.
    unit : str
        Their unit. An angle in rad is unwrapped for the interpolation and wrapped again.
    time : (n_samples,) array
        Times of the file [s], rising.
    sample_time : float
        Time between the even samples [s].
    """
    grid = time[0] + sample_time * np.arange(int((time[-1] - time[0]) / sample_time + _BEYOND) + 1)
    out = np.empty((len(grid), values.shape[1]))
    nearest = np.clip(np.searchsorted((time[1:] + time[:-1]) / 2, grid), 0, len(time) - 1)
    degree = min(DEGREE, len(time) - 1)
    for k, column in enumerate(values.T):
        if len(np.unique(column)) <= FEW_LEVELS:
            out[:, k] = column[nearest]
            continue
        wraps = unit == "rad" and bool((np.abs(np.diff(column)) > np.pi).any())
        smooth = np.unwrap(column) if wraps else column
        even = scipy.interpolate.make_interp_spline(time, smooth, k=degree - 1 + degree % 2)(grid)
        low = 0.0 if column.min() >= 0 else -np.pi
        out[:, k] = np.mod(even - low, _TURN) + low if wraps else even
    return out


MAX_JITTER = 0.01
"""Largest relative deviation of a time step from the median step that is taken as rounding of the time column."""
MAX_RESAMPLED = 0.2
"""Largest relative deviation of a time step from the median step for which samples are interpolated."""
_GAP = 1.5  # a step is a gap from here on, in median steps
_NAMED = 3  # largest number of faults that are named
_DOUBLED = 0.05  # share of equal times from which the column is called rounded


@dataclass(frozen=True)
class ClockPiece:
    """Samples of a file with one evenly spaced clock, between gaps.

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
    """Return the median step of a column with evenly rising values, such as a time column; else None.

    Parameters
    ----------
    values : (n_samples,) array
        The column.
    tolerance : float
        Largest relative deviation of a step from the median step.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        steps = np.diff(values)
        if not steps.size or not np.isfinite(steps).all() or not np.isfinite(values[-1] - values[0]):
            return None
    median = float(np.median(steps))
    even = median > 0 and bool((np.abs(steps - median) <= tolerance * median).all())
    return median if even else None


def even_pieces(
    path: Path, what: str, time: FloatArray, columns: Mapping[str, FloatArray], start: int
) -> list[ClockPiece]:
    """Return the gap-free pieces of a recording; repeated samples are left out.

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


_SAME_STEP = 1e-9  # largest relative difference of the steps of two clocks by rounding
_OFF_GRID = 0.02  # largest part of a sample by which starts of clocks, and their ends, may differ from whole samples


def has_one_clock(columns: Mapping[str, FileColumn]) -> bool:
    """Return whether all columns have equal times, as far as the file states starts and steps."""
    starts = {column.start_ns for column in columns.values()}
    steps = [column.sample_time for column in columns.values() if column.sample_time is not None]
    if steps and max(steps) - min(steps) > _SAME_STEP * max(steps):
        return False
    if len({column.clock for column in columns.values()}) <= 1:
        return len(starts - {None}) <= 1
    return len(starts) == 1 and None not in starts and len(steps) in (0, len(columns))


def joined(path: Path, columns: Mapping[str, FileColumn]) -> dict[str, FileColumn]:
    """Return columns with different start times, cut to their common time span, with a remark.

    Parameters
    ----------
    path : pathlib.Path
        The file, for messages.
    columns : dict of str to FileColumn
        Whole columns by reference.

    Raises
    ------
    DataError
        When a column does not say when it begins or has uneven times, or when starts differ by parts of a sample.
    """
    if has_one_clock(columns):
        return dict(columns)
    _refuse_other_rates(path, {name: each.sample_time for name, each in columns.items() if each.sample_time})
    for name, column in columns.items():
        if column.start_ns is None or column.sample_time is None:
            other = next(each for each in columns if each != name)
            raise DataError(
                f"{path}: column {name!r} has a clock of its own, without a start or with uneven steps, and cannot be "
                f"joined with {other!r}; import columns of one clock, or resample them with the program of the logger"
            )
    steps = {name: float(column.sample_time or 0.0) for name, column in columns.items()}
    step, start = min(steps.values()), max(column.start_ns or 0 for column in columns.values())
    offsets = {name: 1e-9 * (start - (column.start_ns or 0)) / steps[name] for name, column in columns.items()}
    firsts = {name: round(offset) for name, offset in offsets.items()}
    n = min(len(column.values) - firsts[name] for name, column in columns.items())
    if n < 2:
        raise DataError(f"{path}: columns have no common time: {_starts_in_words(columns)}; record them together")
    drift = {name: abs(offsets[name] - firsts[name]) + n * abs(each / step - 1) for name, each in steps.items()}
    worst = max(drift, key=lambda name: drift[name])
    begin = _starts_in_words(columns)
    if drift[worst] > _OFF_GRID:
        raise DataError(
            f"{path}: column {worst!r} lies {drift[worst]:.2g} of a sample off the others "
            f"({begin or 'the steps of their clocks differ'}); sample all channels with one clock, or resample them "
            "with the program of the logger"
        )
    remark = f"{begin or 'clocks of several columns'}: aligned on their common span of {n} samples"
    return {
        name: column._replace(
            values=column.values[firsts[name] : firsts[name] + n],
            remark="; ".join(filter(None, (column.remark, remark))),
        )
        for name, column in columns.items()
    }


def _refuse_other_rates(path: Path, steps: Mapping[str, float]) -> None:
    first = min(steps.values())
    if max(steps.values()) - first > MAX_DISAGREEMENT * first:
        text = ", ".join(f"{name} {value:g} s" for name, value in steps.items())
        raise DataError(f"{path}: columns have different sample times: {text}; import columns of one rate together")


def _starts_in_words(columns: Mapping[str, FileColumn]) -> str:
    """Return a text on the start times of columns relative to the first one."""
    first = min(columns, key=lambda name: columns[name].start_ns or 0)
    after = {name: 1e-9 * ((column.start_ns or 0) - (columns[first].start_ns or 0)) for name, column in columns.items()}
    late = [(name, seconds) for name, seconds in after.items() if seconds > 0]
    text = ", ".join(
        f"{name} begins {seconds:.6g} s ({seconds / (columns[name].sample_time or 1.0):.4g} samples) after {first}"
        for name, seconds in late[:_LISTED]
    )
    return f"{text} and {len(late) - _LISTED} more" if len(late) > _LISTED else text


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
    places : (n_samples,) array of int or None
        Numbers of the samples on the grid of an import with missing samples.
    stamps : (n_samples,) array or None
        Irregular times that are kept [s].
    """

    rows: np.ndarray[tuple[int], np.dtype[np.intp]]
    sample_time: float
    time: FloatArray | None = None
    remarks: tuple[str, ...] = ()
    places: npt.NDArray[np.intp] | None = None
    stamps: FloatArray | None = None


_LONGEST_GRID = 200  # samples of the grid for each measured one: passes of a fit go over all of them


def _grid(path: Path, mapping: ImportMapping, time: FloatArray, start: int) -> Clock:
    """Return a clock on a grid of times with missing samples, or with irregular times.

    A sample time that is given is the step of the grid. Without one the times are their own where they fit no grid.
    """
    steps = np.diff(time)
    if not (steps > 0).all():
        k = int(np.flatnonzero(steps <= 0)[0])
        raise DataError(f"{path}: time column {mapping.time!r} does not rise at sample {start + k + 1}; correct it")
    step = mapping.sample_time or float(np.median(steps))
    places = np.concatenate([[0], np.cumsum(np.rint(steps / step))]).astype(np.intp)
    if mapping.sample_time is None:
        step = _round_time(float(np.polyfit(places, time - time[0], 1)[0]), MAX_JITTER / max(1, int(places[-1])))
    else:
        places = np.rint((time - time[0]) / step).astype(np.intp)
    off, usual = float(np.abs(time - time[0] - step * places).max()), float(np.median(steps))
    rows = np.arange(len(time))
    if off > MAX_JITTER * usual or (np.diff(places) < 1).any():
        if mapping.sample_time is None:
            text = f"{len(np.unique(np.rint(1e6 * steps / usual)))} different intervals: the times are kept as they are"
            return Clock(rows, float(time[-1] - time[0]) / (len(time) - 1), None, (text,), stamps=time - time[0])
        raise DataError(
            f"{path}: gaps: missing: the times are up to {off / usual:.2g} of their median step off an even grid of "
            f"{step:g} s; leave out sample_time_s to keep the times as they are, or give the resolution of the clock, "
            "of which all times are multiples"
        )
    if places[-1] >= _LONGEST_GRID * len(time):
        raise DataError(
            f"{path}: gaps: missing: with steps of {step:g} s there would be {places[-1] + 1} samples for {len(time)} "
            "measured ones; leave out sample_time_s to keep the times as they are, or import pieces"
        )
    remark = f"{places[-1] + 1 - len(time)} of {places[-1] + 1} samples are missing"
    return Clock(rows, step, None, (remark,), places)


def on_grid(values: FloatArray, places: npt.NDArray[np.intp]) -> FloatArray:
    """Return samples (n, n_channels) at their places on a time grid; missing samples are NaN."""
    grid = np.full((int(places[-1]) + 1, values.shape[1]), np.nan)
    grid[places] = values
    return grid


def read_clock(path: Path, mapping: ImportMapping, columns: dict[str, FileColumn], start: int) -> Clock:
    """Return the samples to import and the sample time; all stated sample times must agree.

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
            raise UsageError(f"{path}: piece chooses a part between gaps in time; name the time column (time: ...)")
        n = len(next(iter(columns.values())).values)
        return Clock(np.arange(n), untimed_sample_time(path, mapping, columns))
    time, unit_remark = times_of(path, mapping, mapping.time, columns)
    if len(time) < 2:
        raise DataError(f"{path}: time column {mapping.time!r} has one sample; at least two make a sample time")
    if mapping.gaps == "missing":
        clock = _grid(path, mapping, time, start)
        return replace(clock, remarks=(*unit_remark, *clock.remarks))
    pieces = even_pieces(path, mapping.time, time, {name: c.values for name, c in columns.items()}, start)
    piece, remarks = _chosen(path, mapping, pieces, time, start)
    time = time[piece.rows]
    steps = np.diff(time)
    remarks = (*unit_remark, *remarks)
    uneven = float(np.abs(steps / np.median(steps) - 1).max())  # largest relative deviation from the median step
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
        return Clock(piece.rows, sample_time, None, remarks)
    text = (
        f"time jitters by {jitter_ppm(time):.0f} ppm of the sample time (rms): signals interpolated to even times by "
        "band-limited interpolation"
    )
    return Clock(piece.rows, sample_time, time - time[0], (*remarks, text))


def _round_time(mean: float, share: float) -> float:
    """Return a round sample time or rate within a relative distance, so that files of one logger agree."""
    candidates = [float(f"{mean:.4g}"), 1 / float(f"{1 / mean:.4g}")]
    nearest = min(candidates, key=lambda each: abs(each - mean))
    return nearest if abs(nearest - mean) <= share * mean else mean


def _chosen(
    path: Path, mapping: ImportMapping, pieces: list[ClockPiece], time: FloatArray, start: int
) -> tuple[ClockPiece, tuple[str, ...]]:
    """Return the piece selected by the mapping, else the longest piece, with remarks on gaps."""
    if mapping.piece is not None and mapping.piece > len(pieces):
        raise UsageError(f"{path}: piece: there is no piece {mapping.piece}; the clock has {len(pieces)} without gap")
    piece = pieces[mapping.piece - 1] if mapping.piece else max(pieces, key=lambda each: len(each.rows))
    if piece.of == 1:
        return piece, piece.faults
    listed = ", ".join(
        f"{q.number}: samples {start + q.rows[0]} to {start + q.rows[-1]}, {time[q.rows[-1]] - time[q.rows[0]]:.4g} s"
        for q in pieces[:_LISTED]
    )
    more = f" and {len(pieces) - _LISTED} more" if len(pieces) > _LISTED else ""
    which = "the one asked for" if mapping.piece else "the longest; piece: ... takes another"
    text = f"{piece.of} pieces without gap ({listed}{more}), of which piece {piece.number} is taken ({which})"
    return piece, (*piece.faults, text)


def untimed_sample_time(path: Path, mapping: ImportMapping, columns: dict[str, FileColumn]) -> float:
    """Return the sample time [s] of an import without time column, from the mapping or the file.

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
    _refuse_other_rates(path, stated)
    first = min(stated.values())
    if mapping.sample_time is None:
        return float(f"{first:.12g}")  # times that are stored with rounding give equal sample times
    if abs(first - mapping.sample_time) > MAX_DISAGREEMENT * mapping.sample_time:
        raise DataError(
            f"{path}: sample_time_s = {mapping.sample_time:g} s, but the file states {first:g} s; leave it out"
        )
    return mapping.sample_time


_LONGEST = 1e100  # s; no sum or square of such times overflows
_SHORTEST_STEP, _LONGEST_STEP = 1e-6, 1.0  # s; sample times of rigs
_SINCE_1970 = ((1e12, 1e13, "ms"), (1e15, 1e16, "us"), (1e18, 1e19, "ns"))
_DAY = 86400.0  # s
_DAYS = ((2e4, 8e4), (7e5, 8e5))  # days since 1900 of spreadsheets, and since the year 0 of MATLAB


def times_of(
    path: Path, mapping: ImportMapping, name: str, columns: Mapping[str, FileColumn]
) -> tuple[FloatArray, tuple[str, ...]]:
    """Return the values of the time column [s], with a remark if their unit is guessed.

    A unit that neither file nor mapping gives is the second, unless the numbers are those of dates.

    Raises
    ------
    DataError
        When file and mapping give different units, or when the values are too large for times.
    UsageError
        When the unit is not a unit of time, or when it is not given and may be seconds or days.
    """
    what, column = f"time column {name!r}", columns[name]
    stated = file_unit(path, what, mapping.time_unit, column.unit)
    unit = stated or _unit_of_dates(path, what, column)
    with np.errstate(over="ignore"):
        time = column.values * unit_factor(path, what, unit, "s")
    largest = float(np.abs(time).max(initial=0.0))
    if largest >= _LONGEST:
        raise DataError(f"{path}: {what} reaches {largest:g} s, which is no time; name the right column")
    step = float(np.median(np.diff(time))) if len(time) > 1 else _LONGEST_STEP
    text = ""
    if stated is None and unit != "s":
        text = f"its times are those of dates, read in {unit} (the first is {column.values[0]:.15g})"
    elif stated is None and not _SHORTEST_STEP <= step <= _LONGEST_STEP:
        text = f"the times are read in seconds: a sample time of {step:g} s; give time_unit if that is wrong"
    return time, (f"{what} has no unit; {text}",) if text else ()


def _unit_of_dates(path: Path, what: str, column: FileColumn) -> str:
    """Return the unit of times without a stated unit: seconds, unless the numbers look like dates."""
    first, step = float(column.values[0]), float(np.median(np.diff(column.values))) if len(column.values) > 1 else 1.0
    for low, high, unit in _SINCE_1970:
        if low <= first < high:
            return unit
    if not any(low <= first < high for low, high in _DAYS) or not 0 < step < _LONGEST_STEP / _DAY:
        return "s"
    if step < _SHORTEST_STEP:
        return "day"
    raise UsageError(
        f"{path}: {what} begins at {first:.10g} with steps of {step:.3g}: days (steps of {step * _DAY:.3g} s) or "
        "seconds; give time_unit: day or time_unit: s"
    )
