"""Short recordings of a still rig at operating points."""

import numpy as np
from study_rig import PAPER, truth_at

from gbid.rig import Machine, Prbs, SensorChain, Unbalance, record
from gbid.structure import KEY_PARAMETERS, Plant, RotorBearing

FIXED = dict(PAPER.actuators)
EXACT = Plant(RotorBearing(delay="exact"), outputs=("p",))


def recorded(
    point, number, *, n=600, scatter=0.0, noise=30e-9, amplitude=1.5e-6, hold_s=4e-3, rng=None, controller=None
):
    """Short recording of a still rig's answer to a PRBS, every key parameter off its surface by a random share."""
    truth = truth_at(*point)
    if scatter:
        truth |= {key: truth[key] * (1 + scatter * rng.normal()) for key in KEY_PARAMETERS}
    none = np.zeros((2, 2))
    sensors = SensorChain(
        noise_p_m=noise, runout_amplitude_m=none, runout_phase_rad=none, offset_p_m=(0.0, 0.0), offset_u_m=(0.0, 0.0)
    )
    machine = Machine.from_parameters(truth, truth, unbalance=Unbalance(0.0), sensors=sensors)
    conditions = {"pressure_bar": point[0], "speed_rpm": point[1]}
    return record(
        machine,
        Prbs(amplitude_m=amplitude, hold_s=hold_s, duration_s=n * 2e-4),
        conditions=conditions,
        seed=number,
        name=f"r{number}",
        controller=controller,
    )
