"""Checks of the rig section."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from gbid.errors import GbidError, UsageError
from gbid.experiment.experiment import Check, Experiment
from gbid.experiment.problems import Found, Location, nearest
from gbid.experiment.stages.rig.model import rig_model
from gbid.experiment.stages.rig.plan import faults_of, machine_at, rig_experiment
from gbid.experiment.stages.rig.schema import RigSection
from gbid.operating_point import point_label
from gbid.rig import Machine, rig_effect, rig_effects
from gbid.rig.excitation.prbs import whole_samples


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
    inside = True
    for i, point in enumerate(rig.operating_points):
        for key in ("pressure_bar", "speed_rpm"):
            value, (low, high) = getattr(point, key), getattr(model.domain, key)
            if not low <= value <= high:
                inside = False
                yield (
                    ("rig", "operating_points", i, key),
                    f"{value:g} lies outside the domain of {model.name}, {low:g} to {high:g}; choose a value inside",
                )
    for i, course in enumerate(rig.courses):
        for key in ("pressure_bar", "speed_rpm"):
            values, (low, high) = np.atleast_1d(getattr(course, key)), getattr(model.domain, key)
            if values.min() < low or values.max() > high:
                inside = False
                yield (
                    ("rig", "courses", i, key),
                    f"leaves the domain of {model.name}, {low:g} to {high:g}; choose values inside",
                )
    for location, seconds in _times(rig):
        try:
            whole_samples(str(location[-1]), seconds, rig.sample_time_s)
        except UsageError as error:
            yield location, str(error)
    inside = inside and not list(effects_are_known(experiment))  # else the machine cannot be made
    reported: set[str] = set()
    for planned in experiment.recordings.values():
        if inside and planned.imported is None:
            try:
                machine = machine_at(experiment, planned, model)
                if not planned.in_loop:
                    _check_held(experiment, machine)
                rig_experiment(experiment, planned)
            except GbidError as error:
                if str(error) not in reported:
                    yield ("rig",), str(error)
                reported.add(str(error))


def _check_held(experiment: Experiment, machine: Machine) -> None:
    """Refuse a recording without controller of an unstable rotor.

    Raises
    ------
    UsageError
        With what to do.
    """
    rig = experiment.spec.rig
    assert rig is not None
    try:
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
        try:
            faults_of(entry)
        except UsageError as error:
            yield here, str(error)


def effects_are_known(experiment: Experiment) -> Found:
    """Yield a problem for each effect that is unknown or has a wrong option."""
    rig = experiment.spec.rig
    for name, options in rig.effects.items() if rig else ():
        if name not in rig_effects():
            yield ("rig", "effects", name), f"no effect {name!r}; {nearest(name, rig_effects())}"
            continue
        try:
            rig_effect(name, **options)
        except UsageError as error:
            yield ("rig", "effects", name), str(error)


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
