"""Goals on the modes of the loop: damping and decay, of all modes or of those in a band of frequencies."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import inf

import numpy as np

from gbid.arrays import BoolArray, FloatArray, is_finite
from gbid.control.tuning.goals.goal import DesignContext, Goal, Wanted, band, positive
from gbid.control.tuning.search.limits import Limits
from gbid.control.tuning.search.measure import LoopState, Measure, Pieces
from gbid.control.tuning.search.plane import rate_slopes, true_rates
from gbid.control.tuning.search.spectrum import damping_factors, damping_slopes
from gbid.errors import UsageError
from gbid.poles import REAL


@dataclass(frozen=True)
class ModeMeasure(Measure):
    """Excess ``limit - value / weight`` of the modes in a band: damping factors, or decay in units of the limit.

    Parameters
    ----------
    name : str
        Name of the limit.
    limit : float
        Smallest damping factor, or smallest decay rate [1/s].
    decay : bool
        Whether the decay is limited, in units of the limit (of 1 1/s when it is 0).
    low_hz, high_hz : float
        Natural frequencies of the modes that count [Hz].
    weight : float
        Weight.
    """

    name: str
    limit: float
    decay: bool = False
    low_hz: float = 0.0
    high_hz: float = inf
    weight: float = 1.0

    def excess(self, state: LoopState) -> FloatArray:
        """Return the excess of the worst mode of each loop; minus infinity without a mode in the band."""
        return np.asarray(np.where(self._counts(state), self._values(state), -np.inf).max(axis=1))

    def pieces(self, state: LoopState, window: float) -> Pieces:
        """Return the modes near the limit."""
        T = state.family.sample_time
        every = self._values(state)
        upper = state.system.values.imag >= -REAL * np.abs(state.system.values)
        loop, which = np.nonzero(self._counts(state) & upper & (every > -window))
        values = state.system.values[loop, which]
        slopes = state.system.slopes(loop, which, state.derivatives.dA) * rate_slopes(values, T)[:, None]
        rates = true_rates(values, T)
        gradient = -slopes.real / self._unit if self.decay else damping_slopes(rates, slopes, T)
        return Pieces(loop, every[loop, which], -gradient / self.weight, values)

    @property
    def _unit(self) -> float:
        return self.limit if self.limit > 0 else 1.0

    def _values(self, state: LoopState) -> FloatArray:
        T = state.family.sample_time
        rates = true_rates(state.system.values, T)
        value = -rates.real / self._unit if self.decay else damping_factors(rates, T)
        limit = self.limit / self._unit if self.decay else self.limit
        return np.asarray(limit - value / self.weight)

    def _counts(self, state: LoopState) -> BoolArray:
        size = np.abs(true_rates(state.system.values, state.family.sample_time)) / (2 * np.pi)
        return np.asarray((size >= self.low_hz) & (size <= self.high_hz))


@dataclass(frozen=True)
class MaxDamping(Goal):
    """Objective: the largest smallest damping factor of the oscillatory modes.

    Parameters
    ----------
    weight : float
        Weight beside soft goals: the objective is the damping factor over it.
    low_hz, high_hz : float
        Natural frequencies of the modes that count [Hz]; all modes by default.
    """

    weight: float = 1.0
    low_hz: float = 0.0
    high_hz: float = inf

    def __post_init__(self) -> None:
        positive(self, weight=self.weight)
        band(self, self.low_hz, self.high_hz)

    def add_to(self, limits: Limits, context: DesignContext) -> Limits:
        """Return the limits with this objective."""
        if (self.low_hz, self.high_hz) == (0.0, inf):
            _only_one(limits)
            return replace(limits, objective="damping", weight=1 / self.weight)
        found = ModeMeasure("damping in the band", 0.0, False, self.low_hz, self.high_hz, self.weight)
        return replace(limits, soft=(*limits.soft, found))


@dataclass(frozen=True)
class MaxDecay(Goal):
    """Objective: the fastest slowest decay ``-Re`` of all poles [1/s].

    Parameters
    ----------
    weight : float
        Weight beside soft goals: the objective is the decay in units of a typical rate of the loops, over the weight.
    """

    weight: float = 1.0

    def __post_init__(self) -> None:
        positive(self, weight=self.weight)

    def add_to(self, limits: Limits, context: DesignContext) -> Limits:
        """Return the limits with this objective."""
        _only_one(limits)
        return replace(limits, objective="decay", weight=1 / self.weight)


@dataclass(frozen=True)
class MinDamping(Wanted):
    """Smallest damping factor of the modes in a band; its excess is ``limit - damping / weight``.

    Parameters
    ----------
    limit : float
        Smallest allowed damping factor.
    low_hz, high_hz : float
        Natural frequencies of the modes that count [Hz].
    soft, weight
        See `Wanted`.
    """

    limit: float
    low_hz: float = 0.0
    high_hz: float = inf

    def __post_init__(self) -> None:
        super().__post_init__()
        band(self, self.low_hz, self.high_hz)
        if not (is_finite(self.limit) and -1 < self.limit < 1):
            raise UsageError(f"MinDamping: limit = {self.limit!r}; give a damping factor below 1")

    def measure(self, context: DesignContext) -> ModeMeasure:
        """Return the measure of this goal."""
        return ModeMeasure("damping of modes", self.limit, False, self.low_hz, self.high_hz, self.weight)


@dataclass(frozen=True)
class SlowestPole(Wanted):
    """Smallest decay rate ``-Re`` of the poles, real ones included, or of those in a band.

    Parameters
    ----------
    rate : float
        Smallest allowed decay rate [1/s]: the largest real part is ``-rate``.
    low_hz, high_hz : float
        Magnitudes of the poles that count, over 2 pi [Hz].
    soft, weight
        See `Wanted`.
    """

    rate: float
    low_hz: float = 0.0
    high_hz: float = inf

    def __post_init__(self) -> None:
        super().__post_init__()
        band(self, self.low_hz, self.high_hz)
        if not (is_finite(self.rate) and self.rate >= 0):
            raise UsageError(f"SlowestPole: rate = {self.rate!r}; give a rate of at least 0 in 1/s")

    def measure(self, context: DesignContext) -> ModeMeasure:
        """Return the measure of this goal."""
        return ModeMeasure("slowest pole in the band", self.rate, True, self.low_hz, self.high_hz, self.weight)

    def add_to(self, limits: Limits, context: DesignContext) -> Limits:
        """Return the limits with this goal."""
        if self.soft or (self.low_hz, self.high_hz) != (0.0, inf):
            return super().add_to(limits, context)
        return replace(limits, slowest_pole=max(limits.slowest_pole, self.rate))


def _only_one(limits: Limits) -> None:
    if limits.weight < inf:
        raise UsageError("goals: MaxDamping and MaxDecay of all modes exclude each other and come once")
