"""Stage of the virtual rig: checks, recordings, and their controller in closed loop."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path

import numpy as np

from gbid import control
from gbid.control.loop.close import sample_plant
from gbid.core.arrays import FloatArray, point_label
from gbid.core.errors import GbidError, UsageError, nearest
from gbid.experiment.controllers import (
    LoopController,
    chosen,
    found_controller,
    loop_of,
    running_controller,
    stationary_at,
)
from gbid.experiment.experiment import Experiment, PlannedRecording
from gbid.experiment.fields import Found, InputError, Location, needed, refusal
from gbid.experiment.machine import PlannedRun, machine_at, outside_domain, rig_experiment, rig_model, rig_run
from gbid.experiment.recordings import recording_result, recording_tasks, save_made
from gbid.experiment.rig_schema import ControllerChoice, RigLoopSection, RigSection
from gbid.experiment.run import Job, Stage, Task
from gbid.experiment.stages.prefilter import identified_map
from gbid.prefilter import RunoutMap
from gbid.prefilter.runout_identification import identify_runout
from gbid.rig import ProgramController, SampledController
from gbid.rig.effects import rig_effect, rig_effects
from gbid.rig.excitation import whole_samples
from gbid.structure import LinearModel


def rig_runs(experiment: Experiment) -> Found:
    """Yield problems of the rig's model, its operating points, and times that are no multiples of the sample time."""
    rig = needed(experiment.spec.rig, "rig")
    try:
        model = rig_model(experiment)
    except GbidError as error:
        yield ("rig", "model"), str(error)
        return
    if not model.actuators and rig.actuators.kind == "linear":
        yield ("rig", "model"), f"model {model.name!r} has no actuators; the rig needs them: add them to its file"
        return
    outside: list[tuple[Location, str]] = []
    for i, point in enumerate(rig.operating_points):
        outside += outside_domain(model.domain, model.name, point, ("rig", "operating_points", i))
    for i, course in enumerate(rig.courses):
        for key in ("pressure_bar", "speed_rpm"):
            values, (low, high) = np.atleast_1d(getattr(course, key)), getattr(model.domain, key)
            if values.min() < low or values.max() > high:
                text = f"leaves the domain of {model.name}, {low:g} to {high:g}; choose values inside"
                outside.append((("rig", "courses", i, key), text))
    yield from outside
    for location in _TIMES:
        part = getattr(rig, location[0])
        seconds = getattr(part, location[1], None) if location[1:] else part
        if seconds:
            yield from refusal(("rig", *location), partial(whole_samples, location[-1], seconds, rig.sample_time_s))
    if outside or list(effects_are_known(experiment)):
        return  # the machine cannot be made
    simulated = [planned for planned in experiment.recordings.values() if planned.imported is None]
    alike = {(q.run, tuple(q.conditions.items()), q.in_loop): q for q in simulated}  # what the check looks at
    refused = [
        problem for planned in alike.values() for problem in refusal(("rig",), partial(_check_run, experiment, planned))
    ]
    yield from dict.fromkeys(refused)


def _check_run(experiment: Experiment, planned: PlannedRecording) -> None:
    """Refuse a recording that the rig cannot simulate, such as an unstable rotor without controller.

    Raises
    ------
    UsageError
        With what to do.
    """
    machine = machine_at(experiment, planned)
    rig_experiment(experiment, planned)
    try:
        if not planned.in_loop:
            machine.check_stable()
    except UsageError as error:
        remedy = "write recordings: 0 in the sections prbs and stationary, so that all are made in the loop"
        if needed(experiment.spec.rig, "rig").loop is None:
            remedy = "record it under a controller: loop:"
        raise UsageError(f"{error}; {remedy}") from None


