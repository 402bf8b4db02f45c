"""Limits for a machine of the virtual rig: no rub, with its unbalance, run-out and scatter."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from gbid.arrays import FloatArray
from gbid.excite.excitation_limits import ExcitationLimits, PossibleMachine
from gbid.rig import Machine, RotorBearingTruth, Scatter, SensorChain, scatter_random, scattered, unbalance_orbit
from gbid.rig.machine.sensors import TURN, runout

_ANGLES = 720  # of a turn


def rig_limits(
    machine: Machine,
    *,
    conditions: Mapping[str, float],
    peaks: Mapping[str, float],
    radius: Mapping[str, float] | None = None,
    scatter: Scatter | None = None,
    draws: int = 100,
    seed: int = 0,
) -> ExcitationLimits:
    """Return limits with which a machine of the rig does not rub.

    The run-out counts as if the disc moved by it: a disc that is not round needs this part of the clearance, and on a
    real machine nobody can tell the two apart before they are separated.

    Parameters
    ----------
    machine : Machine
        The rig at the operating point.
    conditions : dict of str to float
        Operating point; ``speed_rpm`` is required.
    peaks, radius : dict of str to float
        As of `ExcitationLimits`.
    scatter : Scatter, optional
        Differences from recording to recording. Without it the machine is always the same.
    draws : int
        Number of machines that are drawn from the scatter.
    seed : int
        Seed of the draws.

    Returns
    -------
    ExcitationLimits
        With the clearance of the machine.
    """
    speed = float(conditions["speed_rpm"]) * TURN / 60.0
    drawn = []
    for i in range(draws if scatter is not None else 0):
        assert scatter is not None
        random = scatter_random(seed, f"excitation {i}", conditions)
        one, _ = scattered(machine.rotor_bearing, scatter, random)
        drawn.append(PossibleMachine(one.key_parameters(), _taken(machine, one, speed)))
    return ExcitationLimits(
        peaks=dict(peaks),
        radius=dict(radius or {}),
        clearance=machine.clearance,
        taken=_taken(machine, machine.rotor_bearing, speed),
        machines=tuple(drawn),
    )


def _taken(machine: Machine, rotor_bearing: RotorBearingTruth, speed: float) -> float:
    """Return the part of the clearance that unbalance and run-out take [m]."""
    orbit = unbalance_orbit(rotor_bearing, machine.unbalance, speed, _turn())
    return float(np.linalg.norm(orbit, axis=1).max() + _runout_radius(machine.sensors))


def _runout_radius(sensors: SensorChain) -> float:
    return float(np.linalg.norm(runout(sensors, _turn()), axis=1).max())


def _turn() -> FloatArray:
    return np.asarray(np.arange(_ANGLES) * (TURN / _ANGLES), float)
