"""Additional forces on the rotor per moving mass: unbalance, impacts, whirl and noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from gbid.arrays import FloatArray
from gbid.rig.excitation.hammer import Hammer
from gbid.rig.excitation.run_up import Turning
from gbid.rig.machine.machine import Machine
from gbid.rig.stepping.response import unbalance_orbit


@dataclass(frozen=True, eq=False)
class Forces:
    """Additional forces per moving mass as a function of time.

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
        """Return the forces from one sample to another, at the time steps and half-way between.

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
        if self.turning.is_steady and self.turning.speed == 0:
            return np.zeros((len(time), 2))
        angle = self.turning.angle(time) + unbalance.phase
        outward = unbalance.eccentricity * self.turning.speed_at(time) ** 2
        along = unbalance.eccentricity * self.turning.acceleration_at(time)
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
    if rule is None or rule.size == 0:
        return None
    pole = np.exp(-2 * np.pi * rule.bandwidth_hz * sample_time)
    white = random.standard_normal((n + 1, 2)) @ np.array([1.0, 1j]) / np.sqrt(2)
    white[1:] *= np.sqrt(1 - pole**2)
    return np.asarray(scipy.signal.lfilter([1.0], [1.0, -pole], white))
