"""Vibration of the floor, which moves the frame of the machine."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from gbid.core.arrays import FloatArray
from gbid.core.errors import UsageError
from gbid.rig.machine import RigEffect, RigRun, need_finite


@dataclass(frozen=True)
class FloorVibration(RigEffect):
    """Sinusoidal acceleration of the frame in one direction, as a motor nearby makes it; its phase is random.

    The motion of the disc is measured relative to the frame. So an acceleration of the frame acts like the opposite
    force per moving mass.

    Parameters
    ----------
    frequency_hz : float
        Frequency [Hz].
    acceleration : float
        Amplitude of the acceleration [m/s^2].
    direction_deg : float
        Direction from x towards y [degrees].

    Raises
    ------
    UsageError
        When a value is not finite, or when frequency or acceleration is negative.
    """

    frequency_hz: float = 25.0
    acceleration: float = 0.05
    direction_deg: float = 90.0
    name: str = field(default="floor_vibration", init=False)

    def __post_init__(self) -> None:
        need_finite(self.name, self, ("frequency_hz",), ("acceleration",))
        if not np.isfinite(self.direction_deg):
            raise UsageError(f"{self.name}: direction_deg = {self.direction_deg}; give a finite number")

    def force(self, run: RigRun) -> FloatArray:
        """Return the force at the samples."""
        turn, first = np.radians(self.direction_deg), run.random.uniform(0.0, 2 * np.pi)
        sine = self.acceleration * np.sin(2 * np.pi * self.frequency_hz * run.time + first)
        return -np.outer(sine, [np.cos(turn), np.sin(turn)])
