"""Objective and limits of a design."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from gbid.arrays import is_finite
from gbid.control.tuning.search.measure import Measure
from gbid.errors import UsageError

Objective = Literal["damping", "decay"]


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
    extra : tuple of Measure
        Additional limits: the excess of each must be at most 0.
    soft : tuple of Measure
        Additional objectives. The search maximises the smallest of the objective and of minus their excesses.
    weight : float
        Factor on the objective of the eigenvalues beside the additional objectives; 0 leaves it out.
    """

    objective: Objective = "damping"
    slowest_pole: float = 0.0
    peak_sensitivity: float | None = None
    peak_control: float | None = None
    static_amplification: float | None = None
    extra: tuple[Measure, ...] = ()
    soft: tuple[Measure, ...] = ()
    weight: float = 1.0

    def __post_init__(self) -> None:
        if self.objective not in ("damping", "decay"):
            raise UsageError(f"objective = {self.objective!r}; choose 'damping' or 'decay'")
        if not (is_finite(self.slowest_pole) and self.slowest_pole >= 0):
            raise UsageError(f"slowest_pole = {self.slowest_pole!r}; give a rate of at least 0 in 1/s")
        for name in ("peak_sensitivity", "peak_control", "static_amplification"):
            value = getattr(self, name)
            if value is not None and not (is_finite(value) and value > 0):
                raise UsageError(f"{name} = {value!r}; give a positive number or None")

    @property
    def measures(self) -> tuple[Measure, ...]:
        """Additional limits and objectives."""
        return (*self.extra, *self.soft)

    @property
    def has_responses(self) -> bool:
        """Whether a frequency response is limited."""
        return not self.peak_sensitivity is self.peak_control is self.static_amplification is None
