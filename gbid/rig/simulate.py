"""Simulation of one recording, as the data logger of the real rig would store it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from gbid.arrays import FloatArray
from gbid.errors import DataError, UsageError
from gbid.recording import Recording
from gbid.rig.excitation.hammer import Hammer
from gbid.rig.excitation.played import Played
from gbid.rig.excitation.prbs import Prbs, Stationary, whole_samples
from gbid.rig.excitation.run_up import RunUp
from gbid.rig.excitation.scheduled_run import ScheduledRun
from gbid.rig.excitation.staircase import StackStaircase, Staircase
from gbid.rig.faults import Faults, with_faults
from gbid.rig.machine.controller import ProgramController, SampledController
from gbid.rig.machine.machine import ActuatorTruth, Machine
from gbid.rig.machine.scatter import Scatter
from gbid.rig.machine.sensors import TURN, encoder_angle, quantised, runout
from gbid.rig.provenance import provenance_of, spans
from gbid.rig.run_parts import along_course, effects_of, machine_this_time, program_loop, rotation
from gbid.rig.stepping.along_course import AlongCourse, Surfaces
from gbid.rig.stepping.forces import Forces, draw_noise, draw_whirl
from gbid.rig.stepping.response import MIN_OVERSAMPLING, driven_motion, unbalance_orbit
from gbid.rig.stepping.stepped_motion import RigEngine, SteppedMotion, stepped_motion
from gbid.units import SIGNALS

Experiment = Stationary | Prbs | Played | Staircase | StackStaircase | Hammer | RunUp | ScheduledRun
Simulation = Literal["auto", "exact", "stepping"]
WhenTouching = Literal["refuse", "flag"]


def record(
    machine: Machine,
    experiment: Experiment,
    *,
    conditions: Mapping[str, float],
    seed: int,
    name: str,
    sample_time: float = 2e-4,
    oversampling: int = MIN_OVERSAMPLING,
    settle_s: float = 0.5,
    controller: SampledController | ProgramController | None = None,
    scatter: Scatter | None = None,
    faults: Faults | None = None,
    touch_down: WhenTouching = "refuse",
    stacks: bool = False,
    surfaces: Surfaces | None = None,
    simulation: Simulation = "auto",
    engine: RigEngine = "auto",
) -> Recording:
    """Return one simulated recording (paper, Secs. 2, 3.1, 3.4, 3.5 and 5.1).

    The experiment runs for `settle_s` before the logger starts, so the recording begins in motion. The initial shaft
    angle differs from recording to recording. When all parts of the machine are linear and there is no control loop,
    the motion is computed in closed form (`gbid.rig.driven_motion`). Otherwise it is computed by time stepping
    (`gbid.rig.stepped_motion`).

    Parameters
    ----------
    machine : Machine
        The rig, with its parameters at the operating point.
    experiment : Stationary, Prbs, Played, Staircase, StackStaircase, Hammer, RunUp or ScheduledRun
        References, impacts, rotation and length of the recording.
    conditions : dict of str to float
        The operating point. ``speed_rpm`` is required and sets the speed of the shaft, except in a run-up. Along a
        course, leave out what changes. All entries are stored.
    seed : int
        Seed, at least zero. The same seed and name give the same recording, bit for bit.
    name : str
        Name of the recording. Recordings with one seed and different names are independent: they have different
        sequences, noise and initial angles.
    sample_time : float
        Time between samples [s].
    oversampling : int
        Points per sample, at least 20: output points of the closed form, or time steps.
    settle_s : float
        Time of the experiment before the first sample [s], a whole number of samples or zero.
    controller : SampledController or ProgramController, optional
        Closes the loop from the measured p to r, from the start of the settling time.
    scatter : Scatter, optional
        Draws random parameters of rotor and bearing for this recording. They are stored in the provenance.
    faults : Faults, optional
        Faults of the measuring chain.
    touch_down : {"refuse", "flag"}
        What to do when the disc reaches the clearance. ``"refuse"`` raises an error. ``"flag"`` simulates the contact
        (`Machine.contact`) and stores the times in the provenance (`gbid.rig.touch_downs`).
    stacks : bool
        Whether to record the positions y_p, references r_p and voltages v of the stacks as well. A `StackStaircase`
        always records them.
    surfaces : callable, optional
        True surfaces for a `ScheduledRun`: the key parameters by name for arrays of pressures [bar] and speeds [rpm],
        such as ``model.key_parameters`` of a `gbid.LPVModel`. They replace the rotor and bearing of the machine.
    simulation : {"auto", "exact", "stepping"}
        Method. ``"stepping"`` is also possible where the closed form exists.
    engine : {"auto", "compiled", "python"}
        Program that computes the time steps.

    Returns
    -------
    Recording
        Signals r (as applied: excitation plus controller, limited to the travel), u (piezo position, offset and
        noise), p (disc position, run-out, offset and noise) [m], phi (encoder, within [0, 2 pi)) [rad]; in a
        `Hammer` test f (measured force, x and y) [N]; with a controller w (excitation that is added to its output) [m];
        in a `ScheduledRun` pressure_bar and speed_rpm; with `stacks` y_p, r_p [m] and v [V] of the stacks 1 to 4.
        Provenance: ``rig`` (all parameters), ``truth`` (the fourteen key parameters as drawn; not along a course),
        ``simulation``, and where they occurred ``touch_down`` and ``saturated`` (time intervals).

    Raises
    ------
    UsageError
        When an argument is wrong, or when the rotor is unstable and there is no controller.
    DataError
        When the disc reaches the clearance of the bearing and `touch_down` is ``"refuse"``.
    """
    if seed < 0 or not name:
        raise UsageError(f"seed = {seed}, name = {name!r}; give a seed of at least zero and a name")
    if touch_down not in ("refuse", "flag"):
        raise UsageError(f"touch_down = {touch_down!r}; choose 'refuse' or 'flag'")
    scheduled = isinstance(experiment, ScheduledRun)
    if scheduled != (surfaces is not None):
        raise UsageError("surfaces are for a ScheduledRun, and it needs them: give surfaces=model.key_parameters")
    turning = rotation(experiment, conditions)
    if faults is not None and faults.rub_clearance is not None:
        machine, touch_down = replace(machine, clearance=faults.rub_clearance), "flag"
    if controller is not None and abs(controller.sample_time - sample_time) > 1e-9 * sample_time:
        raise UsageError(f"controller: sample_time = {controller.sample_time} s, the rig samples at {sample_time} s")
    n_samples = whole_samples("duration_s", experiment.duration_s, sample_time)
    n_settle = whole_samples("settle_s", settle_s, sample_time) if settle_s else 0
    n = n_settle + n_samples
    root = np.random.SeedSequence(seed, spawn_key=tuple(name.encode()))
    levels, start, noise_u, noise_p, process, whirl, noise_f, broken, *of_effects = (
        np.random.default_rng(child) for child in root.spawn(8 + len(machine.effects))
    )
    first = start.uniform(0.0, TURN)  # angle when the simulation begins
    turning = replace(turning, start=first + turning.speed * n_settle * sample_time)
    times: FloatArray = np.asarray((np.arange(n + 1) - n_settle) * sample_time, np.float64)
    along: AlongCourse | None = None
    if isinstance(experiment, ScheduledRun) and surfaces is not None:
        machine, along, thrown = along_course(machine, experiment, surfaces, times[:-1], scatter, seed, name)
        pressure, speed_rpm = experiment.course.at(times[:-1])
    else:
        machine, thrown = machine_this_time(machine, scatter, seed, name, conditions)
        pressure = np.full(n, conditions.get("pressure_bar", 0.0))
    if controller is None:
        machine.rotor_bearing.check_stable()
    forces, readings = effects_of(machine, turning, times, conditions, of_effects)
    run = _Run(
        machine,
        experiment.reference(n, sample_time, levels, n_settle),
        Forces(
            machine,
            turning,
            sample_time,
            n_settle,
            draw_noise(machine, n, sample_time, process),
            draw_whirl(machine, n, sample_time, whirl),
            experiment if isinstance(experiment, Hammer) else None,
            forces,
        ),
        n_settle,
        oversampling,
    )
    time = times[:-1]
    angle = turning.angle(time)
    sensors = machine.sensors
    shown = encoder_angle(sensors, angle)
    logged = slice(n_settle, None)
    sensor = runout(sensors, angle) + sensors.offset_p + readings[:-1]
    sensor[logged] += np.asarray(sensors.noise_p) * noise_p.standard_normal((n_samples, 2))
    # The probes have noise before the logger starts, too. It matters only for a controller.
    sensor[:n_settle] += np.asarray(sensors.noise_p) * noise_p.standard_normal((n_settle, 2))

    reasons = _reasons_to_step(machine, experiment, controller)
    if simulation == "exact" and reasons:
        raise UsageError(f"simulation = 'exact': no closed form with {', '.join(reasons)}")
    stepping = bool(reasons) or simulation == "stepping"
    motion = None if stepping else _in_closed_form(run, sensor)
    touches = motion is not None and (motion.radius >= machine.clearance).any()
    if motion is None or (touches and touch_down == "flag"):
        motion = stepped_motion(
            machine,
            run.reference,
            run.forces,
            sensor,
            sample_time,
            controller=controller if isinstance(controller, SampledController) else None,
            taken=controller.subtracted(shown) if isinstance(controller, SampledController) else None,
            program=program_loop(controller, turning, time, shown, pressure),
            along=along,
            stack_run=experiment if isinstance(experiment, StackStaircase) else None,
            n_settle=n_settle,
            oversampling=oversampling,
            wall=touch_down == "flag",
            engine=engine,
        )
    if touch_down == "refuse":
        _check_clearance(name, time, motion.radius, machine.clearance)

    signals = {
        "r": motion.r[logged],
        "u": quantised(
            motion.u[logged] + sensors.offset_u + np.asarray(sensors.noise_u) * noise_u.standard_normal((n_samples, 2)),
            sensors.resolution_u,
        ),
        "p": motion.seen[logged],
        "phi": shown[logged, None],
    }
    if controller is not None:
        signals["w"] = run.reference[logged]
    if isinstance(experiment, Hammer):
        force = experiment.force(time[logged])
        signals["f"] = force + sensors.noise_f * noise_f.standard_normal((n_samples, 2))
    if along is not None:
        signals |= {"pressure_bar": pressure[logged, None], "speed_rpm": speed_rpm[logged, None]}
    if stacks or isinstance(experiment, StackStaircase):
        if isinstance(machine.actuator, ActuatorTruth):
            raise UsageError("stacks: this machine has linear actuators; give it PiezoStacks")
        signals |= {"y_p": motion.stacks[logged], "v": motion.volts[logged]}
        signals["r_p"] = _stack_references(experiment, motion.commands[logged])
    touched = spans(time[logged], motion.radius[logged] >= machine.clearance, sample_time)
    ended = {str(i + 1): spans(time[logged], motion.ended[logged, i] > 0, sample_time) for i in range(4)}
    recording = Recording(
        signals,
        sample_time,
        conditions=conditions,
        name=name,
        units={signal: SIGNALS[signal].unit for signal in signals},
        provenance=provenance_of(
            machine,
            experiment,
            seed=seed,
            how=motion.how,
            oversampling=oversampling,
            settle_s=settle_s,
            controller=controller,
            scatter=scatter,
            thrown=thrown,
            touched=touched,
            saturated={stack: times for stack, times in ended.items() if times},
            constant=along is None,
        ),
    )
    return recording if faults is None else with_faults(recording, faults, broken)


@dataclass(frozen=True, eq=False)
class _Run:
    """Input of a simulation: machine, references from the start of the settling time, and forces."""

    machine: Machine
    reference: FloatArray
    forces: Forces
    n_settle: int
    oversampling: int


def _reasons_to_step(
    machine: Machine, experiment: Experiment, controller: SampledController | ProgramController | None
) -> list[str]:
    """Return the names of the parts that have no closed form."""
    reasons = machine.beyond_closed_form()
    if isinstance(experiment, Hammer | RunUp | ScheduledRun | StackStaircase):
        reasons.append(type(experiment).__name__)
    if controller is not None:
        reasons.append("a controller")
    return reasons


def _in_closed_form(run: _Run, sensor: FloatArray) -> SteppedMotion:
    """Return the exact motion of a linear machine in open loop at constant speed."""
    machine, turning, over = run.machine, run.forces.turning, run.oversampling
    assert isinstance(machine.actuator, ActuatorTruth)
    sample_time = run.forces.sample_time
    driven = driven_motion(machine.rotor_bearing, machine.actuator, run.reference, sample_time, over)
    angle = turning.angle(driven.time - run.n_settle * sample_time)
    disc = driven.p + unbalance_orbit(machine.rotor_bearing, machine.unbalance, turning.speed, angle)
    radius = np.hypot(disc[:, 0], disc[:, 1]).reshape(-1, over).max(axis=1)
    p, none = disc[::over], np.zeros((len(run.reference), 4))
    seen = quantised(p + sensor, machine.sensors.resolution_p)
    return SteppedMotion(
        run.reference, driven.u[::over], p, seen, none, none, none, none, radius, "closed form, exact delays"
    )


def _stack_references(experiment: Experiment, command: FloatArray) -> FloatArray:
    """Return the references of the stacks [m]; zero for a stack in open loop."""
    if isinstance(experiment, StackStaircase) and not experiment.controlled:
        command = command.copy()
        command[:, experiment.stack - 1] = 0.0
    return command


def _check_clearance(name: str, time: FloatArray, radius: FloatArray, clearance: float) -> None:
    """Refuse a recording in which the disc reaches the clearance."""
    worst = int(radius.argmax())
    if not radius[worst] < clearance:
        raise DataError(
            f"recording {name!r}: the disc moves {radius[worst] * 1e6:.1f} um at {time[worst]:.4f} s and "
            f"reaches the clearance of {clearance * 1e6:.1f} um; lower the amplitude or lengthen the hold, or "
            "simulate the contact (touch_down: flag)"
        )
