"""Checks of loops: the controllers of the rig's recordings and of fits."""

from __future__ import annotations

from gbid.errors import GbidError
from gbid.experiment.experiment import Experiment
from gbid.experiment.problems import Found, Location, nearest
from gbid.experiment.run.inputs import InputError
from gbid.experiment.stages.impact.plan import is_tuned, tuned_design
from gbid.experiment.stages.loop.plan import chosen, early_key, found_controller
from gbid.experiment.stages.loop.running import check_loop_stable, loop_controller_of
from gbid.experiment.stages.loop.schema import ControllerChoice


def fit_loops_are_known(experiment: Experiment) -> Found:
    """Yield a problem for each fit in a loop whose controller or comparison is not there."""
    for name, section in experiment.spec.fits.items():
        if section.loop is None:
            continue
        where: Location = ("fits", name, "loop")
        yield from _controller_problems(experiment, section.loop, where)
        beside = section.loop.beside
        if beside is None:
            continue
        if beside not in experiment.spec.fits:
            yield (*where, "beside"), f"no fit of this name; {nearest(beside, experiment.spec.fits)}"
        elif experiment.spec.fits[beside].loop is not None:
            yield (*where, "beside"), f"fit {beside!r} is in a loop itself; name one to recordings without controller"
        elif section.together or experiment.spec.fits[beside].together:
            yield (*where, "beside"), "compares fits of single recordings; remove together: true, or this key"


def rig_loop_can_run(experiment: Experiment) -> Found:
    """Yield problems of the controller of the rig's recordings in closed loop."""
    rig = experiment.spec.rig
    if rig is None or rig.loop is None:
        return
    where: Location = ("rig", "loop")
    found = list(_controller_problems(experiment, rig.loop, where))
    yield from found
    if rig.controller == "compiled" and rig.loop.runout != "online":
        yield (*where, "runout"), "the control chain in C subtracts the run-out; write runout: online"
    if rig.loop.runout == "offline" and rig.loop.stationary == 0:
        yield (*where, "stationary"), "the answers to run-out come from recordings without excitation; write 1"
    if rig.loop.runout == "online" and rig.stationary.recordings == 0:
        yield (
            (*where, "runout"),
            "the map comes from stationary recordings without controller, and there are none; write runout: offline or "
            "none",
        )
    if found:
        return
    reported: set[str] = set()
    for planned in experiment.recordings.values():
        if not planned.in_loop:
            continue
        try:
            check_loop_stable(experiment, planned, loop_controller_of(experiment, planned).sampled)
        except InputError:
            return  # the design is tuned first, and checked when it runs
        except GbidError as error:
            if str(error) not in reported:
                yield (*where, _key_of(rig.loop)), str(error)
            reported.add(str(error))


def _controller_problems(experiment: Experiment, section: ControllerChoice, where: Location) -> Found:
    try:
        used = chosen(experiment, section)
    except GbidError as error:
        yield where, str(error)
        return
    if used is not section:
        return  # that of the rig, reported there
    try:
        if section.controller is not None and is_tuned(section.controller):
            early_key(experiment, tuned_design(experiment, section.controller))
        found_controller(experiment, section, planned=True)
    except GbidError as error:
        text = str(error)
        yield (*where, "gains" if "has no gain" in text else _key_of(section)), text


def _key_of(section: ControllerChoice) -> str:
    return "structure" if section.controller is None else "controller"
