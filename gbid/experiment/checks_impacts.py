"""What the impacts section means: there is a rig, its models hold at the operating points, the controller is there."""

from __future__ import annotations

from collections.abc import Iterator

from gbid.errors import GbidError
from gbid.experiment.impact_plan import controller_at, expecting_model, hammer_of, is_tuned, tuned_design
from gbid.experiment.load import Experiment
from gbid.experiment.problems import Location
from gbid.experiment.structures import rig_model

LONGEST_BLOW = 0.25
"""Of the time between blows; what follows is the ring-down."""


def impacts_can_be_made(experiment: Experiment) -> Iterator[tuple[Location, str]]:
    """Impacts: rig, operating points inside the domain, blows one after the other, a controller that can be loaded."""
    section = experiment.spec.impacts
    if section is None:
        return
    if experiment.spec.rig is None:
        yield (
            ("impacts",),
            "needs the section rig, which is hit; add one (for recordings of your own use gbid.fit_ringdown)",
        )
        return
    if section.impact_s > LONGEST_BLOW * section.spacing_s:
        yield (
            ("impacts", "spacing_s"),
            f"{section.spacing_s:g} s is too short for blows of {section.impact_s:g} s; lengthen it",
        )
    elif section.impact_s < 4 * experiment.spec.rig.sample_time_s:
        yield (
            ("impacts", "impact_s"),
            f"{section.impact_s:g} s is less than 4 samples; the force cannot be measured: lengthen it",
        )
    try:
        domain, name = rig_model(experiment).domain, rig_model(experiment).name
        for axis in section.axes:
            hammer_of(section, axis, experiment.spec.rig.sample_time_s)
    except GbidError:
        return  # the rig section says so
    if section.model == "lpv" and experiment.spec.lpv is None:
        yield ("impacts", "model"), "there is no section 'lpv'; add one, or name a model"
    elif section.model not in (None, "lpv"):
        try:
            expecting_model(experiment)
        except GbidError as error:
            yield ("impacts", "model"), str(error)
    tuned = is_tuned(section)
    if tuned:
        try:
            tuned_design(experiment)
        except GbidError as error:
            yield ("impacts", "controller"), str(error)
    for i, point in enumerate(section.operating_points):
        inside = True
        for key in ("pressure_bar", "speed_rpm"):
            value, (low, high) = getattr(point, key), getattr(domain, key)
            if not low <= value <= high:
                inside = False
                yield (
                    ("impacts", "operating_points", i, key),
                    f"{value:g} lies outside the domain of {name}, {low:g} to {high:g}; choose a value inside",
                )
        if inside and "closed" in section.loops and not tuned:
            try:
                controller_at(experiment, point)
            except GbidError as error:
                yield ("impacts", "controller"), str(error)
                return
