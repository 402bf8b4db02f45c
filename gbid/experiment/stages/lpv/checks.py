"""Checks of the lpv section."""

from __future__ import annotations

import numpy as np

from gbid.errors import GbidError
from gbid.experiment.experiment import Experiment
from gbid.experiment.problems import Found, Location
from gbid.experiment.stages.fit.checks import a_fit_is_named
from gbid.experiment.stages.fit.structures import structure_or_none
from gbid.experiment.stages.lpv.plan import lpv_actuators
from gbid.experiment.stages.lpv.schema import LpvSection
from gbid.lpv.surface_fit.terms import check_points, chosen_exponents
from gbid.structure import KEY_PARAMETERS, ScheduledStructure


def surfaces_can_be_drawn(experiment: Experiment) -> Found:
    """Yield problems of the lpv section: fit, key parameters, actuators, and operating points for the order."""
    section = experiment.spec.lpv
    if section is None:
        return
    where: Location = ("lpv", "fit")
    if section.fit in experiment.spec.fits and isinstance(
        structure := structure_or_none(experiment, section.fit), ScheduledStructure
    ):
        yield from _of_scheduled(experiment, section, structure)
        return
    yield from a_fit_is_named(experiment, where, section.fit, KEY_PARAMETERS, "name a fit of rotor_bearing or plant")
    if section.fit not in experiment.spec.fits:
        return
    try:
        lpv_actuators(experiment, section)
    except GbidError as error:
        yield ("lpv", "actuators"), str(error)
    if section.robust and section.weighting == "fits":
        yield ("lpv", "robust"), "needs weighting: scatter or ordinary"
    points = []
    for planned in experiment.fit_recordings(section.fit):
        point = [planned.conditions.get(key) for key in ("pressure_bar", "speed_rpm")]
        if None in point:
            yield where, f"recording {planned.name!r} has no pressure_bar and speed_rpm; surfaces need both"
            return
        points.append([float(v) for v in point if v is not None])
    if points and section.order != "auto":
        try:
            check_points(np.array(points), chosen_exponents(section.order))
        except GbidError as error:
            yield ("lpv", "order"), str(error)


def _of_scheduled(experiment: Experiment, section: LpvSection, structure: ScheduledStructure) -> Found:
    """Yield problems of surfaces that a scheduled structure has itself."""
    if not experiment.spec.fits[section.fit].together:
        text = f"{structure.name} has one model for all recordings; write together: true"
        yield ("fits", section.fit, "together"), text
    if section.direct:
        yield ("lpv", "direct"), f"{structure.name} gives the surfaces straight from the recordings already; remove it"
    try:
        lpv_actuators(experiment, section)
    except GbidError as error:
        yield ("lpv", "actuators"), str(error)
