"""Check of the speed over a recording: a run-up, a coast-down, a speed that changes."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from gbid.recording.quality_problem import SignalProblem
from gbid.recording.quality_time import SPEED_TOLERANCE, find_encoder_faults, turning_increments
from gbid.recording.recording import Recording

BLOCK = 0.05
"""Shortest block over which a speed is averaged [s]; it is at least a turn long."""


MARGIN = 0.05
"""Share of a run-up that is cut away in addition, because its end is slow."""


@dataclass(frozen=True)
class SpeedChange:
    """Change of the speed within a recording.

    Attributes
    ----------
    share : float
        Share of the recording in which the shaft does not turn at the stated speed.
    low, high : float
        Lowest and highest speed there [rpm].
    from_s, to_s : float or None
        Longest part at the stated speed [s]; None where it begins or ends with the recording.
    steady : bool
        Whether there is such a part.
    """

    share: float
    low: float
    high: float
    from_s: float | None = None
    to_s: float | None = None
    steady: bool = True


def find_speed_changes(rec: Recording) -> Iterator[SignalProblem]:
    """Return a problem when phi turns at ``speed_rpm`` in one part of a recording only; see `speed_change`."""
    change = speed_change(rec)
    if change is None:
        return
    text = (
        f"recording {rec.name!r}: the speed changes: phi turns at {change.low:.0f} to {change.high:.0f} rpm in "
        f"{change.share:.0%} of it, but speed_rpm = {rec.conditions['speed_rpm']:g}; "
    )
    if change.steady:
        parts = {"from_s": change.from_s, "to_s": change.to_s}
        keys = " and ".join(f"{key}: {value:.4g}" for key, value in parts.items() if value is not None)
        what = "a run-up before it" if change.to_s is None else "a change of speed beside it"
        text += f"{what}: cut to the part at this speed with {keys} (seconds after its present first sample)."
    else:
        text += "correct speed_rpm, or record at a constant speed."
    yield SignalProblem("", "", "speed", text)


def speed_change(rec: Recording) -> SpeedChange | None:
    """Return where phi does not turn at ``speed_rpm``; None where it does, or is steady at another speed.

    The speed is averaged over blocks of a turn or more. A block is off when it differs from ``speed_rpm`` by more than
    2 %. A steady other speed is a matter of the sample time, which has a check of its own.
    """
    claimed = rec.conditions.get("speed_rpm")
    increments = turning_increments(rec)
    if claimed is None or increments is None or any(find_encoder_faults(rec)):
        return None
    turn = 60 / abs(claimed) if claimed else 0.0
    size = max(25, math.ceil(max(BLOCK, turn) / rec.sample_time))
    count = len(increments) // size
    if count < 2:
        return None
    seconds = size * rec.sample_time
    speeds = 60 * np.abs(increments[: count * size].reshape(count, size).mean(axis=1)) / (2 * np.pi * rec.sample_time)
    off = np.abs(speeds - abs(claimed)) > SPEED_TOLERANCE * max(abs(claimed), 60 / seconds)
    if not off.any() or (off.all() and np.ptp(speeds) <= SPEED_TOLERANCE * speeds.max()):
        return None
    change = SpeedChange(float(off.mean()), float(speeds[off].min()), float(speeds[off].max()), steady=False)
    if off.all():
        return change
    edges = np.flatnonzero(np.diff(~off, prepend=False, append=False))
    first, last = max(zip(edges[::2], edges[1::2], strict=True), key=lambda run: run[1] - run[0])
    spare = max(seconds, MARGIN * seconds * max(first, count - last))
    from_s = float(first * seconds + spare) if first else None
    to_s = float(last * seconds - spare) if last < count else None
    steady = (to_s or rec.duration) > (from_s or 0.0)
    return replace(change, from_s=from_s, to_s=to_s, steady=steady)
