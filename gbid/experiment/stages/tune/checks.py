"""Checks of the controller section: structures, models, gains and operating points exist."""

from __future__ import annotations

from gbid.control import Scheduled
from gbid.control.tuning.goals.goal import DesignContext, limits_of
from gbid.errors import GbidError
from gbid.experiment.experiment import Experiment
from gbid.experiment.problems import Found, Location, nearest
from gbid.experiment.stages.tune.design_goals import made_goal, no_disturbance
from gbid.experiment.stages.tune.plan import SHORT_FORM, design_structure, named_model, surfaces_item
from gbid.experiment.stages.tune.schema import ControllerSection
from gbid.lpv import LPVModel, load_model
from gbid.structure.linear import Structure


def designs_can_be_tuned(experiment: Experiment) -> Found:
    """Yield problems of the structure, model, gains and operating points of each design."""
    for name, section in experiment.spec.controller.items():
        where: Location = ("controller", name)
        model: LPVModel | None = None
        try:
            item = surfaces_item(experiment, section)
        except GbidError as error:
            yield (*where, "model"), str(error)
            continue
        if item is None:
            try:
                model = named_model(experiment, section)
            except GbidError as error:
                yield (*where, "model") if section.model else where, str(error)
                continue
            for key in ("uncertainty", "robust"):
                if getattr(section, key) is not None:
                    yield (*where, key), "needs the surfaces of this experiment; write model: lpv"
        else:
            yield from _surfaces_problems(experiment, section, where)
        if model is not None:
            yield from _point_problems(section, model, where)
        yield from _goal_problems(experiment, section, where)
        try:
            structure = design_structure(experiment, section, None if model is None else model.domain)
        except GbidError as error:
            key = "schedule" if "terms" in str(error) else "options" if section.options else "structure"
            yield (*where, key), str(error)
            continue
        yield from _gain_problems(section, structure, where)


def _surfaces_problems(experiment: Experiment, section: ControllerSection, where: Location) -> Found:
    lpv = experiment.spec.lpv
    assert lpv is not None
    if lpv.actuators is None:
        yield (*where, "model") if section.model else where, "the surfaces have no actuators; add lpv: actuators"
    if section.model == "lpv_direct" and not lpv.direct:
        yield (*where, "model"), "there are no surfaces of a direct LPV fit; write lpv: direct: true"


def _point_problems(section: ControllerSection, model: LPVModel, where: Location) -> Found:
    if section.operating_points == "model" and not model.operating_points:
        yield (
            (*where, "operating_points") if "operating_points" in section.model_fields_set else where,
            f"model {model.name!r} lists no operating points; list some, or write domain",
        )
    if isinstance(section.operating_points, str):
        return
    for i, point in enumerate(section.operating_points):
        for key in ("pressure_bar", "speed_rpm"):
            value, (low, high) = getattr(point, key), getattr(model.domain, key)
            if not low <= value <= high:
                yield (
                    (*where, "operating_points", i, key),
                    f"{value:g} lies outside the domain of {model.name}, {low:g} to {high:g}; choose a value inside",
                )


def _goal_problems(experiment: Experiment, section: ControllerSection, where: Location) -> Found:
    if section.robust is not None:
        if section.goals is None:
            yield (*where, "robust"), "needs goals; list them, such as goals: [{goal: MaxDamping}]"
        if section.uncertainty is not None:
            yield (*where, "uncertainty"), "comes with robust already; leave it out"
        if section.pareto:
            yield (*where, "pareto"), "is not for robust designs; write price: [...] below robust, or a second design"
    if section.goals is None:
        return
    for key in SHORT_FORM:
        if key in section.model_fields_set:
            yield (*where, key), "stands beside goals; write it as a goal, too"
    goals = []
    for i, entry in enumerate(section.goals):
        try:
            goals.append(made_goal(entry, no_disturbance))
        except GbidError as error:
            yield (*where, "goals", i), str(error)
        for pattern in entry.given().get("disturbance", ()):
            yield from _disturbance_problems(experiment, pattern, (*where, "goals", i, "disturbance"))
    if len(goals) < len(section.goals):
        return
    try:  # every plant has the channels of this one
        limits_of(goals, DesignContext(load_model("theisen2016").plant_at(6.0, 0.0)))
    except GbidError as error:
        yield (*where, "goals"), str(error)


def _disturbance_problems(experiment: Experiment, pattern: str, where: Location) -> Found:
    found = experiment.matching((pattern,))
    if not found:
        yield where, f"no recording {pattern!r}; {nearest(pattern, experiment.recordings)}"
    for planned in found:
        if not planned.stationary:
            yield where, f"recording {planned.name!r} is not stationary; its spectrum is not that of a disturbance"
        elif "p" not in planned.signals:
            yield where, f"recording {planned.name!r} has no signal p; there is {', '.join(planned.signals)}"


def _gain_problems(section: ControllerSection, structure: Structure | Scheduled, where: Location) -> Found:
    names = [parameter.name for parameter in structure.parameters]
    for key in ("bounds", "start"):
        for gain in getattr(section, key):
            if gain not in names:
                yield (*where, key, gain), f"{structure.name} has no gain of this name; {nearest(gain, names)}"
    for gain, (low, high) in section.bounds.items():
        if not low < high:
            yield (*where, "bounds", gain), f"lower bound {low:g} is not below the upper one, {high:g}"
