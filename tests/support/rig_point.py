"""The published machine at 5 bar, 6000 rpm, the point of Fig. 7."""

import numpy as np

from gbid.lpv import load_model
from gbid.rig import ActuatorTruth, Machine, RotorBearingTruth, SensorChain

BARE = SensorChain(
    noise_p_m=0.0,
    noise_u_m=0.0,
    noise_f_n=0.0,
    runout_amplitude_m=np.zeros((2, 0)),
    runout_phase_rad=np.zeros((2, 0)),
    offset_p_m=(0, 0),
    offset_u_m=(0, 0),
    encoder_counts=None,
)
"""Sensors without errors."""
_PAPER = load_model("theisen2016")


def machine(pressure_bar: float = 5.0, speed_rpm: float = 6000.0, **parts) -> Machine:
    return Machine.from_parameters(_PAPER.key_parameters(pressure_bar, speed_rpm), _PAPER.actuators, **parts)


def rotor_bearing(pressure_bar: float = 5.0, speed_rpm: float = 6000.0) -> RotorBearingTruth:
    return machine(pressure_bar, speed_rpm).rotor_bearing


def actuator() -> ActuatorTruth:
    return machine().actuator


def modes(truth: RotorBearingTruth) -> tuple[np.ndarray, np.ndarray]:
    """Return natural frequencies [Hz] and damping factors of the two modes, by rising frequency."""
    values = np.linalg.eigvals(np.block([[np.zeros((2, 2)), np.eye(2)], [truth.stiffness, truth.damping]]))
    upper = np.array(sorted(values[values.imag > 0], key=abs))
    return np.abs(upper) / (2 * np.pi), -upper.real / np.abs(upper)
