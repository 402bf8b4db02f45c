"""Recordings of a rig with forces that nobody measures."""

import numpy as np

import gbid
from gbid.rig import Machine, Prbs, SensorChain, Unbalance, record

PUBLISHED = gbid.load_model("theisen2016")
TRUE = PUBLISHED.key_parameters(6.0, 0.0)
NO_RUNOUT = SensorChain(
    runout_amplitude_m=np.zeros((2, 1)), runout_phase_rad=np.zeros((2, 1)), offset_p_m=(0.0, 0.0), offset_u_m=(0.0, 0.0)
)


def shaken(seed=3, seconds=5.0, sensors=NO_RUNOUT, **effects):
    machine = Machine.from_parameters(TRUE, PUBLISHED.actuators, Unbalance(), sensors, **effects)
    conditions = {"pressure_bar": 6.0, "speed_rpm": 0.0}
    return record(machine, Prbs(seconds), conditions=conditions, seed=seed, name=f"run-{seed}")
