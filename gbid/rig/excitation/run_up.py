"""Turning of the shaft: at constant speed, or running up."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gbid.arrays import FloatArray
from gbid.rig.machine.effects import need_finite

RPM = np.pi / 30


@dataclass(frozen=True)
class RunUp:
    """Speed that rises (or falls) evenly from one value to another, references at zero.

    The parameters of rotor and bearing stay those of the machine: they do not follow the speed.

    Parameters
    ----------
    from_rpm, to_rpm : float
        Speeds at the first sample and at the end [rpm].
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
        """Give the references r, all zero, shape (n_samples, 2) [m]."""
        del sample_time, random, n_settle
        return np.zeros((n_samples, 2))

    def turning(self) -> Turning:
        """Return how the shaft turns."""
        slope = (self.to_rpm - self.from_rpm) * RPM / self.duration_s
        return Turning(self.from_rpm * RPM, slope)


@dataclass(frozen=True)
class Turning:
    """Angle, speed and acceleration of the shaft over time from the first sample; constant speed before it.

    Parameters
    ----------
    speed : float
        At the first sample [rad/s].
    acceleration : float
        From there on [rad/s^2].
    start : float
        Angle at the first sample [rad].
    """

    speed: float
    acceleration: float = 0.0
    start: float = 0.0

    def angle(self, time: FloatArray) -> FloatArray:
        """Shaft angle [rad], not wrapped, shape of `time`."""
        return self.start + self.speed * time + 0.5 * self.acceleration * np.maximum(time, 0.0) ** 2

    def speed_at(self, time: FloatArray) -> FloatArray:
        """Speed [rad/s], shape of `time`."""
        return self.speed + self.acceleration * np.maximum(time, 0.0)

    def acceleration_at(self, time: FloatArray) -> FloatArray:
        """Angular acceleration [rad/s^2], shape of `time`."""
        return np.where(time > 0, self.acceleration, 0.0)
