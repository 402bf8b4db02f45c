"""Checks of the impacts section: rig, operating points inside the domain, and controller exist."""

from __future__ import annotations

from gbid.errors import GbidError
from gbid.experiment.experiment import Experiment
from gbid.experiment.problems import Found, Location
from gbid.experiment.stages.impact.plan import (
    LOOPS,
    controller_at,
    expecting_model,
    hammer_of,
    is_tuned,
    loop_controllers,
    tuned_design,
)
from gbid.experiment.stages.impact.schema import HammerTrain, ImpactPoint, ImpactsSection
from gbid.experiment.stages.rig.model import rig_model

LONGEST_IMPACT = 0.25
"""Longest impact as a fraction of the time between impacts; the ring-down needs the remaining time."""


def impacts_can_be_made(experiment: Experiment) -> Found:
    """Yield problems of the rig, the operating points, the timing of impacts, and the controllers."""
    section = experiment.spec.impacts
    if section is None:
        return
    if experiment.spec.rig is None:
        yield (
            ("impacts",),
            "needs the section rig; add one (for recordings of your own use gbid.fit_ringdown)",
        )
        return
    yield from timing_problems(section, experiment.spec.rig.sample_time_s, ("impacts",))
    try:
        domain, name = rig_model(experiment).domain, rig_model(experiment).name
        for axis in section.axes:
            hammer_of(section, axis, experiment.spec.rig.sample_time_s)
    except GbidError:
        return  # the checks of the rig section report this
    if section.model == "lpv" and experiment.spec.lpv is None:
        yield ("impacts", "model"), "there is no section 'lpv'; add one, or name a model"
    elif section.model not in (None, "lpv"):
        try:
            expecting_model(experiment)
        except GbidError as error:
            yield ("impacts", "model"), str(error)
    inside = []
    for i, point in enumerate(section.operating_points):
        outside = [
            (key, value, low, high)
            for key in ("pressure_bar", "speed_rpm")
            for value, (low, high) in [(getattr(point, key), getattr(domain, key))]
            if not low <= value <= high
        ]
        for key, value, low, high in outside:
            yield (
                ("impacts", "operating_points", i, key),
                f"{value:g} lies outside the domain of {name}, {low:g} to {high:g}; choose a value inside",
            )
        if not outside:
            inside.append(point)
    yield from _controller_problems(experiment, section, inside)


def timing_problems(section: HammerTrain, sample_time: float, where: Location) -> Found:
    """Yield a problem when impacts are too long for the time between them, or too short to be measured."""
    if section.impact_s > LONGEST_IMPACT * section.spacing_s:
        yield (
            (*where, "spacing_s"),
            f"{section.spacing_s:g} s is too short for impacts of {section.impact_s:g} s; lengthen it",
        )
    elif section.impact_s < 4 * sample_time:
        yield (
            (*where, "impact_s"),
            f"{section.impact_s:g} s is less than 4 samples; the force cannot be measured: lengthen it",
        )


def _controller_problems(experiment: Experiment, section: ImpactsSection, points: list[ImpactPoint]) -> Found:
    """Yield a problem for each loop with a used name or without a controller."""
    taken = [loop for loop in section.beside if loop in LOOPS]
    for loop in taken:
        yield ("impacts", "beside", loop), f"the name {loop!r} is reserved; choose another"
    for loop, word in {"closed": section.controller, **section.beside}.items():
        if loop in taken:
            continue
        try:
            if is_tuned(word):
                tuned_design(experiment, word)
            elif loop in loop_controllers(section):
                for point in points:
                    controller_at(experiment, point, loop)
        except GbidError as error:
            yield ("impacts", "beside", loop) if loop in section.beside else ("impacts", "controller"), str(error)
