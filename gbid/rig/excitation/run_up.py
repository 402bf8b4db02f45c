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

    The parameters of rotor and bearing do not follow the speed: they stay those of the machine.

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
        slope = (self.to_rpm - self.from_rpm) * RPM / self.duration_s
        return Turning(self.from_rpm * RPM, slope)


@dataclass(frozen=True)
class Turning:
    """Rotation of the shaft: angle, speed and acceleration over time.

    The speed is constant before the first sample.

    Parameters
    ----------
    speed : float
        Speed at the first sample [rad/s].
    acceleration : float
        Angular acceleration after the first sample [rad/s^2].
    start : float
        Angle at the first sample [rad].
    """

    speed: float
    acceleration: float = 0.0
    start: float = 0.0

    def angle(self, time: FloatArray) -> FloatArray:
        """Return the shaft angle at times from the first sample [rad], not wrapped, shape of `time`."""
        return self.start + self.speed * time + 0.5 * self.acceleration * np.maximum(time, 0.0) ** 2

    def speed_at(self, time: FloatArray) -> FloatArray:
        """Return the speed at times from the first sample [rad/s], shape of `time`."""
        return self.speed + self.acceleration * np.maximum(time, 0.0)

    def acceleration_at(self, time: FloatArray) -> FloatArray:
        """Return the angular acceleration at times from the first sample [rad/s^2], shape of `time`."""
        return np.where(time > 0, self.acceleration, 0.0)
