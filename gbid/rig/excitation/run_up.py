"""Rotation of the shaft: at constant speed, or during a run-up."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gbid.arrays import FloatArray
from gbid.rig.machine.rotor_effects import need_finite

RPM = np.pi / 30


@dataclass(frozen=True)
class RunUp:
    """Run-up: the speed changes at a constant rate, and the references are zero.

    The parameters of rotor and bearing do not follow the speed: they stay those of the machine. In a `ScheduledRun`
    they do.

    Parameters
    ----------
    from_rpm, to_rpm : float
        Speeds at the first sample and at the end [rpm]; the speed may rise or fall.
    duration_s : float
        Length of the recording [s].
    """

    from_rpm: float = 0.0
    to_rpm: float = 6000.0
    duration_s: float = 5.0

    def __post_init__(self) -> None:
        need_finite("run-up", self, ("duration_s",), ("from_rpm", "to_rpm"))

    def reference(
        self, n_samples: int, sample_time: float, random: np.random.Generator, n_settle: int = 0
    ) -> FloatArray:
        """Return the references r, all zero, shape (n_samples, 2) [m]."""
        del sample_time, random, n_settle
        return np.zeros((n_samples, 2))

    def turning(self) -> Turning:
        """Return the shaft angle, speed and acceleration over time."""
        return Turning((0.0, self.duration_s), (self.from_rpm * RPM, self.to_rpm * RPM))


@dataclass(frozen=True)
class Turning:
    """Rotation of the shaft: angle, speed and acceleration over time.

    The speed is linear between given times, the first of which is zero (the first sample), and constant before the
    first and after the last.

    Parameters
    ----------
    times : tuple of float
        Times from the first sample [s], ascending from 0.
    speeds : tuple of float
        Speeds at these times [rad/s].
    start : float
        Angle at the first sample [rad].
    """

    times: tuple[float, ...]
    speeds: tuple[float, ...]
    start: float = 0.0

    @property
    def speed(self) -> float:
        """Speed up to the first sample [rad/s]."""
        return self.speeds[0]

    @property
    def is_steady(self) -> bool:
        """Whether the speed is constant."""
        return len(self.times) == 1

    def angle(self, time: FloatArray) -> FloatArray:
        """Return the shaft angle at times from the first sample [rad], not wrapped, shape of `time`."""
        if self.is_steady:
            return np.asarray(self.start + self.speed * time)
        times, speeds = np.array(self.times), np.array(self.speeds)
        turned = np.concatenate([[0.0], np.cumsum(0.5 * (speeds[1:] + speeds[:-1]) * np.diff(times))])
        piece, slope = self._pieces(time)
        since = time - times[piece]
        return np.asarray(self.start + turned[piece] + speeds[piece] * since + 0.5 * slope * since**2)

    def speed_at(self, time: FloatArray) -> FloatArray:
        """Return the speed at times from the first sample [rad/s], shape of `time`."""
        return np.full(np.shape(time), self.speed) if self.is_steady else np.interp(time, self.times, self.speeds)

    def acceleration_at(self, time: FloatArray) -> FloatArray:
        """Return the angular acceleration at times from the first sample [rad/s^2], shape of `time`."""
        return np.zeros(np.shape(time)) if self.is_steady else self._pieces(time)[1]

    def _pieces(self, time: FloatArray) -> tuple[np.ndarray, FloatArray]:
        """Return the last given time before each time, as an index, and the acceleration there."""
        piece = np.maximum(np.searchsorted(self.times, time, side="left") - 1, 0)
        slopes = np.append(np.diff(self.speeds) / np.diff(self.times), 0.0)
        return piece, np.where(np.asarray(time) > self.times[0], slopes[piece], 0.0)
