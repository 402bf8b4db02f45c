"""Checks of the cycle section: rig, surfaces, design and operating points."""

from __future__ import annotations

from gbid.errors import GbidError
from gbid.experiment.experiment import Experiment
from gbid.experiment.problems import Found
from gbid.experiment.stages.cycle.plan import cycle_design, recording_points, trial_points
from gbid.experiment.stages.impact.checks import timing_problems
from gbid.experiment.stages.rig.model import rig_model
from gbid.experiment.stages.tune.plan import controller_section, surfaces_item


def cycle_can_run(experiment: Experiment) -> Found:
    """Yield problems of the cycle: what it needs, and operating points that have no map or lie outside."""
    section, spec = experiment.spec.cycle, experiment.spec
    if section is None:
        return
    for needed, why in (("rig", "runs on it"), ("lpv", "fits its surfaces again"), ("controller", "tunes it again")):
        if not getattr(spec, needed):
            yield ("cycle",), f"there is no section {needed!r}; add one, because the cycle {why}"
    if spec.rig is None or spec.lpv is None or not spec.controller:
        return
    yield from timing_problems(section.impacts, spec.rig.sample_time_s, ("cycle", "impacts"))
    try:
        name = cycle_design(experiment)
        if surfaces_item(experiment, controller_section(experiment, name)) != spec.lpv.fit:
            yield ("cycle", "design"), f"design {name!r} does not use the surfaces; write model: lpv, or choose another"
    except GbidError as error:
        yield ("cycle", "design"), str(error)
    yield from _point_problems(experiment)


def _point_problems(experiment: Experiment) -> Found:
    section, rig = experiment.spec.cycle, experiment.spec.rig
    assert section is not None
    assert rig is not None
    at = [(q.pressure_bar, q.speed_rpm) for q in rig.operating_points]
    if experiment.spec.prefilter is not None and experiment.spec.prefilter.method != "none":
        for i, point in enumerate(section.operating_points or ()):
            if (point.pressure_bar, point.speed_rpm) not in at:
                text = "is no operating point of the section rig, so it has no run-out map; choose one of those"
                yield ("cycle", "operating_points", i), text
    try:
        model = rig_model(experiment)
    except GbidError:
        return  # the checks of the rig section report this
    recorded, hit = recording_points(experiment), trial_points(experiment)
    for where, points in ((("cycle", "operating_points"), recorded), (("cycle", "impacts", "operating_points"), hit)):
        for q in points:
            try:
                model.domain.check(q.pressure_bar, q.speed_rpm, f"model {model.name!r}", extrapolate=False)
            except GbidError as error:
                yield where, str(error)
