"""Simulation of one recording as the data logger of the rig stores it, with provenance and faults."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal

import numpy as np

from gbid.core.arrays import FloatArray
from gbid.core.errors import DataError, UsageError
from gbid.core.option_types import CountOrZero, Finite, NotNegative, Number, Positive, check_options, takes_options
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
from gbid.rig.machine import ActuatorTruth, Machine, RigRun, RotorBearingTruth, Scatter, scattered_bearing
from gbid.rig.response import MIN_OVERSAMPLING, Forces, draw_noise, draw_whirl, driven_motion, unbalance_orbit
from gbid.rig.sensors import TURN, ProgramController, SampledController, encoder_angle, quantised, runout
from gbid.rig.stepping import ProgramLoop, SteppedMotion, Surfaces, stepped_motion, truths_along

# ---- Faults of the measuring chain, added to recordings to test their detection.


@dataclass(frozen=True)
class Faults:
    """Faults of a recording; none by default.

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


# ---- Simulation of a recording.

Experiment = Stationary | Prbs | Played | Staircase | StackStaircase | Hammer | RunUp | ScheduledRun


@dataclass(frozen=True, kw_only=True)
class RecordOptions:
    """Arguments of `record` other than machine and experiment.

    Attributes
    ----------
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
    """

    conditions: Mapping[str, Number]
    seed: CountOrZero
    name: str
    sample_time: Positive = 2e-4
    oversampling: int = MIN_OVERSAMPLING
    settle_s: NotNegative = 0.5
    controller: SampledController | ProgramController | None = None
    scatter: Scatter | None = None
    faults: Faults | None = None
    touch_down: Literal["refuse", "flag"] = "refuse"
    stacks: bool = False
    surfaces: Surfaces | None = None
    simulation: Literal["auto", "exact", "stepping"] = "auto"

    def __post_init__(self) -> None:
        check_options(self)
        if not self.name:
            raise UsageError("name = ''; give the recording a name", "name")
        if (
            self.controller is not None
            and abs(self.controller.sample_time - self.sample_time) > 1e-9 * self.sample_time
        ):
            raise UsageError(
                f"controller: sample_time = {self.controller.sample_time} s, the rig samples at {self.sample_time} s"
            )


@dataclass(frozen=True, eq=False)
class _Run:
    """Recording before its simulation: random machine, references, forces and rotation.

    Samples count from the start of the settling time; `logged` are those of the recording.
    """

    machine: Machine
    experiment: Experiment
    options: RecordOptions
    reference: FloatArray
    forces: Forces
    time: FloatArray
    pressure_bar: FloatArray
    speed_rpm: FloatArray
    along: tuple[RotorBearingTruth, ...]
    rejected: int

    @property
    def logged(self) -> slice:
        return slice(self.forces.n_settle, None)


