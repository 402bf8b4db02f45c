"""Check of the speed over a recording: a run-up, a coast-down, a speed that changes."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from gbid.arrays import BoolArray
from gbid.recording.quality_problem import SignalProblem
from gbid.recording.quality_time import SPEED_TOLERANCE, find_encoder_faults, turning_increments
from gbid.recording.recording import Recording

BLOCK = 0.05
"""Shortest block over which a speed is averaged [s]; it is at least a turn long."""


def find_speed_changes(rec: Recording) -> Iterator[SignalProblem]:
    """Return a stretch in which phi does not turn at ``speed_rpm``, while it does so in another.

    The speed is averaged over blocks of a turn or more. A block is off when it differs from ``speed_rpm`` by more than
    2 %. The text says which part of the recording has the stated speed.
    """
    claimed = rec.conditions.get("speed_rpm")
    increments = turning_increments(rec)
    if claimed is None or increments is None or any(find_encoder_faults(rec)):
        return
    turn = 60 / abs(claimed) if claimed else 0.0
    size = max(25, math.ceil(max(BLOCK, turn) / rec.sample_time))
    count = len(increments) // size
    if count < 2:
        return
    speeds = 60 * np.abs(increments[: count * size].reshape(count, size).mean(axis=1)) / (2 * np.pi * rec.sample_time)
    off = np.abs(speeds - abs(claimed)) > max(SPEED_TOLERANCE * abs(claimed), 60 / (size * rec.sample_time) * 0.02)
    if not off.any() or (off.all() and np.ptp(speeds) <= SPEED_TOLERANCE * speeds.max()):
        return  # as stated, or steady at another speed: that is a matter of the sample time
    seconds = size * rec.sample_time
    low, high = speeds[off].min(), speeds[off].max()
    text = (
        f"recording {rec.name!r}: the speed changes: phi turns at {low:.0f} to {high:.0f} rpm in {off.mean():.0%} of "
        f"it, but speed_rpm = {claimed:g}; {_remedy(off, seconds, rec.duration)}"
    )
    yield SignalProblem("", "", "speed", text)


def _remedy(off: BoolArray, seconds: float, duration: float) -> str:
    """Return what to do: the longest part at the stated speed, in seconds."""
    if off.all():
        return "correct speed_rpm, or record at a constant speed."
    edges = np.flatnonzero(np.diff(~off, prepend=False, append=False))
    first, last = max(zip(edges[::2], edges[1::2], strict=True), key=lambda run: run[1] - run[0])
    # A block at an end of the part may still have changed a little: it is left out.
    from_s = (first + 1) * seconds if first else 0.0
    to_s = (last - 1) * seconds if last < len(off) else duration
    keys = [f"from_s: {from_s:.3g}"] if first else []
    keys += [f"to_s: {to_s:.3g}"] if last < len(off) else []
    what = "a run-up before it" if first and last == len(off) else "a change of speed beside it"
    return f"{what}: cut to the part at this speed with {' and '.join(keys)} (seconds after its present first sample)."
