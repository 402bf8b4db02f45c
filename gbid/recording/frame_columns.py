"""Signals and sample time of a recording from the columns of a data frame."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from gbid.arrays import FloatArray
from gbid.errors import DataError, UsageError

MAX_JITTER = 0.01
"""Largest relative deviation of a step of the time from the median step."""


def signal_columns(
    frame: Any, signals: Mapping[str, str | Sequence[str]] | None, time: str | None
) -> tuple[dict[str, FloatArray], dict[str, tuple[str, ...]]]:
    """Return signals and channel names from the columns of a data frame.

    Parameters
    ----------
    frame : pandas.DataFrame
        The data frame; only names and values of its columns are used.
    signals : dict of str to str or sequence of str, optional
        Columns of each signal. By default each column is a channel: ``"p.x"`` is channel x of signal p, and a name
        without a dot is a signal of one channel.
    time : str, optional
        Column of the time, which is no signal.

    Raises
    ------
    UsageError
        When the frame has no such column.
    """
    names = [str(name) for name in frame.columns]
    if signals is None:
        grouped: dict[str, list[str]] = {}
        for name in names:
            if name != time:
                grouped.setdefault(name.partition(".")[0], []).append(name)
        signals = grouped
        channels = {key: tuple(name.partition(".")[2] for name in columns) for key, columns in grouped.items()}
        named = {key: found for key, found in channels.items() if all(found)}
    else:
        named = {}
    values = {}
    for key, given in signals.items():
        columns = [given] if isinstance(given, str) else list(given)
        missing = [name for name in columns if name not in names]
        if missing:
            raise UsageError(f"signal {key!r}: the frame has no column {missing[0]!r}; it has {', '.join(names)}")
        values[key] = np.column_stack([np.asarray(frame.iloc[:, names.index(name)]) for name in columns])
    return values, named


def frame_sample_time(frame: Any, time: str | None) -> float:
    """Return the sample time of a data frame [s], from a column or from its index.

    Parameters
    ----------
    frame : pandas.DataFrame
        The data frame.
    time : str, optional
        Column of the time; the index when left out. Numbers are seconds; dates and time differences work, too.

    Raises
    ------
    DataError
        When the times are not evenly spaced.
    UsageError
        When the frame has no such column, or when its index only numbers the rows.
    """
    if time is not None and time not in list(frame.columns):
        raise UsageError(f"time = {time!r}: the frame has no such column; it has {', '.join(map(str, frame.columns))}")
    index = frame.index if time is None else frame[time]
    if time is None and type(index).__name__ == "RangeIndex":
        raise UsageError("the frame has no times: its index numbers the rows; give sample_time, or the column: time=")
    return _even_step(_seconds(np.asarray(index)))


def _seconds(times: npt.NDArray[Any]) -> FloatArray:
    if times.dtype.kind in "mM":
        return np.asarray((times - times[0]) / np.timedelta64(1, "ns") * 1e-9, float)
    if times.dtype.kind not in "fiu":
        raise DataError("the times of the frame are neither numbers nor dates; give sample_time")
    return np.asarray(times, float)


def _even_step(times: FloatArray) -> float:
    if len(times) < 2:
        raise DataError("the frame has fewer than two rows, so its times give no sample time; give sample_time")
    steps = np.diff(times)
    median = float(np.median(steps))
    uneven = np.flatnonzero(~(np.abs(steps - median) <= MAX_JITTER * abs(median)))
    if not median > 0 or len(uneven):
        at = int(uneven[0]) if len(uneven) else 0
        raise DataError(
            f"the times of the frame are not evenly spaced: step {steps[at]:g} s at row {at + 1}, median step "
            f"{median:g} s; resample the frame, or give sample_time"
        )
    return float(f"{(times[-1] - times[0]) / len(steps):.12g}")  # as an import rounds it
