"""Goals of a design from the entries of its controller section."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import scipy

from gbid.control import DisturbanceSpectrum, Goal, HalfSine, PeakSensitivity, PiezoTravel
from gbid.errors import UsageError
from gbid.experiment.experiment import Experiment
from gbid.experiment.plan import PlannedRecording
from gbid.experiment.stages.tune.goal_entries import GOALS, GoalSection, HitSection
from gbid.experiment.stages.tune.schema import ControllerSection
from gbid.structure import LinearModel

Disturbance = Callable[[tuple[str, ...]], DisturbanceSpectrum]
"""From names of recordings to the disturbance that they show."""


def made_goal(entry: GoalSection, disturbance: Disturbance) -> Goal:
    """Return the goal of an entry.

    Parameters
    ----------
    entry : GoalSection
        Name and arguments.
    disturbance : callable
        Returns the disturbance of the recordings that an entry names.

    Raises
    ------
    UsageError
        When an argument is not allowed.
    """
    arguments: dict[str, Any] = {}
    for name, value in entry.given().items():
        if isinstance(value, HitSection):
            value = HalfSine(value.peak_n, value.duration_s)
        elif name == "disturbance":
            value = disturbance(value)
        elif isinstance(value, Mapping):
            value = _transfer_function(value, f"{entry.goal}: {name}")
        arguments[name] = value
    return GOALS[entry.goal](**arguments)


def goal_recordings(experiment: Experiment, section: ControllerSection) -> list[PlannedRecording]:
    """Return the recordings whose disturbance the goals of a design need."""
    named = (entry.given().get("disturbance", ()) for entry in section.goals or ())
    return experiment.matching(tuple(pattern for patterns in named for pattern in patterns))


def peak_cap(section: ControllerSection) -> float | None:
    """Return the cap on the peak of S_o at all frequencies; None when a design has none."""
    if section.goals is None:
        return section.peak_sensitivity
    limits = [entry.given()["limit"] for entry in section.goals if _caps_peak(entry)]
    return min(map(float, limits), default=None)


def impact_of_goals(section: ControllerSection) -> PiezoTravel | None:
    """Return the first goal on the travel of the stacks; None when there is none."""
    for entry in section.goals or ():
        if entry.goal == PiezoTravel.__name__:
            goal = made_goal(entry, no_disturbance)
            assert isinstance(goal, PiezoTravel)
            return goal
    return None


def without_cap(section: ControllerSection, goals: Sequence[Goal]) -> list[Goal]:
    """Return the goals of a design without its caps on the peak of S_o, in whose place others come."""
    return [goal for goal, entry in zip(goals, section.goals or (), strict=True) if not _caps_peak(entry)]


def no_disturbance(_names: tuple[str, ...]) -> DisturbanceSpectrum:
    """Return a disturbance in place of that of recordings that do not exist yet, for checks."""
    return DisturbanceSpectrum(np.array([1.0, 2.0]), np.tile(1e-18 * np.eye(2, dtype=complex), (2, 1, 1)))


def _caps_peak(entry: GoalSection) -> bool:
    given = entry.given()
    return entry.goal == PeakSensitivity.__name__ and not given.get("soft") and isinstance(given["limit"], int | float)


def _transfer_function(given: Mapping[str, Sequence[float]], what: str) -> LinearModel:
    """Return a transfer function as a model.

    Raises
    ------
    UsageError
        When its denominator is zero, or when the numerator has a higher order.
    """
    numerator, denominator = (np.trim_zeros(np.asarray(given[key], float), "f") for key in ("numerator", "denominator"))
    if not len(denominator) or not len(numerator) or len(numerator) > len(denominator):
        raise UsageError(f"{what}: the numerator must not be zero or of a higher order than the denominator")
    A, B, C, D = scipy.signal.tf2ss(numerator, denominator)
    return LinearModel(A, B, C, D, name=what)
