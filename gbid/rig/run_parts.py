"""Parts of a recording of the rig: its machine, its rotation, its additional effects, and its control program."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from gbid.arrays import FloatArray
from gbid.errors import UsageError
from gbid.rig.excitation.run_up import RPM, RunUp, Turning
from gbid.rig.excitation.scheduled_run import ScheduledRun
from gbid.rig.machine.controller import ProgramController, SampledController
from gbid.rig.machine.machine import Machine, RotorBearingTruth
from gbid.rig.machine.rig_effect import RigRun
from gbid.rig.machine.scatter import Scatter, scatter_random, scattered
from gbid.rig.stepping.along_course import AlongCourse, Surfaces
from gbid.rig.stepping.program_loop import ProgramLoop


def rotation(experiment: Any, conditions: Mapping[str, float]) -> Turning:
    """Return the rotation of the shaft, constant except in runs with a changing speed."""
    if isinstance(experiment, RunUp | ScheduledRun):
        return experiment.turning()
    speed_rpm = conditions.get("speed_rpm")
    if speed_rpm is None or not np.isfinite(speed_rpm):
        raise UsageError(f"conditions: speed_rpm = {speed_rpm}; give the speed of the shaft, 0 for standstill")
    return Turning((0.0,), (float(speed_rpm) * RPM,))


def machine_this_time(
    machine: Machine, scatter: Scatter | None, seed: int, name: str, conditions: Mapping[str, float]
) -> tuple[Machine, int]:
    """Return the machine of this recording, with its scatter, and the number of rejected draws."""
    if scatter is None:
        return machine, 0
    random = scatter_random(seed, name, conditions)
    rotor_bearing, thrown = scattered(machine.rotor_bearing, scatter, random)
    return replace(machine, rotor_bearing=rotor_bearing), thrown


def along_course(
    machine: Machine,
    experiment: ScheduledRun,
    surfaces: Surfaces,
    times: FloatArray,
    scatter: Scatter | None,
    seed: int,
    name: str,
) -> tuple[Machine, AlongCourse, int]:
    """Return the machine at the start of a course, its parameters on the way, and the number of rejected draws.

    A recording with scatter deviates from the surfaces by the same amounts all the way, which are drawn at the middle
    of the course.
    """
    deviation, thrown = None, 0
    if scatter is not None:
        pressure, speed = (float(v) for v in experiment.course.at(np.array(experiment.duration_s / 2)))
        known = RotorBearingTruth.from_parameters(surfaces(np.array([pressure]), np.array([speed])))
        random = scatter_random(seed, name, {"pressure_bar": pressure, "speed_rpm": speed})
        drawn, thrown = scattered(known, scatter, random)
        nominal = known.key_parameters()
        deviation = {key: value - nominal[key] for key, value in drawn.key_parameters().items()}
    along = AlongCourse.of(surfaces, experiment.course, times, deviation)
    return replace(machine, rotor_bearing=along.truths[0]), along, thrown


def effects_of(
    machine: Machine,
    turning: Turning,
    time: FloatArray,
    conditions: Mapping[str, float],
    random: Sequence[np.random.Generator],
) -> tuple[FloatArray | None, FloatArray]:
    """Return the sums of the forces per moving mass [m/s^2], or None, and of the readings [m] of all effects."""
    force, reading = None, np.zeros((len(time), 2))
    for effect, own in zip(machine.effects, random, strict=True):
        run = RigRun(time, turning.angle(time), turning.speed_at(time), conditions, own)
        pushed, read = effect.force(run), effect.reading(run)
        if pushed is not None:
            force = pushed if force is None else force + pushed
        if read is not None:
            reading = reading + read
    return force, reading


def program_loop(
    controller: SampledController | ProgramController | None,
    turning: Turning,
    time: FloatArray,
    shown: FloatArray,
    pressure_bar: FloatArray,
) -> ProgramLoop | None:
    """Return the program of the loop with what it sees at the samples; None for another controller."""
    if not isinstance(controller, ProgramController):
        return None
    speed_rpm = turning.speed_at(time) / RPM
    return ProgramLoop(controller.program, shown, speed_rpm, pressure_bar)
