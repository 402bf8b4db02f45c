"""Goal on the travel of the piezo stacks after an impact."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from gbid.control.impact.half_sine import HalfSine
from gbid.control.tuning.goals.goal import DesignContext, Wanted, positive
from gbid.control.tuning.search.measure import ExtraLimit
from gbid.control.tuning.travel import travel_limit
from gbid.errors import UsageError


@dataclass(frozen=True)
class PiezoTravel(Wanted):
    """Motion of every stack after an impact in x and in y: at most half its travel to each side.

    Parameters
    ----------
    impact : HalfSine
        The impact.
    travel_m : float
        Whole travel of a stack [m].
    soft, weight
        See `Wanted`.
    """

    impact: HalfSine = field(default_factory=HalfSine)
    travel_m: float = 45e-6

    def __post_init__(self) -> None:
        super().__post_init__()
        positive(self, travel_m=self.travel_m)
        if not isinstance(self.impact, HalfSine):
            raise UsageError(f"PiezoTravel: impact = {self.impact!r}; give a HalfSine")

    def measure(self, context: DesignContext) -> ExtraLimit:
        """Return the measure of this goal."""
        found = travel_limit(context.plant, self.impact, self.travel_m)
        return replace(found, limit=found.limit / self.weight)