def rig_keys_go_together(experiment: Experiment) -> Found:
    """Yield problems of keys that depend on each other: faults, stacks, staircases, units, compiled controller."""
    rig = needed(experiment.spec.rig, "rig")
    for i, entry in enumerate(rig.faults):
        for pattern in entry.recordings:
            if not any(q.imported is None for q in experiment.matching((pattern,))):
                hint = nearest(pattern, experiment.recordings)
                yield ("rig", "faults", i, "recordings"), f"no recording of the rig matches {pattern!r}; {hint}"
    if rig.actuators.kind != "stacks":
        if rig.stack_staircase is not None:
            yield ("rig", "stack_staircase"), "needs single stacks; write actuators: {kind: stacks}"
        if rig.actuators.record_stacks:
            yield ("rig", "actuators", "record_stacks"), "needs single stacks; write kind: stacks"
    points = [(q.pressure_bar, q.speed_rpm) for q in rig.operating_points]
    for part, section in (("staircase", rig.staircase), ("stack_staircase", rig.stack_staircase)):
        for i, place in enumerate((section.at if section else None) or ()):
            if (place.pressure_bar, place.speed_rpm) not in points:
                text = f"{point_label(place.pressure_bar, place.speed_rpm)} is no operating point of the rig; add it"
                yield ("rig", part, "at", i), text
    for part, key in _SIZES:
        largest = np.max(getattr(getattr(rig, part), key, 0.0))
        if largest > rig.clearance_m:
            text = f"{largest:g} m is more than the clearance of the bearing, {rig.clearance_m:g} m"
            yield ("rig", part, key), f"{text}; make it smaller (sizes are in metres)"
    for key in ("scatter", "loop", "courses") if rig.film is not None else ():
        if getattr(rig, key):
            yield ("rig", key), "needs the fourteen parameters of the model, and the rig has a gas film; remove one"
    if rig.film is not None and (impacts := experiment.spec.impacts) is not None and impacts.model is None:
        yield ("impacts", "model"), "the model of the rig is not its gas film; write model: lpv"
    if rig.controller == "compiled" and experiment.spec.impacts is None:
        text = "closes the loop of impacts, but there is no section impacts; add it or remove this"
        yield ("rig", "controller"), text


def effects_are_known(experiment: Experiment) -> Found:
    """Yield a problem for each effect that is unknown or has a wrong option."""
    for name, options in needed(experiment.spec.rig, "rig").effects.items():
        if name not in rig_effects():
            yield ("rig", "effects", name), f"no effect {name!r}; {nearest(name, rig_effects())}"
            continue
        yield from refusal(("rig", "effects", name), partial(rig_effect, name, **options))


_SIZES = (
    ("prbs", "amplitude_m"),
    ("staircase", "step_m"),
    ("sensors", "noise_p_m"),
    ("sensors", "noise_u_m"),
    ("sensors", "resolution_p_m"),
    ("sensors", "resolution_u_m"),
    ("unbalance", "eccentricity_m"),
    ("non_synchronous", "size_m"),
)
"""Keys that are sizes; one above the clearance usually lacks the factor 1e-6."""

_TIMES: tuple[tuple[str, ...], ...] = (
    ("duration_s",),
    ("settle_s",),
    ("prbs", "hold_s"),
    ("stationary", "duration_s"),
    ("staircase", "hold_s"),
    ("stack_staircase", "hold_s"),
    ("hammer", "duration_s"),
    ("run_up", "duration_s"),
)
"""Keys that are times, which must be whole numbers of samples."""


def rig_loop_can_run(experiment: Experiment) -> Found:
    """Yield problems of the controller for recordings in closed loop."""
    rig = needed(experiment.spec.rig, "rig")
    if rig.loop is None:
        return
    where: Location = ("rig", "loop")
    problems = list(controller_problems(experiment, rig.loop, where))
    yield from problems
    if rig.controller == "compiled" and rig.loop.runout != "online":
        yield (*where, "runout"), "the control chain in C subtracts the run-out; write runout: online"
    if rig.loop.runout == "offline" and rig.loop.stationary == 0:
        yield (*where, "stationary"), "the answers to run-out come from recordings without excitation; write 1"
    if rig.loop.runout == "online" and rig.stationary.recordings == 0:
        text = "the map comes from stationary recordings without controller, and there are none"
        yield (*where, "runout"), f"{text}; write runout: offline or none"
    for planned in experiment.recordings.values() if not problems else ():
        if planned.in_loop:
            try:
                check_loop_stable(experiment, planned, loop_controller_of(experiment, planned).sampled)
            except InputError:
                return  # the design is tuned first, and checked when it runs
            except GbidError as error:
                yield (*where, _key_of(rig.loop)), str(error)


def controller_problems(experiment: Experiment, section: ControllerChoice, where: Location) -> Found:
    """Yield problems of the controller that a loop section names."""
    problems = list(refusal(where, partial(chosen, experiment, section)))
    yield from problems
    if not problems and chosen(experiment, section) is section:  # else that of the rig, reported there
        yield from refusal(where, partial(found_controller, experiment, section, planned=True), _key_of(section))


def _key_of(section: ControllerChoice) -> str:
    return "structure" if section.controller is None else "controller"


_BINS = 720  # angles of the table that the controller subtracts


