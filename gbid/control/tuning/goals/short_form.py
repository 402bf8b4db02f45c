"""Goals from the arguments of `gbid.tune` by name: its short form."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields

from gbid.control.impact.half_sine import HalfSine
from gbid.control.tuning.goals.goal import Goal
from gbid.control.tuning.goals.mode_goals import MaxDamping, MaxDecay, SlowestPole
from gbid.control.tuning.goals.response_goals import PeakControl, PeakSensitivity, StaticAmplification
from gbid.control.tuning.goals.travel_goal import PiezoTravel
from gbid.control.tuning.search.limits import Limits, Objective
from gbid.errors import UsageError


@dataclass(frozen=True)
class ShortForm:
    """Goals by name, as `gbid.tune` takes them; its arguments of the same names say what they mean."""

    objective: Objective = "damping"
    peak_sensitivity: float | None = 2.6
    peak_control: float | None = None
    static_amplification: float | None = None
    slowest_pole: float | None = None
    impact: HalfSine | None = None
    piezo_travel_m: float = 45e-6

    def goals(self, given: Sequence[Goal] | None, slowest_mode: float) -> list[Goal]:
        """Return the goals of a design.

        Parameters
        ----------
        given : sequence of Goal, optional
            Goals as values, which exclude the short form.
        slowest_mode : float
            Slowest decay of the oscillatory modes of the open loop [1/s], the default of `slowest_pole`.

        Raises
        ------
        UsageError
            When both forms are used, or when a number is not allowed.
        """
        if given is not None:
            if not isinstance(given, Iterable):
                raise UsageError(f"goals = {given!r}; give a list such as [MaxDamping(), PeakSensitivity(2.0)]")
            used = [f.name for f in fields(self) if getattr(self, f.name) != f.default]
            if used:
                raise UsageError(f"tune: {', '.join(used)} beside goals; write them as goals, too")
            return list(given)
        slowest = self.slowest_pole
        if slowest is None:
            slowest = 0.0 if self.peak_sensitivity is None else max(slowest_mode, 0.0)
        # raises errors that name the arguments
        Limits(self.objective, slowest, self.peak_sensitivity, self.peak_control, self.static_amplification)
        goals: list[Goal] = [MaxDamping() if self.objective == "damping" else MaxDecay(), SlowestPole(rate=slowest)]
        for kind, limit in (
            (PeakSensitivity, self.peak_sensitivity),
            (PeakControl, self.peak_control),
        ):
            if limit is not None:
                goals.append(kind(limit))
        if self.static_amplification is not None:
            goals.append(StaticAmplification(limit=self.static_amplification))
        if self.impact is not None:
            goals.append(PiezoTravel(impact=self.impact, travel_m=self.piezo_travel_m))
        return goals
