"""Hum of the mains in the probes."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from gbid.core.arrays import FloatArray
from gbid.rig.machine import RigEffect, RigRun, need_finite


@dataclass(frozen=True)
class MainsHum(RigEffect):
    """Sine in the readings of both probes, as a ground loop makes it; its phase differs from recording to recording.

    Parameters
    ----------
    frequency_hz : float
        Frequency of the mains [Hz].
    amplitude_m : float
        Amplitude [m].
    """

    frequency_hz: float = 50.0
    amplitude_m: float = 0.2e-6
    name: str = field(default="mains_hum", init=False)

    def __post_init__(self) -> None:
        need_finite(self.name, self, ("frequency_hz",), ("amplitude_m",))

    def reading(self, run: RigRun) -> FloatArray:
        """Return the same sine for x and y."""
        sine = np.sin(2 * np.pi * self.frequency_hz * run.time + run.random.uniform(0.0, 2 * np.pi))
        return np.asarray(self.amplitude_m * np.column_stack([sine, sine]))
