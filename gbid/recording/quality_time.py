"""Checks of the sample time and of the shaft encoder."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import scipy

from gbid.arrays import FloatArray
from gbid.recording.quality_problem import SignalProblem
from gbid.recording.recording import Recording

SPEED_TOLERANCE = 0.02
"""Largest relative difference between the speed of the encoder and the stated speed."""
SLIP = np.deg2rad(2.0)
"""Smallest jump of the angle that is reported [rad]."""
SLIP_SIGMAS = 10.0
"""Smallest jump that is reported, in robust standard deviations of the angle increments."""
_SMOOTH = 25  # samples of the running median that gives the present speed
_TURN = 2 * np.pi


def find_encoder_faults(rec: Recording) -> Iterator[SignalProblem]:
    """Return jumps and stops of the shaft angle phi: lost counts, a lost index, a blocked encoder.

    The increments of the angle from sample to sample, wrapped to half a turn, follow the speed. A single increment
    far from the median of its neighbours is a jump. A stretch without increments while the rest turns is a stop. At the
    begin or the end of a recording it is a shaft at rest (`gbid.recording.quality_speed`). The step from a full turn to
    zero is neither.
    """
    increments = turning_increments(rec)
    if increments is None:
        return
    speed = scipy.ndimage.median_filter(increments, size=_SMOOTH, mode="nearest")
    off = np.abs(increments - speed)
    sigma = 1.4826 * float(np.median(np.abs(off - np.median(off)))) + float(np.median(off))
    turning = np.median(np.abs(increments)) > 0
    stopped = _long_runs(increments == 0, 2 * _SMOOTH) if turning else np.zeros(0, int)
    if stopped.size:
        share = stopped.size / len(increments)
        text = (
            f"recording {rec.name!r}: signal 'phi' stops: it stays at one angle for {stopped.size} samples "
            f"({share:.1%}), the first at {stopped[0] * rec.sample_time:.4f} s, while the shaft turns; check the "
            "encoder, or cut that away."
        )
        yield SignalProblem("phi", "phi", "encoder", text)
    jumps = np.flatnonzero(off > max(SLIP, SLIP_SIGMAS * sigma))
    jumps = np.setdiff1d(jumps, np.concatenate([stopped, stopped + 1, stopped - 1]))
    if jumps.size and turning:
        size = np.rad2deg(increments[jumps[0]] - speed[jumps[0]])
        text = (
            f"recording {rec.name!r}: signal 'phi' jumps {jumps.size} times, the first by {size:+.1f} degrees at "
            f"{jumps[0] * rec.sample_time:.4f} s: the encoder lost counts or its index; check its cable and "
            "speed limit, or cut those samples away."
        )
        yield SignalProblem("phi", "phi", "encoder", text)


def find_clock_problems(rec: Recording) -> Iterator[SignalProblem]:
    """Return a wrong sample time: phi must turn at ``speed_rpm`` within 2 %.

    The data cannot show whether the sample time or the speed is wrong. The text gives the sample time that would fit.
    For a recording with changing speed see `gbid.recording.quality_speed`.
    """
    claimed = rec.conditions.get("speed_rpm")
    increments = turning_increments(rec)
    if not claimed or increments is None:
        return
    quarter = len(increments) // 4
    first, last = abs(increments[:quarter].mean()), abs(increments[-quarter:].mean())
    if abs(first - last) > SPEED_TOLERANCE * max(first, last):
        return
    measured = 60 * abs(float(increments.mean())) / _TURN / rec.sample_time
    if measured > 0 and abs(measured - abs(claimed)) > SPEED_TOLERANCE * abs(claimed):
        text = (
            f"recording {rec.name!r}: sample_time_s = {rec.sample_time:g} s cannot be right: phi turns at "
            f"{measured:.1f} rpm, but speed_rpm = {claimed:g}; a sample time of "
            f"{rec.sample_time * measured / abs(claimed):.4g} s would fit, or another speed."
        )
        yield SignalProblem("", "", "sample_time", text)


def turning_increments(rec: Recording) -> FloatArray | None:
    """Return the angle increments wrapped to half a turn; None without an angle or for a shaft at rest."""
    if "phi" not in rec.signals or rec.signal("phi").shape[1] != 1 or rec.n_samples < 4 * _SMOOTH:
        return None
    steps = np.diff(rec.signal("phi")[:, 0])
    if not steps.any():
        return None
    return np.asarray(np.mod(steps + np.pi, _TURN) - np.pi)


def _long_runs(at: FloatArray, least: int) -> FloatArray:
    """Return the indices of the true entries in runs of at least a given length that touch neither end."""
    edges = np.flatnonzero(np.diff(at, prepend=False, append=False))
    pairs = [(a, b) for a, b in zip(edges[::2], edges[1::2], strict=True) if b - a >= least]
    runs = [np.arange(a, b) for a, b in pairs if a > 0 and b < len(at)]
    return np.concatenate(runs) if runs else np.zeros(0, int)
