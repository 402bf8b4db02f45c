"""The published machine at 5 bar, 6000 rpm (the point of Fig. 7): Table B.6 with its corrections, and Table 2."""

import numpy as np

from gbid.rig import ActuatorTruth, Machine, RotorBearingTruth, SensorChain

# constant, bar, rpm, bar rpm, bar^2, rpm^2; printed unit, 1e-3 of it per kg
_TABLE = {
    "k_xx": [-3.168e8, -9.758e7, 1.790e4, -2.192e3, 7.472e6, -1.462],
    "k_xy": [4.020e7, -1.023e7, 6.391e3, 1.256e3, 4.305e5, -9.054e-1],
    "k_yx": [-9.321e5, 9.624e6, -1.428e4, 2.880e3, -1.782e6, 3.838e-1],
    "k_yy": [-2.832e8, -1.026e8, -4.493e2, 9.310e2, 5.845e6, -7.379e-1],
    "d_xx": [-1.855e5, 4.036e4, -3.329e1, 1.003e-2, -3.149e3, 5.819e-3],
    "d_xy": [-6.016e3, -3.643e3, 4.422e-1, 3.002e-1, 7.513e2, 3.918e-4],
    "d_yx": [3.087e4, -8.330e3, -3.198, -5.626e-1, 4.052e2, -3.087e-4],
    "d_yy": [-2.673e5, 6.863e4, -7.541, 7.258e-1, -5.339e3, 6.750e-4],
    "b_xx": [1.326e8, 1.294e7, -4.671e3, 6.982e2, -1.400e6, 1.962e-1],
    "b_xy": [-1.504e7, 3.229e6, 4.720e3, -9.969e2, -8.013e4, 2.687e-1],
    "b_yx": [-5.080e6, 1.514e6, -2.549e3, -5.538e1, 4.262e4, -2.298e-1],
    "b_yy": [1.099e8, 2.427e7, -5.691e2, -9.093e1, -1.545e6, 2.269e-2],
    "tau_x": [1.401, -2.548e-1, 2.348e-6, 5.497e-6, 1.941e-2, -5.711e-9],
    "tau_y": [0.7799, -1.890e-1, 3.186e-5, -3.651e-6, 1.325e-2, -2.466e-9],
}


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
_ACTUATORS = {"p1_x": 3078, "p2_x": 8143, "kappa_x": 1.863, "p1_y": 2452, "p2_y": 6494, "kappa_y": 1.865}


def machine(pressure_bar: float = 5.0, speed_rpm: float = 6000.0, **parts) -> Machine:
    p, w = pressure_bar, speed_rpm
    value = {name: 1e-3 * np.dot([1, p, w, w * p, p * p, w * w], row) for name, row in _TABLE.items()}
    return Machine.from_parameters(value, _ACTUATORS, **parts)


def rotor_bearing(pressure_bar: float = 5.0, speed_rpm: float = 6000.0) -> RotorBearingTruth:
    return machine(pressure_bar, speed_rpm).rotor_bearing


def actuator() -> ActuatorTruth:
    return machine().actuator


def modes(truth: RotorBearingTruth) -> tuple[np.ndarray, np.ndarray]:
    """Return natural frequencies [Hz] and damping factors of the two modes, by rising frequency."""
    values = np.linalg.eigvals(np.block([[np.zeros((2, 2)), np.eye(2)], [truth.stiffness, truth.damping]]))
    upper = np.array(sorted(values[values.imag > 0], key=abs))
    return np.abs(upper) / (2 * np.pi), -upper.real / np.abs(upper)
