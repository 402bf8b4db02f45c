"""Motion of a nonlinear machine or of a control loop by time stepping, compiled where there is a C compiler."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from typing import Literal

import numpy as np

from gbid.arrays import FloatArray
from gbid.brief import Brief
from gbid.compiling import CompilerMissingError, load_library
from gbid.errors import UsageError
from gbid.rig.excitation.staircase import StackStaircase
from gbid.rig.machine.controller import SampledController
from gbid.rig.machine.machine import Machine
from gbid.rig.machine.piezo import PiezoStacks
from gbid.rig.stepping.along_course import PIECE, AlongCourse
from gbid.rig.stepping.forces import Forces
from gbid.rig.stepping.program_loop import ProgramLoop, StepRun, run_with_program
from gbid.rig.stepping.python_twin import run_in_python
from gbid.rig.stepping.response import MIN_OVERSAMPLING
from gbid.rig.stepping.step_arrays import ROW, ROW_WIDTH, Chunk, StepArrays, StepState, rest_state, step_arrays
from gbid.rig.stepping.step_source import SOURCE

RigEngine = Literal["auto", "compiled", "python"]
_CHUNK = 2000
"""Samples per chunk: the forces on the fine grid then fit into the processor cache."""


@dataclass(frozen=True, eq=False)
class SteppedMotion(Brief):
    """Result of the time stepping, one row per sample.

    Attributes
    ----------
    r, u, p : (n, 2) array
        References as applied, differences of stack positions, disc position [m].
    seen : (n, 2) array
        Disc position as the probes show it [m].
    stacks, volts, commands : (n, 4) array
        Positions [m], voltages [V] and commands of the stacks (reference [m], or volts in open loop); zero for linear
        actuators.
    ended : (n, 4) array
        Share of each sample during which the voltage or the expansion of a stack was at its limit.
    radius : (n,) array
        Largest distance of the disc from the centre within each sample [m].
    how : str
        Engine that was used, and the reason when it is not the compiled one.
    """

    r: FloatArray
    u: FloatArray
    p: FloatArray
    seen: FloatArray
    stacks: FloatArray
    volts: FloatArray
    commands: FloatArray
    ended: FloatArray
    radius: FloatArray
    how: str


def stepped_motion(
    machine: Machine,
    excitation: FloatArray,
    forces: Forces,
    sensor: FloatArray,
    sample_time: float,
    *,
    controller: SampledController | None = None,
    taken: FloatArray | None = None,
    program: ProgramLoop | None = None,
    stack_run: StackStaircase | None = None,
    along: AlongCourse | None = None,
    n_settle: int = 0,
    oversampling: int = MIN_OVERSAMPLING,
    wall: bool = True,
    engine: RigEngine = "auto",
) -> SteppedMotion:
    """Return the motion computed by classical Runge-Kutta steps of sample_time/oversampling.

    References are held over each sample. The delayed u is interpolated linearly between steps. Unbalance and other
    forces are evaluated at the steps and half-way between. The stacks start at rest under r_0, the rotor starts on its
    unbalance orbit.

    Parameters
    ----------
    machine : Machine
        The machine.
    excitation : (n, 2) array
        r [m] without the part of the controller.
    forces : Forces
        Additional forces on the rotor.
    sensor : (n, 2) array
        Run-out, offset and noise that the probes add to the disc position [m].
    sample_time : float
        Time between samples [s].
    controller : SampledController, optional
        Controller of the loop; open loop when not given.
    taken : (n, 2) array, optional
        Correction that the controller subtracts from the measured position [m].
    program : ProgramLoop, optional
        Program that closes the loop in place of `controller`.
    along : AlongCourse, optional
        Parameters of rotor and bearing on the way, in place of those of the machine.
    stack_run : StackStaircase, optional
        Staircase of one stack, which then does not follow the references of its pair.
    n_settle : int
        Number of samples before the logger starts.
    oversampling : int
        Time steps per sample, at least 20.
    wall : bool
        Whether a contact holds the disc at the clearance.
    engine : {"auto", "compiled", "python"}
        Program that computes the time steps. ``"auto"`` is the compiled one where there is a compiler.

    Returns
    -------
    SteppedMotion

    Raises
    ------
    UsageError
        When ``engine = "compiled"`` and there is no compiler, when the time step is too long, or when a stack is
        commanded on a machine without stacks.
    """
    if oversampling < MIN_OVERSAMPLING:
        raise UsageError(f"oversampling = {oversampling}; the rig works on at least {MIN_OVERSAMPLING} points")
    n = len(excitation)
    is_open = stack_run is not None and not stack_run.controlled
    arrays = step_arrays(
        machine, controller, sample_time, oversampling, wall, stack_run.stack if stack_run and is_open else None
    )
    base = _base(machine, stack_run, arrays, n, sample_time, n_settle)
    longest = arrays if along is None else along.longest(arrays)
    state = rest_state(longest, machine, base[0] if n else np.zeros(4))
    orbit, velocity = forces.orbit_at_start()
    state.rotor[0:2] += orbit
    state.rotor[2:4] += velocity
    taken = np.zeros((n, 2)) if taken is None else taken
    run, how = _choose(engine)
    rows = np.empty((n, ROW_WIDTH))
    for first in range(0, n, _CHUNK):
        last = min(first + _CHUNK, n)
        on_grid = forces.between(first, last, oversampling)
        for begin in range(first, last, _CHUNK if along is None else PIECE):
            part = slice(begin, last if along is None else min(begin + PIECE, last))
            grid = slice(2 * oversampling * (part.start - first), 2 * oversampling * (part.stop - first) + 1)
            here = arrays if along is None else along.arrays(arrays, begin)
            chunk = Chunk(excitation[part], base[part], on_grid[grid], sensor[part], taken[part])
            rows[part] = (
                run(here, state, chunk)
                if program is None
                else run_with_program(run, here, state, chunk, program.part(part))
            )
    columns = (np.ascontiguousarray(rows[:, where]) for where in ROW)
    r, u, p, seen, stacks, volts, ended, radius, commands = columns
    return SteppedMotion(r, u, p, seen, stacks, volts, commands, ended, radius, how)


def _base(
    machine: Machine,
    stack_run: StackStaircase | None,
    arrays: StepArrays,
    n: int,
    sample_time: float,
    n_settle: int,
) -> FloatArray:
    """Return the command of each stack without the references of the pairs."""
    actuator = machine.actuator
    if not isinstance(actuator, PiezoStacks):
        if stack_run is not None:
            raise UsageError("stack staircase: this machine has linear actuators; give it PiezoStacks")
        return np.zeros((n, 4))
    base = np.full((n, 4), actuator.offset)
    if stack_run is not None and arrays.stacks is not None:
        i = stack_run.stack - 1
        top = actuator.stacks[i].stroke if stack_run.controlled else actuator.stacks[i].voltage_limit
        base[:, i] = stack_run.command(top, n, sample_time, n_settle)
    return base


def _choose(engine: RigEngine) -> tuple[StepRun, str]:
    if engine not in ("auto", "compiled", "python"):
        raise UsageError(f"engine = {engine!r}; choose 'auto', 'compiled' or 'python'")
    if engine == "python":
        return run_in_python, "stepping, interpreted"
    try:
        load_library(SOURCE)
    except CompilerMissingError as missing:
        if engine == "compiled":
            raise UsageError(f"engine = 'compiled': {missing}") from None
        return run_in_python, f"stepping, interpreted ({missing})"
    return _run_compiled, "stepping, compiled"


def _run_compiled(arrays: StepArrays, state: StepState, chunk: Chunk) -> FloatArray:
    """Return the motion over a chunk of samples, computed in C; see `run_in_python`."""
    n, kept = len(chunk.excitation), len(state.history) - 1
    stacks, controller = arrays.stacks, arrays.controller
    n_creep = len(state.creep)
    empty = np.zeros((max(n_creep, 1), 4))
    single = np.array(stacks[:13]) if stacks else np.zeros((13, 4))
    thresholds, creep, relax = stacks[13:] if stacks else (np.zeros_like(state.plays), empty, empty)
    blocks = [controller.A, controller.B, controller.C, controller.D] if controller else []
    loop = np.concatenate([block.ravel() for block in blocks]) if blocks else np.zeros(1)
    loop_state = np.concatenate([state.controller, state.command])
    history = np.vstack([state.history, np.zeros((n * arrays.oversampling + 1, 2))])
    n_loop = -1 if controller is None else len(controller.A)
    sizes = np.array(
        [n, arrays.oversampling, stacks is not None, n_creep, kept, n_loop, arrays.wall], dtype=ctypes.c_long
    )
    limits = np.array([arrays.resolution, arrays.travel])
    output = np.empty((n, ROW_WIDTH))
    constants = [arrays.rotor, arrays.linear, single, thresholds, creep, relax]
    drive = [chunk.excitation, chunk.base, chunk.forces, chunk.sensor, chunk.taken, loop, limits]
    moving = [state.linear, state.stack, state.plays, state.creep, state.rotor, loop_state, history, output]
    fixed = [np.ascontiguousarray(array, dtype=float) for array in constants + drive]
    step = load_library(SOURCE).gbid_rig_steps
    step.restype = None
    step(*(ctypes.c_void_p(array.ctypes.data) for array in (sizes, *fixed, *moving)))
    state.controller[:], state.command[:] = loop_state[: len(state.controller)], loop_state[-2:]
    state.history[:] = history[: kept + 1]
    return output
