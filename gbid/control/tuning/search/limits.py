"""What is asked of a design: the aim and the limits it must keep."""

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
    """A limit that no other covers: ``function(family, gains) <= limit`` in every loop, differentiable by differences.

    Parameters
    ----------
    name : str
    function : callable
        From a family of m loops and gains (d,) to positive numbers (m,).
    limit : float
    """

    name: str
    function: Callable[[LoopFamily, FloatArray], FloatArray]
    limit: float

    def excess(self, family: LoopFamily, gains: FloatArray) -> FloatArray:
        """Logarithm of the numbers over the limit (m,), positive where it is exceeded."""
        return np.asarray(np.log(self.function(family, gains) / self.limit))


@dataclass(frozen=True)
class Limits:
    """Aim and limits; a limit of None is none.

    Parameters
    ----------
    objective : {"damping", "decay"}
        Smallest damping factor of the oscillatory modes, or slowest decay ``-Re`` [1/s] of all modes.
    slowest_pole : float
        Every eigenvalue decays at least as fast [1/s]; at 0 (strictly) it is stability alone.
    peak_sensitivity, peak_control, static_amplification : float, optional
        Largest peaks of S_o and K S_o, largest gain of S_o at rest.
    extra : tuple of ExtraLimit
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
