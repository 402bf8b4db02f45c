"""Objective and limits of a design."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from gbid.arrays import FloatArray
from gbid.control.tuning.search.loop_family import LoopFamily
from gbid.errors import UsageError

Objective = Literal["damping", "decay"]


@dataclass(frozen=True)
class ExtraLimit:
    """Additional limit ``function(family, gains) <= limit`` in every loop, with derivatives by differences.

    Parameters
    ----------
    name : str
        Name of the limit.
    function : callable
        From a family of m loops and gains (d,) to positive numbers (m,).
    limit : float
        Largest allowed number.
    """

    name: str
    function: Callable[[LoopFamily, FloatArray], FloatArray]
    limit: float

    def excess(self, family: LoopFamily, gains: FloatArray) -> FloatArray:
        """Return the logarithm of the numbers over the limit (m,), positive when it is exceeded."""
        return np.asarray(np.log(self.function(family, gains) / self.limit))


@dataclass(frozen=True)
class Limits:
    """Objective and limits of a design; None means no limit.

    Parameters
    ----------
    objective : {"damping", "decay"}
        Smallest damping factor of the oscillatory modes, or slowest decay ``-Re`` [1/s] of all modes.
    slowest_pole : float
        Smallest allowed decay rate of every eigenvalue [1/s]; 0 (strictly) requires stability only.
    peak_sensitivity, peak_control, static_amplification : float, optional
        Limits on the peaks of S_o and K S_o, and on the gain of S_o at zero frequency.
    extra : tuple of ExtraLimit
        Additional limits.
    """

    objective: Objective = "damping"
    slowest_pole: float = 0.0
    peak_sensitivity: float | None = None
    peak_control: float | None = None
    static_amplification: float | None = None
    extra: tuple[ExtraLimit, ...] = ()

    def __post_init__(self) -> None:
        if self.objective not in ("damping", "decay"):
            raise UsageError(f"objective = {self.objective!r}; choose 'damping' or 'decay'")
        if not (np.isfinite(self.slowest_pole) and self.slowest_pole >= 0):
            raise UsageError(f"slowest_pole = {self.slowest_pole}; give a rate of at least 0 in 1/s")
        for name in ("peak_sensitivity", "peak_control", "static_amplification"):
            value = getattr(self, name)
            if value is not None and not (np.isfinite(value) and value > 0):
                raise UsageError(f"{name} = {value}; give a positive number or None")

    @property
    def has_responses(self) -> bool:
        """Whether a frequency response is limited."""
        return not self.peak_sensitivity is self.peak_control is self.static_amplification is None
