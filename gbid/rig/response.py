r"""Exact motion of actuators and rotor, in closed form, and the additional forces on the rotor.

The references are held constant over each sample, as a digital-to-analogue converter does. Everything behind them
is linear. The delays commute with the rotor, so each axis j is one chain of six states

.. math::

    \dot a = p_1 (\kappa r_j - a), \quad \dot u = p_2 (a - u), \quad
    \ddot q = K q + D \dot q + B_{\cdot j} u, \qquad p(t) = q_x(t - \tau_x) + q_y(t - \tau_y).

With r constant, a matrix exponential gives the states at the next sample and at any instant before it. So u and p
are exact up to rounding at every time and for every real delay. Neither a time grid nor a Pade approximation is used.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import hypot

import numpy as np
import scipy

from gbid.core.arrays import FloatArray, one_blas_thread, recursion
from gbid.core.brief import Brief
from gbid.core.errors import UsageError
from gbid.rig.excitation import Hammer, Turning
from gbid.rig.machine import (
    ActuatorTruth,
    Machine,
    RotorBearingTruth,
    Scatter,
    Unbalance,
    scatter_random,
    scattered,
)
from gbid.rig.sensors import TURN, runout

MIN_OVERSAMPLING = 20
_U, _P = 1, slice(2, 4)  # states of one chain: a, u, q_x, q_y, their velocities; the held input last


@dataclass(frozen=True, eq=False)
class Motion(Brief):
    """True motion on a fine time grid, without sensors.

    Attributes
    ----------
    time : (n,) array
        Times from zero [s].
    u : (n, 2) array
        Differences of piezo positions [m].
    p : (n, 2) array
        Disc position [m].
    """

    time: FloatArray
    u: FloatArray
    p: FloatArray


def driven_motion(
    rotor_bearing: RotorBearingTruth,
    actuator: ActuatorTruth,
    reference: FloatArray,
    sample_time: float,
    oversampling: int = MIN_OVERSAMPLING,
) -> Motion:
    """Return the response of actuators and rotor to held references, from rest.

    Parameters
    ----------
    rotor_bearing : RotorBearingTruth
        Rotor and bearing.
    actuator : ActuatorTruth
        Piezo pairs.
    reference : (n_samples, 2) array
        r [m]; row k is held from sample k to sample k + 1.
    sample_time : float
        Time between samples [s].
    oversampling : int
        Output points per sample, at least 20. The accuracy does not depend on it.

    Returns
    -------
    Motion
        Motion at n_samples * oversampling instants; every `oversampling`-th instant is a sample.

    Raises
    ------
    UsageError
        When `oversampling` is below 20.
    """
    if oversampling < MIN_OVERSAMPLING:
        raise UsageError(f"oversampling = {oversampling}; give at least {MIN_OVERSAMPLING} steps in a sample")
    n_samples = len(reference)
    u = np.zeros((n_samples, oversampling, 2))
    p = np.zeros((n_samples, oversampling, 2))
    chains = [_chain(rotor_bearing, actuator, axis) for axis in range(2)]
    # Threads do not speed up products of matrices of this size. On a busy machine they made it ten times slower.
    with one_blas_thread():
        at_samples = _states_at_samples(chains, reference, sample_time)
        for axis, (chain, states) in enumerate(zip(chains, at_samples, strict=True)):
            delay = float(rotor_bearing.delay[axis])
            for point in range(oversampling):
                since = sample_time * point / oversampling
                u[:, point, axis] = states @ scipy.linalg.expm(chain * since)[_U]
                # p is the state one delay earlier: go back by whole samples, then forward by `ahead` seconds.
                back = int(np.ceil((delay - since) / sample_time - 1e-12))
                ahead = max(back * sample_time + since - delay, 0.0)
                if back < n_samples:
                    p[back:, point] += states[: n_samples - back] @ scipy.linalg.expm(chain * ahead)[_P].T
    time = np.arange(n_samples * oversampling, dtype=float) * (sample_time / oversampling)
    return Motion(time, u.reshape(-1, 2), p.reshape(-1, 2))


def unbalance_orbit(
    rotor_bearing: RotorBearingTruth, unbalance: Unbalance, speed: float, angle: FloatArray
) -> FloatArray:
    r"""Return the stationary response of the rotor to its unbalance.

    The force per mass is :math:`e \Omega^2 [\cos(\phi + \theta), \sin(\phi + \theta)]`. The frequency response to it is
    :math:`(-\Omega^2 I - i\Omega D - K)^{-1}`. The result is exact after the initial transient.

    Parameters
    ----------
    rotor_bearing : RotorBearingTruth
        Rotor and bearing.
    unbalance : Unbalance
        The unbalance.
    speed : float
        Omega [rad/s].
    angle : (n,) array
        Shaft angle phi = Omega t + phi_0 [rad].

    Returns
    -------
    (n, 2) array
        Disc position [m].
    """
    force = unbalance.eccentricity_m * speed**2 * np.exp(1j * unbalance.phase_rad) * np.array([1.0, -1j])
    dynamic = -(speed**2) * np.eye(2) - 1j * speed * rotor_bearing.damping - rotor_bearing.stiffness
    return np.asarray(np.outer(np.exp(1j * angle), np.linalg.solve(dynamic, force)).real)


_DRAWS = 100  # machines from a scatter
_TURN = np.asarray(np.arange(720) * (TURN / 720), float)  # angles of a turn


def possible_machines(
    machine: Machine, conditions: Mapping[str, float], scatter: Scatter | None = None
) -> list[tuple[dict[str, float], float]]:
    """Return key parameters of a machine and of 100 draws of its scatter, each with the used part of the clearance [m].

    The orbit of the unbalance and the run-out take this part [m]. The run-out counts as if the disc moved by it: a disc
    that is not round needs it, and on a real machine nobody can tell the two apart before they are separated.

    Parameters
    ----------
    machine : Machine
        The rig at the operating point.
    conditions : dict of str to float
        Operating point; ``speed_rpm`` is required.
    scatter : Scatter, optional
        Differences from recording to recording. Without it the machine is always the same.
    """
    speed = float(conditions["speed_rpm"]) * TURN / 60.0
    bearings = [machine.rotor_bearing]
    if scatter is not None:
        draws, size = (scatter_random(0, f"excitation {i}", conditions) for i in range(_DRAWS)), hypot(*scatter.sizes)
        bearings += [scattered(machine.rotor_bearing, scatter, random, size)[0] for random in draws]
    shape = np.linalg.norm(runout(machine.sensors, _TURN), axis=1).max()
    orbits = [unbalance_orbit(bearing, machine.unbalance, speed, _TURN) for bearing in bearings]
    largest = [float(np.linalg.norm(orbit, axis=1).max() + shape) for orbit in orbits]
    return [(bearing.key_parameters(), taken) for bearing, taken in zip(bearings, largest, strict=True)]


def _chain(rotor_bearing: RotorBearingTruth, actuator: ActuatorTruth, axis: int) -> FloatArray:
    """Return the system matrix of one axis with seven states; the last state is the constant held input."""
    slow, fast = actuator.slow_pole[axis], actuator.fast_pole[axis]
    matrix = np.zeros((7, 7))
    matrix[0, 0], matrix[0, 6] = -slow, slow * actuator.gain[axis]
    matrix[1, 0], matrix[1, 1] = fast, -fast
    matrix[2:4, 4:6] = np.eye(2)
    matrix[4:6, 1] = rotor_bearing.input_gain[:, axis]
    matrix[4:6, 2:4] = rotor_bearing.stiffness
    matrix[4:6, 4:6] = rotor_bearing.damping
    return matrix


def _states_at_samples(chains: list[FloatArray], reference: FloatArray, sample_time: float) -> list[FloatArray]:
    """Return the states of both axes at the samples, from rest, each (n_samples, 7) with r in the last column."""
    step = np.zeros((12, 12))
    drive = np.zeros((12, 2))
    for axis, chain in enumerate(chains):
        transition = scipy.linalg.expm(chain * sample_time)
        rows = slice(6 * axis, 6 * axis + 6)
        step[rows, rows], drive[rows, axis] = transition[:6, :6], transition[:6, 6]
    states = np.zeros((len(reference), 12))
    pushes = reference @ drive.T
    for k in range(len(reference) - 1):
        states[k + 1] = step @ states[k] + pushes[k]
    return [np.column_stack([states[:, 6 * j : 6 * j + 6], reference[:, j]]) for j in range(2)]


# ---- Additional forces on the rotor per moving mass: unbalance, impacts, whirl and noise.


@dataclass(frozen=True, eq=False)
class Forces:
    """Additional forces on the rotor per moving mass, as a function of time.

    Random sequences are drawn at the samples and interpolated linearly in between, so that they do not depend on the
    time step.

    Attributes
    ----------
    machine : Machine
        The machine.
    turning : Turning
        Rotation of the shaft.
    sample_time : float
        Time between samples [s].
    n_settle : int
        Number of samples before the logger starts at time zero.
    noise : (n + 1, 2) array or None
        Process noise at the samples [m/s^2].
    whirl : (n + 1,) complex array or None
        z of `NonSynchronous` at the samples.
    hammer : Hammer or None
        Impacts.
    effects : (n + 1, 2) array or None
        Forces of further effects at the samples [m/s^2].
    """

    machine: Machine
    turning: Turning
    sample_time: float
    n_settle: int = 0
    noise: FloatArray | None = None
    whirl: np.ndarray | None = None
    hammer: Hammer | None = None
    effects: FloatArray | None = None

    def between(self, first: int, last: int, oversampling: int) -> FloatArray:
        """Return the forces between two samples, at the time steps and at their midpoints.

        Returns
        -------
        (2 (last - first) oversampling + 1, 2) array
            Forces per moving mass along x and y [m/s^2].
        """
        count = 2 * (last - first) * oversampling
        at = first + np.arange(count + 1) / (2 * oversampling)  # in samples
        time = (at - self.n_settle) * self.sample_time
        force = self._unbalance(time)
        if self.hammer is not None:
            force += self.hammer.force(time) / self.machine.moving_mass
        index = np.minimum(at.astype(int), last - 1)
        part = (at - index)[:, None]
        for at_samples in (self.noise, self.effects):
            if at_samples is not None:
                force += (1 - part) * at_samples[index] + part * at_samples[index + 1]
        if self.whirl is not None and self.machine.non_synchronous is not None:
            z = (1 - part[:, 0]) * self.whirl[index] + part[:, 0] * self.whirl[index + 1]
            rule = self.machine.non_synchronous
            z = rule.size_at(self.turning.speed_at(time)) * z * np.exp(1j * rule.ratio * self.turning.angle(time))
            force -= np.column_stack([z.real, z.imag]) @ self.machine.rotor_bearing.stiffness.T
        return np.ascontiguousarray(force)

    def orbit_at_start(self) -> tuple[FloatArray, FloatArray]:
        """Return position [m] and velocity [m/s] of the unbalance orbit at the start of the simulation."""
        time = np.array([-self.n_settle * self.sample_time])
        angle, speed = self.turning.angle(time), float(self.turning.speed_at(time)[0])
        rotor, unbalance = self.machine.rotor_bearing, self.machine.unbalance
        turned = unbalance_orbit(rotor, unbalance, speed, np.concatenate([angle, angle + np.pi / 2]))
        return turned[0], speed * turned[1]

    def _unbalance(self, time: FloatArray) -> FloatArray:
        """Return the force of an eccentric mass for any rotation of the shaft."""
        unbalance = self.machine.unbalance
        if not any(self.turning.speeds):
            return np.zeros((len(time), 2))
        angle = self.turning.angle(time) + unbalance.phase_rad
        outward = unbalance.eccentricity_m * self.turning.speed_at(time) ** 2
        along = unbalance.eccentricity_m * self.turning.acceleration_at(time)
        c, s = np.cos(angle), np.sin(angle)
        return np.column_stack([outward * c + along * s, outward * s - along * c])


def draw_noise(machine: Machine, n: int, sample_time: float, random: np.random.Generator) -> FloatArray | None:
    """Return random process noise at n + 1 samples [m/s^2], or None when the machine has none."""
    if machine.process_noise is None or machine.process_noise.density == 0:
        return None
    deviation = machine.process_noise.density / np.sqrt(2 * sample_time)
    return np.asarray(deviation * random.standard_normal((n + 1, 2)))


def draw_whirl(machine: Machine, n: int, sample_time: float, random: np.random.Generator) -> np.ndarray | None:
    """Return random values z of the non-synchronous whirl at n + 1 samples, or None when the machine has none."""
    rule = machine.non_synchronous
    if rule is None or rule.size_m == 0:
        return None
    pole = np.exp(-2 * np.pi * rule.bandwidth_hz * sample_time)
    white = random.standard_normal((n + 1, 2)) @ np.array([1.0, 1j]) / np.sqrt(2)
    white[1:] *= np.sqrt(1 - pole**2)
    return recursion(pole, white)
