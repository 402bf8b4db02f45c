"""Goals on responses over frequency: sensitivities, control effort, roll-off, and the disk margin."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from gbid.arrays import FloatArray, is_finite
from gbid.control.tuning.goals.bound import Bound, BoundLike, bound_over_frequency
from gbid.control.tuning.goals.goal import DesignContext, Wanted, positive
from gbid.control.tuning.goals.response_measure import LoopResponse, ResponseMeasure
from gbid.control.tuning.search.limits import Limits
from gbid.errors import UsageError


@dataclass(frozen=True)
class ResponseGoal(Wanted):
    """Base of the goals on the largest singular value of a response over frequency.

    Parameters
    ----------
    limit : float, sequence of (frequency_hz, limit), or LinearModel
        One limit for all frequencies, breakpoints between which the limit is straight in logarithmic axes, or a model
        whose gain is the limit.
    soft, weight
        See `gbid.control.Wanted`.
    """

    limit: BoundLike
    response: ClassVar[LoopResponse]
    label: ClassVar[str]
    native: ClassVar[str] = ""
    """Name of the limit that the search knows without a measure."""

    def __post_init__(self) -> None:
        super().__post_init__()
        bound_over_frequency(self.limit, f"{type(self).__name__}: limit")

    def measure(self, context: DesignContext) -> ResponseMeasure:
        """Return the measure of this goal."""
        bound = bound_over_frequency(self.limit, type(self).__name__)
        return ResponseMeasure(f"{self.label} over frequency", self.response, bound, weight=self.weight)

    def add_to(self, limits: Limits, context: DesignContext) -> Limits:
        """Return the limits with this goal; one hard limit for all frequencies is verified by an exact norm."""
        if self.soft or not self.native or not is_finite(self.limit):
            return super().add_to(limits, context)
        known = getattr(limits, self.native)
        changed: dict[str, Any] = {self.native: float(self.limit if known is None else min(known, self.limit))}
        return replace(limits, **changed)


@dataclass(frozen=True)
class PeakSensitivity(ResponseGoal):
    """Largest singular value of the output sensitivity S_o.

    Parameters
    ----------
    limit, soft, weight
        See `ResponseGoal`.
    """

    response = LoopResponse.SENSITIVITY
    label = "S_o"
    native = "peak_sensitivity"


@dataclass(frozen=True)
class PeakControl(ResponseGoal):
    """Largest singular value of the control effort K S_o [m/m].

    Parameters
    ----------
    limit, soft, weight
        See `ResponseGoal`.
    """

    response = LoopResponse.CONTROL
    label = "K S_o"
    native = "peak_control"


@dataclass(frozen=True)
class PeakComplementary(ResponseGoal):
    """Largest singular value of the complementary sensitivity T_o = I - S_o.

    Parameters
    ----------
    limit, soft, weight
        See `ResponseGoal`.
    """

    response = LoopResponse.COMPLEMENTARY
    label = "T_o"


@dataclass(frozen=True)
class RollOff(Wanted):
    """Control effort K S_o that falls above a frequency, over three decades or up to half the sample rate.

    Parameters
    ----------
    from_hz : float
        Frequency from which the limit holds [Hz].
    level : float
        Largest singular value of K S_o there [m/m].
    slope_db : float
        Fall of the limit above it [dB per decade].
    soft, weight
        See `Wanted`.
    """

    from_hz: float
    level: float
    slope_db: float = 20.0

    def __post_init__(self) -> None:
        super().__post_init__()
        positive(self, from_hz=self.from_hz, level=self.level)
        if not (is_finite(self.slope_db) and 0 <= self.slope_db <= 200):
            raise UsageError(f"RollOff: slope_db = {self.slope_db!r}; give 0 to 200 dB per decade")

    def measure(self, context: DesignContext) -> ResponseMeasure:
        """Return the measure of this goal."""
        places = self.from_hz * (1 + 1e-9) * np.geomspace(1.0, 1e3, 25)
        bound = Bound(self._bound, places)
        return ResponseMeasure("roll-off of K S_o", LoopResponse.CONTROL, bound, weight=self.weight)

    def _bound(self, hz: FloatArray) -> FloatArray:
        over = np.maximum(hz, self.from_hz) / self.from_hz
        return np.where(hz >= self.from_hz, self.level * over ** (-self.slope_db / 20), 1e300)


@dataclass(frozen=True)
class StaticAmplification(Wanted):
    """Largest singular value of S_o at zero frequency: the amplification of a steady disturbance of p.

    Parameters
    ----------
    limit : float
        Largest allowed gain.
    soft, weight
        See `Wanted`.
    """

    limit: float

    def __post_init__(self) -> None:
        super().__post_init__()
        positive(self, limit=self.limit)

    def measure(self, context: DesignContext) -> ResponseMeasure:
        """Return the measure of this goal."""

        def at_rest(hz: FloatArray) -> FloatArray:
            return np.where(hz == 0, self.limit, 1e300)

        return ResponseMeasure(
            "static amplification", LoopResponse.SENSITIVITY, Bound(at_rest, np.zeros(0)), weight=self.weight
        )

    def add_to(self, limits: Limits, context: DesignContext) -> Limits:
        """Return the limits with this goal."""
        if self.soft:
            return super().add_to(limits, context)
        known = limits.static_amplification
        return replace(limits, static_amplification=self.limit if known is None else min(known, self.limit))


@dataclass(frozen=True)
class MinDiskMargin(Wanted):
    r"""Smallest disk margin alpha, of all loops together or of each loop alone.

    A loop with alpha tolerates gains times ``(2 - alpha)/(2 + alpha)`` to the inverse of it, and phases of
    ``2 arctan(alpha / 2)``; see `gbid.control.disk_margin`.

    Parameters
    ----------
    alpha : float
        Smallest allowed size of the disk.
    channel : int, optional
        Loop that is changed alone; all together by default.
    soft, weight
        See `Wanted`.
    """

    alpha: float
    channel: int | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (is_finite(self.alpha) and 0 < self.alpha < 2):
            raise UsageError(f"MinDiskMargin: alpha = {self.alpha!r}; give a number between 0 and 2")

    def measure(self, context: DesignContext) -> ResponseMeasure:
        """Return the measure of this goal."""
        n = len(context.plant.C)
        if self.channel is not None and self.channel not in range(n):
            raise UsageError(f"MinDiskMargin: channel = {self.channel!r}; there are {n}, from 0")
        name = "disk margin" if self.channel is None else f"disk margin of {context.plant.output_names[self.channel]}"
        bound = bound_over_frequency(2 / self.alpha, "MinDiskMargin")
        return ResponseMeasure(name, LoopResponse.BALANCED, bound, True, self.channel, self.weight)
