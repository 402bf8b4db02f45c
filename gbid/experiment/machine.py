"""Virtual rig of an experiment: model, machine, runs, and true values of parameters."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from fnmatch import fnmatchcase
from functools import lru_cache
from math import modf
from pathlib import Path
from typing import Any

import numpy as np

from gbid import excite, lpv
from gbid.core.errors import UsageError
from gbid.core.units import SIGNALS
from gbid.experiment.experiment import Experiment, PlannedRecording
from gbid.experiment.fields import Found, Location, needed
from gbid.experiment.rig_schema import ActuatorSection, Place, RigSection
from gbid.experiment.schema import HammerTrain
from gbid.lpv.model_file import PublishedMachine
from gbid.recording import Recording
from gbid.rig import (
    Course,
    FilmPoint,
    Hammer,
    Impact,
    Machine,
    PiezoStack,
    PiezoStacks,
    Played,
    Prbs,
    ProgramController,
    RotorBearingTruth,
    SampledController,
    ScheduledRun,
    StackStaircase,
    Staircase,
    Stationary,
)
from gbid.rig.effects import rig_effect
from gbid.rig.excitation import RPM
from gbid.rig.machine import scattered_bearing
from gbid.rig.piezo import ALLOCATION
from gbid.rig.response import possible_machines
from gbid.rig.simulation import Experiment as RigExperiment
from gbid.rig.simulation import record
from gbid.rig.stepping import Surfaces
from gbid.structure import KEY_PARAMETERS, LinearModel, PiezoPair, Plant, RotorBearing
from gbid.structure.built_in import STIFFENING
from gbid.structure.kinds import AnyStructure, kind_of
from gbid.structure.linear import evaluate

BEFORE_S = 0.2
"""Time before the first impact [s], which shows the motion of the disc without impact."""
_GOLDEN = 0.6180339887


@lru_cache(maxsize=4)
def rig_machine(experiment: Experiment) -> PublishedMachine:
    """Return the machine of the rig by name, or from a YAML file relative to the experiment or the models folder.

    Raises
    ------
    UsageError
        When the model is missing or its file is faulty.
    """
    name = needed(experiment.spec.rig, "rig").model
    is_file = Path(name).suffix in (".yaml", ".yml")
    machine = lpv.load_machine(experiment.folder_of(name) / name if is_file else name)
    machine.model.need_bearing()
    return machine


@lru_cache(maxsize=4)
def rig_model(experiment: Experiment) -> lpv.LPVModel:
    """Return the LPV model of `rig_machine`, with the numbers of `machine_data`."""
    model = rig_machine(experiment).model
    return replace(model, machine=machine_data(experiment).filled(model.machine))


def machine_data(experiment: Experiment) -> lpv.MachineData:
    """Return the machine data of an experiment: from the section machine, else from its virtual rig."""
    rig = experiment.spec.rig
    given = lpv.MachineData(*(getattr(experiment.spec.machine, entry.name) for entry in fields(lpv.MachineData)))
    return (
        given if rig is None else given.filled(lpv.MachineData(rig.moving_mass_kg, PiezoStack.stroke, rig.clearance_m))
    )


def _true_parameters(model: lpv.LPVModel, pressure_bar: float, speed_rpm: float) -> dict[str, float]:
    """Return the true key parameters and actuator parameters at an operating point."""
    return {**{name: float(v) for name, v in model.key_parameters(pressure_bar, speed_rpm).items()}, **model.actuators}


def outside_domain(domain: lpv.Domain, name: str, point: Place, where: Location) -> Found:
    """Yield a problem for a pressure or speed outside the domain of a model."""
    for key in ("pressure_bar", "speed_rpm"):
        if key not in domain.variables:
            continue
        value, (low, high) = getattr(point, key), getattr(domain, key)
        if not low <= value <= high:
            text = f"{value:g} lies outside the domain of {name}, {low:g} to {high:g}; choose a value inside"
            yield (*where, key), text


def machine_at(experiment: Experiment, planned: PlannedRecording) -> Machine:
    """Return the rig at the operating point of a recording, before random scatter.

    Raises
    ------
    UsageError
        When the point lies outside the domain of the model, or the rig refuses a value.
    """
    course, point = course_of(experiment, planned), planned.conditions
    if course is not None:
        return _machine_at(experiment, *map(float, course.at(np.array(0.0))))
    return _machine_at(experiment, point["pressure_bar"], point["speed_rpm"])


@lru_cache(maxsize=256)
def _machine_at(experiment: Experiment, pressure_bar: float, speed_rpm: float) -> Machine:
    """Return the rig at a pressure and speed; cached, because each operating point has many recordings."""
    rig = needed(experiment.spec.rig, "rig")
    parameters = _true_parameters(rig_model(experiment), pressure_bar, speed_rpm)
    return Machine.from_parameters(
        parameters,
        _stacks(rig.actuators) if rig.actuators.kind == "stacks" else parameters,
        rig.unbalance,
        rig.sensors,
        rig.clearance_m,
        moving_mass=rig.moving_mass_kg,
        flexible_mode=rig.flexible_mode,
        stiffening=rig.stiffening,
        non_synchronous=rig.non_synchronous,
        process_noise=rig.process_noise,
        effects=tuple(rig_effect(name, **options) for name, options in rig.effects.items()),
        film=_film(rig, pressure_bar, speed_rpm),
    )


def _film(rig: RigSection, pressure_bar: float, speed_rpm: float) -> FilmPoint | None:
    if rig.film is None:
        return None
    return FilmPoint(rig.film, pressure_bar, speed_rpm * RPM, rig.clearance_m, rig.moving_mass_kg)


def course_of(experiment: Experiment, planned: PlannedRecording) -> Course | None:
    """Return the pressure and speed over time of a recording; None at a constant operating point.

    Raises
    ------
    UsageError
        When times and values do not fit each other.
    """
    rig = needed(experiment.spec.rig, "rig")
    if planned.run[:1] != ("course",):
        return None
    section = rig.courses[int(planned.run[1])]
    if section.times_s is not None and section.duration_s is not None:
        raise UsageError(f"course {section.name!r}: give duration_s or times_s, not both")
    end = rig.duration_s if section.duration_s is None else section.duration_s
    if not section.coast_down:
        return Course(section.times_s or (0.0, end), section.pressure_bar, section.speed_rpm)
    speeds = section.speed_rpm
    if section.times_s is not None or not isinstance(speeds, tuple) or len(speeds) != 2:
        raise UsageError(f"course {section.name!r}: coast_down needs duration_s and two numbers for speed_rpm")
    if isinstance(section.pressure_bar, tuple):
        raise UsageError(f"course {section.name!r}: coast_down has one pressure; give one number for pressure_bar")
    return Course.coast_down(end, section.pressure_bar, *speeds)


def rig_experiment(experiment: Experiment, planned: PlannedRecording) -> RigExperiment:
    """Return the run of the rig for a recording.

    Raises
    ------
    UsageError
        When the rig refuses a value.
    """
    rig = needed(experiment.spec.rig, "rig")
    amplitude_m, hold_s = rig.prbs.amplitude_m, rig.prbs.hold_s
    match planned.run:
        case ("prbs",):
            return Prbs(rig.duration_s, amplitude_m, hold_s)
        case ("loop",) if rig.loop is not None:
            return Prbs(rig.duration_s, rig.loop.amplitude_m or amplitude_m, rig.loop.hold_s or hold_s)
        case ("played",) if rig.played is not None:
            return _played(experiment, rig.played.file)
        case ("course", int(i)) if (course := course_of(experiment, planned)) is not None:
            end = course.duration_s
            return ScheduledRun(course, Prbs(end, amplitude_m, hold_s) if rig.courses[i].excited else Stationary(end))
        case ("staircase", ("x" | "y") as axis) if rig.staircase is not None:
            stairs = rig.staircase
            return Staircase(axis, stairs.step_m, stairs.steps, stairs.hold_s)
        case ("stack_staircase", int(stack), bool(controlled)) if rig.stack_staircase is not None:
            return StackStaircase(stack, controlled, rig.stack_staircase.steps, rig.stack_staircase.hold_s)
        case ("hammer", ("x" | "y") as axis) if rig.hammer is not None:
            hammer = rig.hammer
            hits = (Impact.along(axis, time, hammer.peak_n, hammer.impact_s) for time in hammer.times_s)
            return Hammer(tuple(hits), hammer.duration_s)
        case ("run_up",) if rig.run_up is not None:
            return rig.run_up
        case ("impact", ("x" | "y") as axis) if (impacts := experiment.spec.impacts) is not None:
            return hammer_of(impacts, axis, rig.sample_time_s)
        case ("round",) if (cycle := experiment.spec.cycle) is not None:
            duration_s = cycle.duration_s or rig.duration_s
            return Prbs(duration_s, cycle.amplitude_m or amplitude_m, cycle.hold_s or hold_s)
    return Stationary(rig.stationary.duration_s or rig.duration_s)


def hammer_of(section: HammerTrain, axis: str, sample_time: float) -> Hammer:
    """Return the impacts of a recording, at times between samples as with a real hammer."""
    times = [BEFORE_S + section.spacing_s * i + modf(_GOLDEN * i)[0] * sample_time for i in range(section.repeats)]
    impacts = tuple(Impact.along(axis, time, section.peak_n, section.impact_s) for time in times)
    samples = round((BEFORE_S + section.spacing_s * section.repeats) / sample_time)
    return Hammer(impacts, samples * sample_time)


def _played(experiment: Experiment, name: str) -> Played:
    """Return the run that plays the references in a file.

    Raises
    ------
    DataError
        When the file cannot be read.
    UsageError
        When it has no references of both axes.
    """
    file = excite.read_excitation(experiment.folder / name)
    columns = [f"r_{axis}_m" for axis in SIGNALS["r"].channels]
    if missing := [column for column in columns if column not in file.columns]:
        raise UsageError(
            f"{name}: no column {missing[0]}; the rig plays references r, so design the excitation with a fit of "
            "the whole plant (structure: plant)"
        )
    return Played(np.column_stack([file.columns[column] for column in columns]), file.sample_time, name)


def record_options(experiment: Experiment, planned: PlannedRecording) -> dict[str, Any]:
    """Return the arguments of `gbid.rig.record` except machine, experiment and controller."""
    rig, name = needed(experiment.spec.rig, "rig"), planned.name
    faulty = (entry for entry in rig.faults if any(fnmatchcase(name, pattern) for pattern in entry.recordings))
    return {
        "conditions": dict(planned.conditions),
        "seed": rig.seed,
        "name": name,
        "sample_time": rig.sample_time_s,
        "oversampling": rig.oversampling,
        "settle_s": rig.settle_s,
        "scatter": rig.scatter,
        "faults": next(faulty, None),
        "touch_down": rig.touch_down,
        "stacks": rig.actuators.record_stacks,
    }


def clearance_of_rig(
    experiment: Experiment, planned: PlannedRecording
) -> tuple[float, list[tuple[dict[str, float], float]]]:
    """Return the clearance of the rig [m], and its possible machines; see `gbid.rig.possible_machines`."""
    machine, options = machine_at(experiment, planned), record_options(experiment, planned)
    return machine.clearance, possible_machines(machine, planned.conditions, options["scatter"])


@dataclass(frozen=True, eq=False)
class PlannedRun:
    """Arguments of `gbid.rig.record` for one recording, except the controller.

    Attributes
    ----------
    machine : Machine
        The rig at the operating point.
    experiment : Experiment
        What it does.
    options : dict
        Other arguments.
    surfaces : callable or None
        Key parameters over pressure and speed, for a recording along a course.
    """

    machine: Machine
    experiment: RigExperiment
    options: dict[str, Any]
    surfaces: Surfaces | None = None

    def record(self, controller: SampledController | ProgramController | None = None) -> Recording:
        """Return the simulated recording, in closed loop if a controller is given."""
        return record(self.machine, self.experiment, surfaces=self.surfaces, controller=controller, **self.options)

    def settings(self) -> dict[str, Any]:
        """Return all values that enter the content key of the recording."""
        return {
            **self.options,
            "experiment": {type(self.experiment).__name__: self.experiment},
            "machine": self.machine,
        }


def rig_run(experiment: Experiment, planned: PlannedRecording) -> PlannedRun:
    """Return the planned run of the rig for a recording.

    Raises
    ------
    UsageError
        When the point lies outside the domain of the model, or the rig refuses a value.
    """
    model, run = rig_model(experiment), rig_experiment(experiment, planned)
    surfaces = model.key_parameters if isinstance(run, ScheduledRun) else None
    return PlannedRun(machine_at(experiment, planned), run, record_options(experiment, planned), surfaces)


def _stacks(section: ActuatorSection) -> PiezoStacks:
    base = [
        replace(
            stack,
            slow_pole=stack.slow_pole * section.slow_pole_factors[axis],
            fast_pole=stack.fast_pole * section.fast_pole_factors[axis],
            hysteresis=section.hysteresis_m,
            creep=section.creep,
            creep_times=section.creep_times_s,
        )
        for stack, axis in zip(PiezoStacks().stacks, np.abs(ALLOCATION).argmax(axis=1), strict=True)
    ]
    return replace(PiezoStacks.unequal(section.spread, section.seed, base), offset=section.offset_m)


# ---- True values of the parameters of a fit, for recordings of the rig.


def true_values(experiment: Experiment, recordings: Sequence[str], structure: AnyStructure) -> dict[str, float]:
    """Return the true values of the parameters of a structure for recordings of the rig.

    The true values are known for built-in structures and recordings of the rig at one operating point.

    Parameters
    ----------
    experiment : Experiment
        The experiment.
    recordings : sequence of str
        Names of the recordings of a fit.
    structure : Structure
        Structure of the fit.

    Returns
    -------
    dict of str to float
        True values by parameter, in the units of the structure; empty when none are known.
    """
    planned = [experiment.recordings[name] for name in recordings]
    points = {tuple(sorted(q.conditions.items())) for q in planned}
    if points != {tuple(sorted(planned[0].conditions.items()))} or "speed_rpm" not in planned[0].conditions:
        return {}  # several operating points, or none, as along a course
    if any(q.imported for q in planned) or not isinstance(kind_of(structure).plant, RotorBearing | PiezoPair | Plant):
        return {}
    rig = needed(experiment.spec.rig, "rig")
    if rig.film is not None:
        return {}
    film = rig.stiffening
    known = {**_as_drawn(experiment, planned), STIFFENING: film.inverse_square_length if film else 0.0}
    return {q.name: known[q.name] for q in structure.parameters if q.name in known}


def _as_drawn(experiment: Experiment, planned: Sequence[PlannedRecording]) -> dict[str, float]:
    """Return the true values common to all recordings: without scattered parameters, and without stack parameters."""
    rig = needed(experiment.spec.rig, "rig")
    conditions = planned[0].conditions
    known = _true_parameters(rig_model(experiment), conditions["pressure_bar"], conditions["speed_rpm"])
    if rig.actuators.kind == "stacks":
        known = {name: value for name, value in known.items() if name in KEY_PARAMETERS}
    if rig.scatter is None:
        return known
    if len({q.name for q in planned}) > 1:
        return {name: value for name, value in known.items() if name not in KEY_PARAMETERS}
    truth = RotorBearingTruth.from_parameters(known)
    drawn, _ = scattered_bearing(truth, rig.scatter, rig.seed, planned[0].name, conditions)
    return {**known, **drawn.key_parameters()}


def true_model(structure: AnyStructure, truth: dict[str, float], like: LinearModel) -> LinearModel | None:
    """Return the structure at its true values with zero disturbance gains; None if some values are unknown."""
    values = {q.name: 0.0 for q in structure.parameters if q.name.startswith("bd")} | truth
    linear = kind_of(structure).linear
    if linear is None or not truth or any(q.name not in values for q in structure.parameters):
        return None
    return evaluate(linear, values, like.input_names, like.output_names)
