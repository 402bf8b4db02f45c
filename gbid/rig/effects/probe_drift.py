"""Drift of the probes while they warm up."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from gbid.core.arrays import FloatArray
from gbid.core.errors import UsageError
from gbid.rig.machine import RigEffect, RigRun


@dataclass(frozen=True)
class ProbeDrift(RigEffect):
    """Readings of the probes that change linearly with time, from zero at the start of the logger.

    Parameters
    ----------
    x_m_per_s, y_m_per_s : float
        Rates of the two probes [m/s].
    """

    x_m_per_s: float = 0.1e-6
    y_m_per_s: float = 0.05e-6
    name: str = field(default="probe_drift", init=False)

    def __post_init__(self) -> None:
        if not np.isfinite([self.x_m_per_s, self.y_m_per_s]).all():
            raise UsageError(f"{self.name}: rates {self.x_m_per_s}, {self.y_m_per_s} m/s; give finite numbers")

    def reading(self, run: RigRun) -> FloatArray:
        """Return the drift at the samples."""
        return np.outer(run.time, [self.x_m_per_s, self.y_m_per_s])
