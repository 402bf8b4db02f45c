"""Controller of the rig's recordings in closed loop, as it runs."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np

from gbid.arrays import FloatArray
from gbid.control import ControllerDesign, close_loop, exact_plant, sample_plant
from gbid.errors import UsageError
from gbid.experiment.experiment import Experiment
from gbid.experiment.plan import PlannedRecording
from gbid.experiment.stages.impact.loop_program import loop_of
from gbid.experiment.stages.impact.plan import LoopController
from gbid.experiment.stages.loop.plan import at_point, found_controller, stationary_at
from gbid.experiment.stages.loop.schema import RigLoopSection
from gbid.experiment.stages.prefilter.stage import identified_map
from gbid.experiment.stages.rig.model import rig_model
from gbid.experiment.stages.rig.plan import machine_at, record_options, rig_experiment
from gbid.experiment.stages.rig.schema import RigSection
from gbid.operating_point import point_label
from gbid.prefilter import RunoutMap, identify_runout
from gbid.rig import Machine, ProgramController, SampledController, record
from gbid.structure import LinearModel

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
    found = found_controller(experiment, section)
    if found.structure is not None:
        names = [gain.name for gain in found.structure.parameters if gain.name not in section.gains]
        raise UsageError(f"controller {found.name!r}: no value for {', '.join(names)}; the rig needs all gains")
    design = found.design
    if design is None:
        model = found.model
        assert model is not None
        design = ControllerDesign(found.name, None, {}, model.dt or rig.sample_time_s, models={None: model})
    continuous = design.at(*at_point(design, dict(planned.conditions)))
    if continuous.D.shape != (2, 2):
        raise UsageError(f"controller {found.name!r} has not two inputs and two outputs, the axes x and y of the rig")
    if abs(design.sample_time - rig.sample_time_s) > 1e-9 * rig.sample_time_s:
        raise UsageError(
            f"controller {found.name!r}: sample time is {design.sample_time:g} s, that of the rig "
            f"{rig.sample_time_s:g} s; make it for that"
        )
    sampled = (
        continuous if continuous.dt is not None else design.sampled_at(*at_point(design, dict(planned.conditions)))
    )
    if rig.controller == "compiled" and continuous.dt is not None:
        raise UsageError(f"controller {found.name!r} is sampled; the control chain in C needs a continuous one")
    return LoopController(continuous, sampled, design, "")


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
    experiment: Experiment, planned: PlannedRecording, machine: Machine, options: dict[str, Any]
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
        made = loop_of(experiment, controller, machine, options)
        if isinstance(made, ProgramController) or not planned.conditions["speed_rpm"]:
            return made  # a program has a map of its own, and at rest the position does not follow the angle
        runout_map = _map_at_rest(experiment, planned.point)
        nodes: FloatArray = np.asarray(np.arange(_BINS) * (2 * np.pi / _BINS), np.float64)
        return replace(made, runout=runout_map.evaluate(nodes) - runout_map.mean, offset=runout_map.mean)
    A, B, C, D = (np.array(getattr(controller.sampled, letter)) for letter in "ABCD")
    name = controller.sampled.name
    return SampledController(A, B, C, D, rig.sample_time_s, offset=machine.sensors.offset_p, name=name)


@lru_cache(maxsize=16)
def _map_at_rest(experiment: Experiment, point: str) -> RunoutMap:
    """Return the run-out map of the stationary recordings at an operating point, which are made again, bit for bit."""
    still = []
    for planned in stationary_at(experiment, point):
        machine = machine_at(experiment, planned, rig_model(experiment))
        run = rig_experiment(experiment, planned)
        still.append(record(machine, run, **record_options(experiment, planned)))
    section = experiment.spec.prefilter
    if section is None or section.method == "none":
        return identify_runout(still)
    return identified_map(still, section)[0]


def _sections(experiment: Experiment) -> tuple[RigSection, RigLoopSection]:
    rig = experiment.spec.rig
    assert rig is not None
    assert rig.loop is not None
    return rig, rig.loop
