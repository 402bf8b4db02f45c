"""Goal of a design: what it adds to the objective and the limits of a search."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import inf

from gbid.arrays import is_finite
from gbid.control.tuning.search.limits import Limits
from gbid.control.tuning.search.measure import Measure
from gbid.errors import UsageError
from gbid.structure import LinearModel


@dataclass(frozen=True, eq=False)
class DesignContext:
    """What goals need to know about the loops.

    Attributes
    ----------
    plant : LinearModel
        One of the plants in continuous time.
    """

    plant: LinearModel


class Goal(ABC):
    """Objective or limit of a design; see `gbid.tune`."""

    @abstractmethod
    def add_to(self, limits: Limits, context: DesignContext) -> Limits:
        """Return the limits with this goal.

        Parameters
        ----------
        limits : Limits
            Objective and limits so far.
        context : DesignContext
            What goals need to know about the loops.
        """


@dataclass(frozen=True, kw_only=True)
class Wanted(Goal):
    """Base of the goals that are a limit or, with ``soft=True``, an objective.

    Parameters
    ----------
    soft : bool
        Whether the goal is an objective. The search then makes its excess ``log(weight * value / limit)`` as small as
        it can. With several objectives it improves the worst one.
    weight : float
        Weight of an objective: with a larger one the search does more for it.
    """

    soft: bool = False
    weight: float = 1.0

    def __post_init__(self) -> None:
        if not (is_finite(self.weight) and self.weight > 0):
            raise UsageError(f"{type(self).__name__}: weight = {self.weight!r}; give a positive number")
        if self.weight != 1.0 and not self.soft:
            raise UsageError(f"{type(self).__name__}: weight belongs to an objective; give soft=True as well")

    @abstractmethod
    def measure(self, context: DesignContext) -> Measure:
        """Return the measure of this goal with its weight.

        Parameters
        ----------
        context : DesignContext
            What goals need to know about the loops.
        """

    def add_to(self, limits: Limits, context: DesignContext) -> Limits:
        """Return the limits with this goal among the objectives or the limits."""
        found = self.measure(context)
        return (
            replace(limits, soft=(*limits.soft, found)) if self.soft else replace(limits, extra=(*limits.extra, found))
        )


def positive(goal: Goal, **values: float) -> None:
    """Refuse values of a goal that are not positive numbers.

    Raises
    ------
    UsageError
        When one of them is not.
    """
    for name, value in values.items():
        if not (is_finite(value) and value > 0):
            raise UsageError(f"{type(goal).__name__}: {name} = {value!r}; give a positive number")


def band(goal: Goal, low_hz: float, high_hz: float) -> None:
    """Refuse a band of frequencies that is empty.

    Raises
    ------
    UsageError
        When it is.
    """
    numbers = is_finite(low_hz) and (is_finite(high_hz) or high_hz == inf)
    if not numbers or not 0 <= low_hz < high_hz:
        raise UsageError(f"{type(goal).__name__}: low_hz = {low_hz!r}, high_hz = {high_hz!r}; give 0 <= low < high")


def limits_of(goals: Sequence[Goal], context: DesignContext) -> Limits:
    """Return objective and limits of a list of goals.

    Raises
    ------
    UsageError
        When there is no goal, when one is not a `Goal`, or when none of them is an objective.
    """
    for goal in goals:
        if not isinstance(goal, Goal):
            raise UsageError(f"goals: {goal!r} is no goal; give a list such as [MaxDamping(), PeakSensitivity(2.0)]")
    limits = Limits(weight=inf)  # no objective yet
    for goal in goals:
        limits = goal.add_to(limits, context)
    if limits.weight == inf:
        if not limits.soft:
            raise UsageError("goals: none of them is an objective; add MaxDamping(), or make one soft=True")
        limits = replace(limits, weight=0.0)
    return limits
