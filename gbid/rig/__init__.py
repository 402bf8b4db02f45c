"""Virtual test rig: the published machine with exact delays, its experiments and its sensors."""

from gbid.rig.effects import rig_effect, rig_effects
from gbid.rig.excitation.hammer import Hammer, Impact
from gbid.rig.excitation.played import Played
from gbid.rig.excitation.prbs import Prbs, Stationary
from gbid.rig.excitation.run_up import RunUp
from gbid.rig.excitation.scheduled_run import Course, ScheduledRun
from gbid.rig.excitation.staircase import StackStaircase, Staircase
from gbid.rig.faults import Faults
from gbid.rig.machine.controller import LoopProgram, ProgramController, SampledController
from gbid.rig.machine.machine import ActuatorTruth, Machine, RotorBearingTruth, Unbalance
from gbid.rig.machine.piezo import PiezoStack, PiezoStacks
from gbid.rig.machine.rig_effect import RigEffect, RigRun
from gbid.rig.machine.rotor_effects import Contact, FilmStiffening, FlexibleMode, NonSynchronous, ProcessNoise
from gbid.rig.machine.scatter import Scatter, scatter_random, scattered
from gbid.rig.machine.sensors import SensorChain
from gbid.rig.provenance import drawn_truth, saturations, touch_downs
from gbid.rig.simulate import Experiment, record
from gbid.rig.stepping.response import Motion, driven_motion, unbalance_orbit
from gbid.rig.stepping.stepped_motion import SteppedMotion, stepped_motion

__all__ = [
    "ActuatorTruth",
    "Contact",
    "Course",
    "Experiment",
    "Faults",
    "FilmStiffening",
    "FlexibleMode",
    "Hammer",
    "Impact",
    "LoopProgram",
    "Machine",
    "Motion",
    "NonSynchronous",
    "PiezoStack",
    "PiezoStacks",
    "Played",
    "Prbs",
    "ProcessNoise",
    "ProgramController",
    "RigEffect",
    "RigRun",
    "RotorBearingTruth",
    "RunUp",
    "SampledController",
    "Scatter",
    "ScheduledRun",
    "SensorChain",
    "StackStaircase",
    "Staircase",
    "Stationary",
    "SteppedMotion",
    "Unbalance",
    "drawn_truth",
    "driven_motion",
    "record",
    "rig_effect",
    "rig_effects",
    "saturations",
    "scatter_random",
    "scattered",
    "stepped_motion",
    "touch_downs",
    "unbalance_orbit",
]
