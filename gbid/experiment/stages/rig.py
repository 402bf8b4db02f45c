"""Recordings of the virtual rig: checks of its section, and its controller in closed loop."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path

import numpy as np

from gbid.control import close_loop, exact_plant, load_controller, sample_plant
from gbid.core.arrays import FloatArray, point_label
from gbid.core.errors import GbidError, UsageError
from gbid.experiment.controllers import (
    LoopController,
    found_controller,
    loop_of,
    running_controller,
    stationary_at,
)
from gbid.experiment.experiment import Check, Experiment, PlannedRecording
from gbid.experiment.fields import Found, Location, nearest, needed, refusal
from gbid.experiment.machine import PlannedRun, machine_at, outside_domain, rig_experiment, rig_model, rig_run
from gbid.experiment.recordings import recording_result
from gbid.experiment.rig_schema import RigLoopSection, RigSection
from gbid.experiment.run import Job, Stage, Task
from gbid.experiment.stages.prefilter import identified_map
from gbid.lpv import LPVModel
from gbid.prefilter import RunoutMap, identify_runout
from gbid.recording import save_recording
from gbid.rig import ProgramController, SampledController, rig_effect, rig_effects
from gbid.rig.excitation import whole_samples
from gbid.structure import LinearModel


def rig_runs(experiment: Experiment) -> Found:
    """Yield problems of the rig's model, its operating points, and times that are not whole samples."""
    rig = experiment.spec.rig
    if rig is None:
        return
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
    for location, seconds in _times(rig):
        yield from refusal(location, partial(whole_samples, str(location[-1]), seconds, rig.sample_time_s))
    if outside or list(effects_are_known(experiment)):
        return  # the machine cannot be made
    refused = [
        problem
        for planned in experiment.recordings.values()
        if planned.imported is None
        for problem in refusal(("rig",), partial(_check_run, experiment, planned, model))
    ]
    yield from dict.fromkeys(refused)


def _check_run(experiment: Experiment, planned: PlannedRecording, model: LPVModel) -> None:
    """Refuse a recording that the rig cannot make, as one without controller of an unstable rotor.

    Raises
    ------
    UsageError
        With what to do.
    """
    rig, machine = needed(experiment.spec.rig, "rig"), machine_at(experiment, planned, model)
    rig_experiment(experiment, planned)
    try:
        if not planned.in_loop:
            machine.rotor_bearing.check_stable()
    except UsageError as error:
        if rig.loop is None:
            raise UsageError(f"{error}; record it under a controller: loop:") from None
        raise UsageError(
            f"{error}; write recordings: 0 in the sections prbs and stationary, so that all are made in the loop"
        ) from None


def faults_name_recordings(experiment: Experiment) -> Found:
    """Yield a problem for each entry of faults without recordings or with a wrong value."""
    rig = experiment.spec.rig
    for i, entry in enumerate(rig.faults if rig else ()):
        here: Location = ("rig", "faults", i)
        for pattern in entry.recordings:
            if not any(q.imported is None for q in experiment.matching((pattern,))):
                known = nearest(pattern, experiment.recordings)
                yield (*here, "recordings"), f"no recording of the rig matches {pattern!r}; {known}"


def effects_are_known(experiment: Experiment) -> Found:
    """Yield a problem for each effect that is unknown or has a wrong option."""
    rig = experiment.spec.rig
    for name, options in rig.effects.items() if rig else ():
        if name not in rig_effects():
            yield ("rig", "effects", name), f"no effect {name!r}; {nearest(name, rig_effects())}"
            continue
        yield from refusal(("rig", "effects", name), partial(rig_effect, name, **options))


def stacks_are_there(experiment: Experiment) -> Found:
    """Yield a problem for each key that needs single stacks when the rig has none."""
    rig = experiment.spec.rig
    if rig is None or rig.actuators.kind == "stacks":
        return
    if rig.stack_staircase is not None:
        yield ("rig", "stack_staircase"), "needs single stacks; write actuators: {kind: stacks}"
    if rig.actuators.record_stacks:
        yield ("rig", "actuators", "record_stacks"), "needs single stacks; write kind: stacks"


def staircases_are_somewhere(experiment: Experiment) -> Found:
    """Yield a problem for each staircase at a point that is not an operating point of the rig."""
    rig = experiment.spec.rig
    there = [(q.pressure_bar, q.speed_rpm) for q in rig.operating_points] if rig else []
    for part in ("staircase", "stack_staircase"):
        section = getattr(rig, part, None)
        for i, place in enumerate((section.at if section else None) or ()):
            if (place.pressure_bar, place.speed_rpm) not in there:
                text = f"{point_label(place.pressure_bar, place.speed_rpm)} is no operating point of the rig; add it"
                yield ("rig", part, "at", i), text