def loop_controller_of(experiment: Experiment, planned: PlannedRecording) -> LoopController:
    """Return the controller of a rig recording at its operating point.

    Raises
    ------
    UsageError
        When its gains are not all known, when it is not for two axes, or when its sample time is not that of the rig.
    InputError
        When a design has not been tuned with the present settings.
    """
    rig, section = _sections(experiment)
    running = running_controller(experiment, found_controller(experiment, section), planned.conditions)
    if rig.controller == "compiled" and running.continuous.dt is not None:
        name = running.design.name
        raise UsageError(f"controller {name!r} is sampled; the control chain in C needs a continuous one")
    return running


def check_loop_stable(experiment: Experiment, planned: PlannedRecording, sampled: LinearModel) -> None:
    """Refuse a controller with an unstable loop; scatter and effects of the rig are not considered.

    Raises
    ------
    UsageError
        When the sampled loop is unstable.
    """
    model, (rig, _) = rig_model(experiment), _sections(experiment)
    if not model.actuators:
        return
    pressure, speed = planned.conditions["pressure_bar"], planned.conditions["speed_rpm"]
    plant = sample_plant(control.exact_plant(model, pressure, speed), rig.sample_time_s, rig.sample_time_s)
    if not control.close_loop(plant, sampled).is_stable():
        at = point_label(pressure, speed)
        raise UsageError(f"controller {sampled.name!r} makes the rotor unstable at {at}; choose another")


def running(
    experiment: Experiment, planned: PlannedRecording, run: PlannedRun
) -> SampledController | ProgramController:
    """Return the controller of the rig for one recording, ready to run.

    The run-out map that it subtracts is that of the stationary recordings, with which the prefilter works. Two maps
    would differ by the noise of their recordings, to which the loop answers. Where it does not subtract the run-out, it
    subtracts the zero of the probes.

    Raises
    ------
    UsageError
        When the loop is unstable, or as `loop_controller_of`.
    """
    rig, section = _sections(experiment)
    controller = loop_controller_of(experiment, planned)
    check_loop_stable(experiment, planned, controller.sampled)
    if section.runout == "online":
        controller_of_loop = loop_of(experiment, controller, run)
        if isinstance(controller_of_loop, ProgramController) or not planned.conditions["speed_rpm"]:
            return (
                controller_of_loop  # a program has a map of its own, and at rest the position does not follow the angle
            )
        runout_map = _map_at_rest(experiment, planned.point)
        nodes: FloatArray = np.asarray(np.arange(_BINS) * (2 * np.pi / _BINS), np.float64)
        return replace(controller_of_loop, runout=runout_map.evaluate(nodes) - runout_map.mean, offset=runout_map.mean)
    A, B, C, D = (np.array(getattr(controller.sampled, letter)) for letter in "ABCD")
    name = controller.sampled.name
    return SampledController(A, B, C, D, rig.sample_time_s, offset=run.machine.sensors.offset_p_m, name=name)


@lru_cache(maxsize=16)
def _map_at_rest(experiment: Experiment, point: str) -> RunoutMap:
    """Return the run-out map from the stationary recordings of an operating point, simulated again bit for bit."""
    still = [rig_run(experiment, planned).record() for planned in stationary_at(experiment, point)]
    section = experiment.spec.prefilter
    if section is None or section.method == "none":
        return identify_runout(still)
    return identified_map(still, section)[0]


def _sections(experiment: Experiment) -> tuple[RigSection, RigLoopSection]:
    rig = needed(experiment.spec.rig, "rig")
    assert rig.loop is not None
    return rig, rig.loop


def rig_tasks(job: Job) -> list[Task]:
    """Return the tasks of the rig section, one for each recording."""
    return recording_tasks(job, recording_result, _write_recording, lambda planned: planned.imported is None)


def _write_recording(job: Job, part: Path, name: str) -> None:
    experiment, planned = job.experiment, job.experiment.recordings[name]
    run, controller = rig_run(experiment, planned), None
    if planned.controller:
        design = control.load_controller(experiment.results / planned.controller)
        controller = loop_of(experiment, running_controller(experiment, design, planned.conditions), run)
    elif planned.in_loop:
        controller = running(experiment, planned, run)
    save_made(run.record(controller), planned, part)


RIG_CHECKS = (effects_are_known, rig_runs, rig_keys_go_together, rig_loop_can_run)
RIG = Stage("rig", "rig", RIG_CHECKS, rig_tasks, early=True)
"""Recordings of the virtual rig, ``recordings/<name>.h5``."""
