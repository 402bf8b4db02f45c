"""Simulation of one recording as the data logger of the rig stores it, with provenance and faults."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal

import numpy as np

from gbid.core.arrays import FloatArray
from gbid.core.errors import DataError, UsageError
from gbid.core.option_types import Finite, NotNegative, Positive, check_options
from gbid.core.units import SIGNALS
from gbid.recording import Recording
from gbid.rig.excitation import (
    RPM,
    Hammer,
    Played,
    Prbs,
    RunUp,
    ScheduledRun,
    StackStaircase,
    Staircase,
    Stationary,
    Turning,
    whole_samples,
)
from gbid.rig.machine import ActuatorTruth, Machine, RigRun, RotorBearingTruth, Scatter, scatter_random, scattered
from gbid.rig.response import MIN_OVERSAMPLING, Forces, draw_noise, draw_whirl, driven_motion, unbalance_orbit
from gbid.rig.sensors import TURN as TURN_SENSORS
from gbid.rig.sensors import ProgramController, SampledController, encoder_angle, quantised, runout
from gbid.rig.stepping import AlongCourse, ProgramLoop, SteppedMotion, Surfaces, stepped_motion

# ---- Parts of a recording of the rig: its machine, its rotation, its additional effects, and its control program.


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
    for effect, generator in zip(machine.effects, random, strict=True):
        run = RigRun(time, turning.angle(time), turning.speed_at(time), conditions, generator)
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
    """Return the control program with angle, speed and pressure at the samples; None for another controller."""
    if not isinstance(controller, ProgramController):
        return None
    speed_rpm = turning.speed_at(time) / RPM
    return ProgramLoop(controller.program, shown, speed_rpm, pressure_bar)


# ---- Provenance of a rig recording: how it was made, written as texts and read back.

Span = tuple[float, float]


def provenance_of(
    machine: Machine,
    experiment: Any,
    *,
    seed: int,
    how: str,
    oversampling: int,
    settle_s: float,
    controller: SampledController | ProgramController | None,
    scatter: Scatter | None,
    thrown: int,
    touched: Sequence[Span],
    saturated: Mapping[str, Sequence[Span]],
    constant: bool,
) -> dict[str, str]:
    """Return the texts that are stored with a recording; values are JSON."""
    effects = {"effects": {effect.name: asdict(effect) for effect in machine.effects}} if machine.effects else {}
    rig = {key: value for key, value in asdict(machine).items() if key != "effects"}
    texts = {
        "source": "gbid virtual rig",
        "seed": str(seed),
        "simulation": how,
        "experiment": as_json({type(experiment).__name__: asdict(experiment)}),
        "rig": as_json({"oversampling": oversampling, "settle_s": settle_s, **rig, **effects}),
    }
    if constant:  # along a course there is no one truth
        texts["truth"] = as_json(machine.rotor_bearing.key_parameters())
    if controller is not None:
        texts["controller"] = as_json(
            asdict(controller)
            if isinstance(controller, SampledController)
            else {"program": controller.name, "sample_time": controller.sample_time}
        )
    if scatter is not None:
        texts["scatter"] = as_json({**asdict(scatter), "draws_thrown_away": thrown})
    if touched:
        texts["touch_down"] = as_json(touched)
    if saturated:
        texts["saturated"] = as_json(saturated)
    return texts


def spans(time: FloatArray, inside: np.ndarray, sample_time: float) -> list[Span]:
    """Return the time intervals (first, end) [s] of consecutive samples that are marked as inside."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], inside.astype(int), [0]])))
    return [(float(time[a]), float(time[b - 1] + sample_time)) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def touch_downs(recording: Recording) -> list[Span]:
    """Return the time intervals (first, end) [s] in which the disc touched the bearing; empty when it never did.

    Parameters
    ----------
    recording : Recording
        Recording of the rig.
    """
    return [(float(a), float(b)) for a, b in json.loads(recording.provenance.get("touch_down", "[]"))]


def saturations(recording: Recording) -> dict[str, list[Span]]:
    """Return the time intervals (first, end) [s] in which a stack was saturated, by the number of the stack.

    Parameters
    ----------
    recording : Recording
        Recording of the rig.
    """
    stored = json.loads(recording.provenance.get("saturated", "{}"))
    return {stack: [(float(a), float(b)) for a, b in times] for stack, times in stored.items()}


def drawn_truth(recording: Recording) -> dict[str, float]:
    """Return the fourteen true key parameters of a recording by name; empty when the recording does not store them.

    Parameters
    ----------
    recording : Recording
        Recording of the rig.
    """
    return {name: float(v) for name, v in json.loads(recording.provenance.get("truth", "{}")).items()}


def as_json(value: Any) -> str:
    """Return values and arrays as one line of JSON with sorted keys."""
    return json.dumps(value, default=lambda array: np.asarray(array).tolist(), sort_keys=True)


# ---- Faults of the measuring chain that are put into recordings on purpose, to test whether they are detected.

TURN = 2 * np.pi


@dataclass(frozen=True)
class Faults:
    """Faults of a recording; by default there are none.

    Parameters
    ----------
    swapped : tuple of str
        Signals whose channels x and y are exchanged, e.g. ``("p",)``.
    dead : dict of str to float
        Channels (``"p.x"``) that stay at a constant value [unit of the signal].
    saturation : dict of str to float
        Channels (``"p.x"``) that are limited to plus and minus a value [unit of the signal].
    spikes_per_s : float
        Mean number per second of single wrong samples of p, at random times in x or y.
    spike_size_m : float
        Deviation of these samples [m], with random sign.
    sample_time_factor : float
        Ratio of the sample time stated in the file to the true one.
    missing_index : bool
        Whether the encoder has lost its index. Then phi has a constant error, different in each recording.
    rub_clearance_m : float or None
        Smaller clearance at which the disc touches [m]. The recording is kept.

    Raises
    ------
    UsageError
        When a channel is not written as ``signal.channel``, or when a value is not allowed.
    """

    swapped: tuple[str, ...] = ()
    dead: Mapping[str, Finite] = field(default_factory=dict)
    saturation: Mapping[str, Positive] = field(default_factory=dict)
    spikes_per_s: NotNegative = 0.0
    spike_size_m: Positive = 20e-6
    sample_time_factor: Positive = 1.0
    missing_index: bool = False
    rub_clearance_m: Positive | None = None

    def __post_init__(self) -> None:
        check_options(self, "faults")
        for channel in (*self.dead, *self.saturation):
            if channel.count(".") != 1:
                raise UsageError(f"faults: no channel {channel}; write signal.channel")


def with_faults(recording: Recording, faults: Faults, random: np.random.Generator) -> Recording:
    """Return a recording with faults of sensors and logger; its provenance lists them.

    Raises
    ------
    UsageError
        When the recording has no such signal or channel.
    """
    signals = {name: np.array(values) for name, values in recording.signals.items()}

    def column(channel: str) -> np.ndarray:
        name, _, which = channel.partition(".")
        if name not in signals or which not in recording.channels[name]:
            raise UsageError(f"faults: recording {recording.name!r} has no channel {channel}")
        return np.asarray(signals[name][:, recording.channels[name].index(which)])

    applied = []
    for channel, limit in faults.saturation.items():
        column(channel)[:] = np.clip(column(channel), -abs(limit), abs(limit))
        applied.append(f"{channel} saturated at {abs(limit):g}")
    if faults.spikes_per_s:
        p, dt = signals["p"], recording.sample_time
        hit = random.random(p.shape) < 0.5 * faults.spikes_per_s * dt
        p[hit] += faults.spike_size_m * random.choice([-1.0, 1.0], size=int(hit.sum()))
        applied.append(f"{int(hit.sum())} spikes of {faults.spike_size_m:g} m in p")
    for channel, value in faults.dead.items():
        column(channel)[:] = value
        applied.append(f"{channel} dead at {value:g}")
    if faults.missing_index and "phi" in signals:
        counts = random.integers(0, 4096)
        signals["phi"] = np.mod(signals["phi"] + counts * (TURN / 4096), TURN)
        applied.append("encoder index missing")
    for name in faults.swapped:
        if name not in signals or signals[name].shape[1] != 2:
            raise UsageError(f"faults: recording {recording.name!r} has no signal {name} with two channels to swap")
        signals[name] = signals[name][:, ::-1]
        applied.append(f"x and y of {name} swapped")
    if faults.sample_time_factor != 1.0:
        applied.append(f"sample time stated {faults.sample_time_factor:g} times too long")
    if not applied:
        return recording
    return replace(
        recording,
        signals=signals,
        sample_time=recording.sample_time * faults.sample_time_factor,
        provenance={**recording.provenance, "faults": "; ".join(applied)},
    )


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
    if faults is not None and faults.rub_clearance_m is not None:
        machine, touch_down = replace(machine, clearance=faults.rub_clearance_m), "flag"
    if controller is not None and abs(controller.sample_time - sample_time) > 1e-9 * sample_time:
        raise UsageError(f"controller: sample_time = {controller.sample_time} s, the rig samples at {sample_time} s")
    n_samples = whole_samples("duration_s", experiment.duration_s, sample_time)
    n_settle = whole_samples("settle_s", settle_s, sample_time) if settle_s else 0
    n = n_settle + n_samples
    root = np.random.SeedSequence(seed, spawn_key=tuple(name.encode()))
    levels, start, noise_u, noise_p, process, whirl, noise_f, broken, *of_effects = (
        np.random.default_rng(child) for child in root.spawn(8 + len(machine.effects))
    )
    first = start.uniform(0.0, TURN_SENSORS)  # angle when the simulation begins
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
    sensor = runout(sensors, angle) + sensors.offset_p_m + readings[:-1]
    sensor[logged] += np.asarray(sensors.noise_p_m) * noise_p.standard_normal((n_samples, 2))
    # The probes have noise before the logger starts, too. It matters only for a controller.
    sensor[:n_settle] += np.asarray(sensors.noise_p_m) * noise_p.standard_normal((n_settle, 2))

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
        )
    if touch_down == "refuse":
        _check_clearance(name, time, motion.radius, machine.clearance)

    signals = {
        "r": motion.r[logged],
        "u": quantised(
            motion.u[logged]
            + sensors.offset_u_m
            + np.asarray(sensors.noise_u_m) * noise_u.standard_normal((n_samples, 2)),
            sensors.resolution_u_m,
        ),
        "p": motion.seen[logged],
        "phi": shown[logged, None],
    }
    if controller is not None:
        signals["w"] = run.reference[logged]
    if isinstance(experiment, Hammer):
        force = experiment.force(time[logged])
        signals["f"] = force + sensors.noise_f_n * noise_f.standard_normal((n_samples, 2))
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
    seen = quantised(p + sensor, machine.sensors.resolution_p_m)
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