@takes_options(RecordOptions)
def record(machine: Machine, experiment: Experiment, options: RecordOptions) -> Recording:
    """Return one simulated recording (paper, Secs. 2, 3.1, 3.4, 3.5 and 5.1).

    The experiment runs for `settle_s` before the logger starts, so the recording begins in motion. The initial shaft
    angle differs from recording to recording. When all parts of the machine are linear and there is no control loop,
    the motion is computed in closed form (`driven_motion`). Otherwise it is computed by time stepping
    (`stepped_motion`).

    Parameters
    ----------
    machine : Machine
        The rig, with its parameters at the operating point.
    experiment : Stationary, Prbs, Played, Staircase, StackStaircase, Hammer, RunUp or ScheduledRun
        References, impacts, rotation and length of the recording.
    **options

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
    faults, sample_time = options.faults, options.sample_time
    if faults is not None and faults.rub_clearance_m is not None:
        machine, options = replace(machine, clearance=faults.rub_clearance_m), replace(options, touch_down="flag")
    root = np.random.SeedSequence(options.seed, spawn_key=tuple(options.name.encode()))
    levels, start, noise_u, noise_p, process, whirl, noise_f, broken, *of_effects = (
        np.random.default_rng(child) for child in root.spawn(8 + len(machine.effects))
    )
    run, readings = _posed(machine, experiment, options, (levels, start, process, whirl), of_effects)
    logged, machine, sensors = run.logged, run.machine, machine.sensors
    angle = run.forces.turning.angle(run.time)
    shown = encoder_angle(sensors, angle)
    sensor = runout(sensors, angle) + sensors.offset_p_m + readings
    n_settle = run.forces.n_settle
    sensor[logged] += np.asarray(sensors.noise_p_m) * noise_p.standard_normal((len(sensor) - n_settle, 2))
    # The probes have noise before the logger starts, too. It matters only for a controller.
    sensor[:n_settle] += np.asarray(sensors.noise_p_m) * noise_p.standard_normal((n_settle, 2))
    motion = _motion(run, sensor, shown)

    noise = np.asarray(sensors.noise_u_m) * noise_u.standard_normal(motion.u[logged].shape)
    signals = {
        "r": motion.r[logged],
        "u": quantised(motion.u[logged] + sensors.offset_u_m + noise, sensors.resolution_u_m),
        "p": motion.seen[logged],
        "phi": shown[logged, None],
    }
    if options.controller is not None:
        signals["w"] = run.reference[logged]
    if isinstance(experiment, Hammer):
        force = experiment.force(run.time[logged])
        signals["f"] = force + sensors.noise_f_n * noise_f.standard_normal(force.shape)
    if run.along:
        signals |= {"pressure_bar": run.pressure_bar[logged, None], "speed_rpm": run.speed_rpm[logged, None]}
    if options.stacks or isinstance(experiment, StackStaircase):
        if isinstance(machine.actuator, ActuatorTruth):
            raise UsageError("stacks: this machine has linear actuators; give it PiezoStacks")
        signals |= {"y_p": motion.stacks[logged], "v": motion.volts[logged]}
        signals["r_p"] = motion.commands[logged].copy()
        if isinstance(experiment, StackStaircase) and not experiment.controlled:
            signals["r_p"][:, experiment.stack - 1] = 0.0  # in open loop the stack has no reference
    recording = Recording(
        signals,
        sample_time,
        conditions=options.conditions,
        name=options.name,
        units={signal: SIGNALS[signal].unit for signal in signals},
        provenance=_provenance(run, motion),
    )
    return recording if faults is None else with_faults(recording, faults, broken)


def _posed(
    machine: Machine,
    experiment: Experiment,
    options: RecordOptions,
    random: Sequence[np.random.Generator],
    of_effects: Sequence[np.random.Generator],
) -> tuple[_Run, FloatArray]:
    """Return the run of a machine, and the errors that effects add to the readings of p, (n, 2) [m]."""
    levels, start, process, whirl = random
    sample_time, surfaces = options.sample_time, options.surfaces
    if machine.film is not None and (options.scatter is not None or surfaces is not None):
        raise UsageError(
            "a gas film lacks the fourteen parameters, so scatter and changing pressure or speed are not available"
        )
    if isinstance(experiment, ScheduledRun) != (surfaces is not None):
        raise UsageError("surfaces are for a ScheduledRun, and it needs them: give surfaces=model.key_parameters")
    turning = _rotation(experiment, options.conditions)
    n_settle = whole_samples("settle_s", options.settle_s, sample_time) if options.settle_s else 0
    n = n_settle + whole_samples("duration_s", experiment.duration_s, sample_time)
    first = start.uniform(0.0, TURN)  # angle when the simulation begins
    turning = replace(turning, start=first + turning.speed * n_settle * sample_time)
    times: FloatArray = np.asarray((np.arange(n + 1) - n_settle) * sample_time, np.float64)
    along: tuple[RotorBearingTruth, ...] = ()
    rejected = 0
    pressure, speed = np.full(n, options.conditions.get("pressure_bar", 0.0)), turning.speed_at(times[:-1]) / RPM
    if isinstance(experiment, ScheduledRun):
        machine, along, rejected = _along_course(machine, experiment, options, times[:-1])
        pressure, speed = experiment.course.at(times[:-1])
    elif options.scatter is not None:
        key = options.seed, options.name, options.conditions
        rotor_bearing, rejected = scattered_bearing(machine.rotor_bearing, options.scatter, *key)
        machine = replace(machine, rotor_bearing=rotor_bearing)
    if options.controller is None:
        machine.check_stable()
    pushes, readings = None, np.zeros((n + 1, 2))  # sums over all effects: forces per moving mass [m/s^2], readings [m]
    for effect, generator in zip(machine.effects, of_effects, strict=True):
        seen = RigRun(times, turning.angle(times), turning.speed_at(times), options.conditions, generator)
        pushed, read = effect.force(seen), effect.reading(seen)
        if pushed is not None:
            pushes = pushed if pushes is None else pushes + pushed
        if read is not None:
            readings = readings + read
    forces = Forces(
        machine,
        turning,
        sample_time,
        n_settle,
        draw_noise(machine, n, sample_time, process),
        draw_whirl(machine, n, sample_time, whirl),
        experiment if isinstance(experiment, Hammer) else None,
        pushes,
    )
    reference = experiment.reference(n, sample_time, levels, n_settle)
    run = _Run(machine, experiment, options, reference, forces, times[:-1], pressure, speed, along, rejected)
    return run, readings[:-1]


def _rotation(experiment: Experiment, conditions: Mapping[str, float]) -> Turning:
    """Return the rotation of the shaft, constant except in runs with a changing speed."""
    if isinstance(experiment, RunUp | ScheduledRun):
        return experiment.turning()
    speed_rpm = conditions.get("speed_rpm")
    if speed_rpm is None or not np.isfinite(speed_rpm):
        raise UsageError(f"conditions: speed_rpm = {speed_rpm}; give the speed of the shaft, 0 for standstill")
    return Turning((0.0,), (float(speed_rpm) * RPM,))


def _along_course(
    machine: Machine, experiment: ScheduledRun, options: RecordOptions, times: FloatArray
) -> tuple[Machine, tuple[RotorBearingTruth, ...], int]:
    """Return the machine at the start, its parameters during the change, and the number of rejected random draws.

    A recording with scatter deviates from the surfaces by the same amounts all the way, which are drawn at the middle
    of the course.
    """
    assert options.surfaces is not None
    deviation, rejected = None, 0
    if options.scatter is not None:
        pressure, speed = (float(v) for v in experiment.course.at(np.array(experiment.duration_s / 2)))
        middle = options.surfaces(np.array([pressure]), np.array([speed]))
        known = RotorBearingTruth.from_parameters({key: np.ravel(value)[0] for key, value in middle.items()})
        place = {"pressure_bar": pressure, "speed_rpm": speed}
        drawn, rejected = scattered_bearing(known, options.scatter, options.seed, options.name, place)
        nominal = known.key_parameters()
        deviation = {key: value - nominal[key] for key, value in drawn.key_parameters().items()}
    along = truths_along(options.surfaces, experiment.course, times, deviation)
    return replace(machine, rotor_bearing=along[0]), along, rejected


def _motion(run: _Run, sensor: FloatArray, shown: FloatArray) -> SteppedMotion:
    """Return the motion of a run, in closed form if possible; refuse a motion that uses up the clearance.

    Parameters
    ----------
    run : _Run
        The run.
    sensor : (n, 2) array
        What the probes add to the disc position [m].
    shown : (n,) array
        Angle that the encoder shows [rad].
    """
    machine, experiment, options, controller = run.machine, run.experiment, run.options, run.options.controller
    reasons = machine.beyond_closed_form()
    if isinstance(experiment, Hammer | RunUp | ScheduledRun | StackStaircase):
        reasons.append(type(experiment).__name__)
    if controller is not None:
        reasons.append("a controller")
    if options.simulation == "exact" and reasons:
        raise UsageError(f"simulation = 'exact': no closed form with {', '.join(reasons)}")
    flag = options.touch_down == "flag"
    motion = None if reasons or options.simulation == "stepping" else _in_closed_form(run, sensor)
    if motion is None or (flag and (motion.radius >= machine.clearance).any()):
        sampled, program = None, None
        if isinstance(controller, SampledController):
            sampled = controller
        elif controller is not None:
            program = ProgramLoop(controller.program, shown, run.speed_rpm, run.pressure_bar)
        motion = stepped_motion(
            machine,
            run.reference,
            run.forces,
            sensor,
            options.sample_time,
            controller=sampled,
            taken=None if sampled is None else sampled.subtracted(shown),
            program=program,
            along=run.along,
            stack_run=experiment if isinstance(experiment, StackStaircase) else None,
            n_settle=run.forces.n_settle,
            oversampling=options.oversampling,
            wall=flag,
        )
    worst = int(motion.radius.argmax())
    largest = motion.radius[worst]
    if not (flag or largest < machine.clearance):
        raise DataError(
            f"recording {options.name!r}: the disc moves {largest * 1e6:.1f} um at {run.time[worst]:.4f} s and "
            f"reaches the clearance of {machine.clearance * 1e6:.1f} um; lower the amplitude or lengthen the hold, or "
            "simulate the contact (touch_down: flag)"
        )
    return motion


def _in_closed_form(run: _Run, sensor: FloatArray) -> SteppedMotion:
    """Return the exact motion of a linear machine in open loop at constant speed."""
    machine, turning, over = run.machine, run.forces.turning, run.options.oversampling
    assert isinstance(machine.actuator, ActuatorTruth)
    driven = driven_motion(machine.rotor_bearing, machine.actuator, run.reference, run.options.sample_time, over)
    angle = turning.angle(driven.time - run.forces.n_settle * run.options.sample_time)
    disc = driven.p + unbalance_orbit(machine.rotor_bearing, machine.unbalance, turning.speed, angle)
    radius = np.hypot(disc[:, 0], disc[:, 1]).reshape(-1, over).max(axis=1)
    p, none = disc[::over], np.zeros((len(run.reference), 4))
    seen = quantised(p + sensor, machine.sensors.resolution_p_m)
    return SteppedMotion(
        run.reference, driven.u[::over], p, seen, none, none, none, none, radius, "closed form, exact delays"
    )


# ---- Provenance of a rig recording: how it was made, written as texts and read back.

Span = tuple[float, float]


def _provenance(run: _Run, motion: SteppedMotion) -> dict[str, str]:
    """Return the texts of the provenance that is stored with a recording, with values as JSON."""
    machine, options, controller = run.machine, run.options, run.options.controller
    effects = {"effects": {effect.name: asdict(effect) for effect in machine.effects}} if machine.effects else {}
    rig = {key: value for key, value in asdict(machine).items() if key != "effects"}
    texts = {
        "source": "gbid virtual rig",
        "seed": str(options.seed),
        "simulation": motion.how,
        "experiment": as_json({type(run.experiment).__name__: asdict(run.experiment)}),
        "rig": as_json({"oversampling": options.oversampling, "settle_s": options.settle_s, **rig, **effects}),
    }
    if not run.along and machine.film is None:  # else no fourteen parameters are the truth
        texts["truth"] = as_json(machine.rotor_bearing.key_parameters())
    if controller is not None:
        program = {"program": controller.name, "sample_time": controller.sample_time}
        texts["controller"] = as_json(asdict(controller) if isinstance(controller, SampledController) else program)
    if options.scatter is not None:
        texts["scatter"] = as_json({**asdict(options.scatter), "draws_thrown_away": run.rejected})
    time, ended = run.time[run.logged], motion.ended[run.logged] > 0
    if touched := spans(time, motion.radius[run.logged] >= machine.clearance, options.sample_time):
        texts["touch_down"] = as_json(touched)
    if saturated := {str(i + 1): spans(time, ended[:, i], options.sample_time) for i in range(4) if ended[:, i].any()}:
        texts["saturated"] = as_json(saturated)
    return texts


def spans(time: FloatArray, inside: np.ndarray, sample_time: float) -> list[Span]:
    """Return the time intervals (first, end) [s] of consecutive samples whose mask is true."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], inside.astype(int), [0]])))
    return [(float(time[a]), float(time[b - 1] + sample_time)) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def touch_downs(recording: Recording) -> list[Span]:
    """Return the time intervals (first, end) [s] in which the disc touched the bearing; empty without contact.

    Parameters
    ----------
    recording : Recording
        Recording of the rig.
    """
    return [(float(a), float(b)) for a, b in json.loads(recording.provenance.get("touch_down", "[]"))]


def saturations(recording: Recording) -> dict[str, list[Span]]:
    """Return the time intervals (first, end) [s] of saturation for each stack, keyed by the stack's number.

    Parameters
    ----------
    recording : Recording
        Recording of the rig.
    """
    stored = json.loads(recording.provenance.get("saturated", "{}"))
    return {stack: [(float(a), float(b)) for a, b in times] for stack, times in stored.items()}


def drawn_truth(recording: Recording) -> dict[str, float]:
    """Return the fourteen true key parameters of a recording by name; empty if not stored.

    Parameters
    ----------
    recording : Recording
        Recording of the rig.
    """
    return {name: float(v) for name, v in json.loads(recording.provenance.get("truth", "{}")).items()}


def as_json(value: Any) -> str:
    """Return a value or array as one line of JSON with sorted keys."""
    return json.dumps(value, default=lambda array: np.asarray(array).tolist(), sort_keys=True)
