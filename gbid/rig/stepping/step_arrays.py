"""Constants and state of the time stepping as plain arrays."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.linalg import expm

from gbid.arrays import FloatArray
from gbid.errors import UsageError
from gbid.rig.machine.controller import SampledController
from gbid.rig.machine.machine import ActuatorTruth, Machine
from gbid.rig.machine.piezo import ALLOCATION, N_PLAYS, PiezoStack, PiezoStacks, StackRest, pair_difference

STEP, DELAY, BEARING = 21, slice(19, 21), slice(0, 12)
"""Indices of the step size, of the delays (in steps), and of K, D and B in `StepArrays.rotor`."""


class _Row(NamedTuple):
    r: slice = slice(0, 2)
    u: slice = slice(2, 4)
    p: slice = slice(4, 6)
    seen: slice = slice(6, 8)
    stacks: slice = slice(8, 12)
    volts: slice = slice(12, 16)
    ended: slice = slice(16, 20)
    radius: int = 20
    commands: slice = slice(21, 25)


ROW = _Row()
"""Columns of the result: r, u, p, p as the sensor shows it, stack positions and voltages, share of the sample
during which each stack was saturated, largest radius within the sample, command of each stack."""
ROW_WIDTH = 25


class StackArrays(NamedTuple):
    """Constants of the four stacks: (4,) arrays, `thresholds` (N_PLAYS, 4), `creep` and `relax` (n_creep, 4)."""

    gain: FloatArray
    lead: FloatArray
    pole: FloatArray
    slow: FloatArray
    fast: FloatArray
    spring: FloatArray
    play: FloatArray
    stroke: FloatArray
    voltage_limit: FloatArray
    reference_gain: FloatArray
    open_loop: FloatArray
    share_x: FloatArray
    share_y: FloatArray
    thresholds: FloatArray
    creep: FloatArray
    relax: FloatArray


class Chunk(NamedTuple):
    """Inputs of a chunk of n samples.

    Attributes
    ----------
    excitation : (n, 2) array
        References without the part of the controller [m].
    base : (n, 4) array
        Command of each stack without the references of the pairs: r_0 [m], or volts for a stack in open loop.
    forces : (2 n oversampling + 1, 2) array
        Forces per moving mass at the time steps and half-way between [m/s^2].
    sensor : (n, 2) array
        Run-out, offset and noise of the probes [m].
    taken : (n, 2) array
        Correction that the controller subtracts from the measured position [m].
    """

    excitation: FloatArray
    base: FloatArray
    forces: FloatArray
    sensor: FloatArray
    taken: FloatArray


@dataclass(frozen=True, eq=False)
class StepArrays:
    """Constants of a simulation.

    Attributes
    ----------
    rotor : (22,) array
        K, D, B row by row, 1/l^2, clearance, wall stiffness and damping per mass, omega^2, 2 zeta omega and share
        of the flexible mode, delays in steps, step [s].
    linear : (2, 6) array
        Exact step of a linear actuator: a' = m0 a + m1 r, u' = m2 a + m3 u + m4 r.
    stacks : StackArrays or None
        Constants of the stacks; None for linear actuators.
    controller : SampledController or None
        Controller of the loop; None in open loop.
    oversampling : int
        Time steps per sample.
    wall : bool
        Whether the disc touches a wall at the clearance.
    resolution, travel : float
        Resolution of p [m], 0 for none, and limit of r in a control loop [m].
    """

    rotor: FloatArray
    linear: FloatArray
    stacks: StackArrays | None
    controller: SampledController | None
    oversampling: int
    wall: bool
    resolution: float
    travel: float


@dataclass(frozen=True, eq=False)
class StepState:
    """State of a simulation between chunks; its arrays are changed in place.

    Attributes
    ----------
    rotor : (8,) array
        q [m], its velocity [m/s], eta of the flexible mode [m], its velocity [m/s].
    linear : (2,) array
        Slow state of each linear actuator [m].
    stack : (3, 4) array
        PD state, amplifier voltage [V] and position [m] of each stack.
    plays, creep : (N_PLAYS, 4), (n_creep, 4) array
        States of the plays [V] and of the creep [m].
    controller, command : (n,), (2,) array
        State and last output [m] of the controller.
    history : (kept + 1, 2) array
        u at the last time steps [m], the present one in the last row.
    """

    rotor: FloatArray
    linear: FloatArray
    stack: FloatArray
    plays: FloatArray
    creep: FloatArray
    controller: FloatArray
    command: FloatArray
    history: FloatArray


def step_arrays(
    machine: Machine,
    controller: SampledController | None,
    sample_time: float,
    oversampling: int,
    wall: bool,
    open_loop: int | None = None,
) -> StepArrays:
    """Return the constants of a simulation.

    Parameters
    ----------
    machine : Machine
        The machine.
    controller : SampledController or None
        Controller of the loop.
    sample_time : float
        Time between samples [s].
    oversampling : int
        Time steps per sample.
    wall : bool
        Whether the disc touches a wall at the clearance.
    open_loop : int, optional
        Number of the stack whose controller is off.

    Raises
    ------
    UsageError
        When the time step is too long for the fastest pole.
    """
    h = sample_time / oversampling
    rb, mass = machine.rotor_bearing, machine.moving_mass
    flexible, contact = machine.flexible_mode, machine.contact
    omega = 2 * np.pi * flexible.frequency_hz if flexible else 1.0
    rotor = np.concatenate(
        [
            *(matrix.ravel() for matrix in (rb.stiffness, rb.damping, rb.input_gain)),
            [machine.stiffening.inverse_square_length if machine.stiffening else 0.0, machine.clearance],
            [contact.stiffness / mass, contact.damping / mass],
            [omega**2, 2 * flexible.damping * omega if flexible else 2.0, flexible.share if flexible else 0.0],
            rb.delay / h,
            [h],
        ]
    )
    actuator = machine.actuator
    stacks = _stack_arrays(actuator, h, open_loop) if isinstance(actuator, PiezoStacks) else None
    linear = _linear_steps(actuator, h) if isinstance(actuator, ActuatorTruth) else np.zeros((2, 6))
    fastest = max(omega, np.sqrt(contact.stiffness / mass) if wall else 0.0)
    if stacks is not None:
        fastest = max(fastest, float((stacks.fast + stacks.slow).max()))
    if fastest * h > 0.5:
        raise UsageError(
            f"a step of {h:.3g} s is too long for a pole of {fastest:.4g} rad/s; raise oversampling to at least "
            f"{int(np.ceil(2 * fastest * sample_time))}"
        )
    return StepArrays(
        rotor, linear, stacks, controller, oversampling, wall, machine.sensors.resolution_p, machine.travel
    )


def rest_state(arrays: StepArrays, machine: Machine, base: FloatArray) -> StepState:
    """Return the state of rest under the first commands of the stacks `base`, shape (4,) [m or V]."""
    n_controller = 0 if arrays.controller is None else len(arrays.controller.A)
    stack, plays = np.zeros((3, 4)), np.zeros((N_PLAYS, 4))
    n_creep = 0 if arrays.stacks is None else len(arrays.stacks.creep)
    creep, u = np.zeros((n_creep, 4)), np.zeros(2)
    if arrays.stacks is not None and isinstance(machine.actuator, PiezoStacks):
        for i, piezo in enumerate(machine.actuator.stacks):
            rest = _rest(piezo, float(base[i]), bool(arrays.stacks.open_loop[i]))
            error = piezo.reference_gain * float(base[i]) - rest.position
            stack[:, i] = (piezo.pd_zero - piezo.pd_pole) / piezo.pd_pole * error, rest.voltage, rest.position
            plays[:, i] = rest.plays
            creep[:, i] = arrays.stacks.creep[:, i] * rest.expansion
        u = pair_difference(stack[2])
    rotor = np.zeros(8)
    rotor[0:2] = -np.linalg.solve(machine.rotor_bearing.stiffness, machine.rotor_bearing.input_gain @ u)
    kept = int(np.ceil(arrays.rotor[DELAY].max())) + 1
    return StepState(
        rotor, np.zeros(2), stack, plays, creep, np.zeros(n_controller), np.zeros(2), np.tile(u, (kept + 1, 1))
    )


def _rest(piezo: PiezoStack, command: float, is_open: bool) -> StackRest:
    return piezo.rest(0.0, voltage=command) if is_open else piezo.rest(command)


def _stack_arrays(actuator: PiezoStacks, h: float, open_loop: int | None) -> StackArrays:
    def each(value: str) -> FloatArray:
        return np.array([float(getattr(stack, value)) for stack in actuator.stacks])

    opened = np.array([float(number == open_loop) for number in (1, 2, 3, 4)])
    times = np.array([stack.creep_times for stack in actuator.stacks]).T
    return StackArrays(
        each("pd_gain") * each("pd_scale"),
        each("pd_zero") - each("pd_pole"),
        each("pd_pole"),
        each("slow_pole"),
        each("fast_pole"),
        each("spring"),
        each("play_weight"),
        each("stroke"),
        each("voltage_limit"),
        each("reference_gain"),
        opened,
        ALLOCATION[:, 0] * (1 - opened),
        ALLOCATION[:, 1] * (1 - opened),
        np.column_stack([stack.thresholds for stack in actuator.stacks]),
        np.tile(each("creep") / max(len(times), 1), (len(times), 1)),
        -np.expm1(-h / times) if len(times) else np.zeros((0, 4)),
    )


def _linear_steps(actuator: ActuatorTruth, h: float) -> FloatArray:
    rows = np.zeros((2, 6))
    for j, (slow, fast, gain) in enumerate(zip(actuator.slow_pole, actuator.fast_pole, actuator.gain, strict=True)):
        step = expm(h * np.array([[-slow, 0, slow * gain], [fast, -fast, 0], [0, 0, 0]]))
        rows[j, :5] = step[0, 0], step[0, 2], step[1, 0], step[1, 1], step[1, 2]
    return rows