def sizes_fit_the_clearance(experiment: Experiment) -> Found:
    """Yield a problem for each size above the clearance; usually the factor 1e-6 was forgotten."""
    rig = experiment.spec.rig
    for location in _SIZES if rig else ():
        part, key = location
        value = getattr(getattr(rig, part), key, 0.0)
        assert rig is not None
        largest = max(value) if isinstance(value, tuple) else value
        if largest > rig.clearance_m:
            text = (
                f"{largest:g} m is more than the clearance of the bearing, {rig.clearance_m:g} m; "
                "make it smaller (sizes are in metres)"
            )
            yield ("rig", *location), text


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


def _times(rig: RigSection) -> Iterator[tuple[Location, float]]:
    """Yield the times that must be whole numbers of samples."""
    yield ("rig", "duration_s"), rig.duration_s
    if rig.settle_s:
        yield ("rig", "settle_s"), rig.settle_s
    yield ("rig", "prbs", "hold_s"), rig.prbs.hold_s
    for part, key in (
        ("stationary", "duration_s"),
        ("staircase", "hold_s"),
        ("stack_staircase", "hold_s"),
        ("hammer", "duration_s"),
        ("run_up", "duration_s"),
    ):
        seconds = getattr(getattr(rig, part), key, None)
        if seconds is not None:
            yield ("rig", part, key), seconds


RIG_CHECKS: tuple[Check, ...] = (
    effects_are_known,
    rig_runs,
    sizes_fit_the_clearance,
    stacks_are_there,
    staircases_are_somewhere,
    faults_name_recordings,
)
"""Checks of the rig section."""


# ---- Controller of the rig's recordings in closed loop, as it runs.

_BINS = 720  # angles of the table that the controller subtracts


def loop_controller_of(experiment: Experiment, planned: PlannedRecording) -> LoopController:
    """Return the controller of a recording of the rig, at its operating point.

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
    """Refuse a controller with which the rotor is unstable, without scatter and effects of the rig.

    Raises
    ------
    UsageError
        When the sampled loop is unstable.
    """
    model, (rig, _) = rig_model(experiment), _sections(experiment)
    if not model.actuators:
        return
    pressure, speed = planned.conditions["pressure_bar"], planned.conditions["speed_rpm"]
    plant = sample_plant(exact_plant(model, pressure, speed), rig.sample_time_s, rig.sample_time_s)
    if not close_loop(plant, sampled).is_stable():
        raise UsageError(
            f"controller {sampled.name!r} makes the rotor unstable at {point_label(pressure, speed)}; choose another"
        )


def running(
    experiment: Experiment, planned: PlannedRecording, run: PlannedRun
) -> SampledController | ProgramController:
    """Return the controller of the rig for one recording.

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
        made = loop_of(experiment, controller, run)
        if isinstance(made, ProgramController) or not planned.conditions["speed_rpm"]:
            return made  # a program has a map of its own, and at rest the position does not follow the angle
        runout_map = _map_at_rest(experiment, planned.point)
        nodes: FloatArray = np.asarray(np.arange(_BINS) * (2 * np.pi / _BINS), np.float64)
        return replace(made, runout=runout_map.evaluate(nodes) - runout_map.mean, offset=runout_map.mean)
    A, B, C, D = (np.array(getattr(controller.sampled, letter)) for letter in "ABCD")
    name = controller.sampled.name
    return SampledController(A, B, C, D, rig.sample_time_s, offset=run.machine.sensors.offset_p_m, name=name)


@lru_cache(maxsize=16)
def _map_at_rest(experiment: Experiment, point: str) -> RunoutMap:
    """Return the run-out map of the stationary recordings at an operating point, which are made again, bit for bit."""
    still = [rig_run(experiment, planned).record() for planned in stationary_at(experiment, point)]
    section = experiment.spec.prefilter
    if section is None or section.method == "none":
        return identify_runout(still)
    return identified_map(still, section)[0]


def _sections(experiment: Experiment) -> tuple[RigSection, RigLoopSection]:
    rig = needed(experiment.spec.rig, "rig")
    assert rig.loop is not None
    return rig, rig.loop


# ---- Stage of the recordings of the virtual rig.


def rig_tasks(job: Job) -> list[Task]:
    """Return the tasks of the rig section, one for each recording."""
    experiment = job.experiment
    return [
        Task.of(recording_result(experiment, planned), partial(_write_recording, name=planned.name), [planned.name])
        for planned in experiment.recordings.values()
        if planned.imported is None
    ]


def _write_recording(job: Job, part: Path, name: str) -> None:
    experiment, planned = job.experiment, job.experiment.recordings[name]
    run, controller = rig_run(experiment, planned), None
    if planned.controller:
        design = load_controller(experiment.results / planned.controller)
        controller = loop_of(experiment, running_controller(experiment, design, planned.conditions), run)
    elif planned.in_loop:
        controller = running(experiment, planned, run)
    save_recording(run.record(controller), part, overwrite=True)


RIG = Stage("rig", "rig", RIG_CHECKS, rig_tasks, early=True)
"""Recordings of the virtual rig, ``recordings/<name>.h5``."""
