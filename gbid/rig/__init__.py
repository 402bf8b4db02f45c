"""The virtual test rig: the published machine with exact delays, its experiments and its sensors."""

from gbid.rig.excitation import Experiment, Prbs, Stationary
from gbid.rig.machine import ActuatorTruth, Machine, RotorBearingTruth, Unbalance
from gbid.rig.response import Motion, driven_motion, unbalance_orbit
from gbid.rig.sensors import SensorChain
from gbid.rig.simulate import record

__all__ = [
    "ActuatorTruth",
    "Experiment",
    "Machine",
    "Motion",
    "Prbs",
    "RotorBearingTruth",
    "SensorChain",
    "Stationary",
    "Unbalance",
    "driven_motion",
    "record",
    "unbalance_orbit",
]
