"""Rigid rotor with four degrees of freedom in two equal bearings, driven and measured at the bearings."""

import numpy as np

import gbid

SUM, DIFFERENCE = np.array([1.0, 1.0]), np.array([1.0, -1.0])


def matrices(p):
    """Return the matrices for translation s and tilt t in x and y, as displacements at the bearings.

    Bearing 1 moves by s + t, bearing 2 by s - t. The polar inertia couples the tilts of both axes by g [rad/s], which
    is proportional to the speed.
    """
    zero, one = np.zeros((4, 4)), np.eye(4)
    stiffness = np.diag([p.k_s, p.k_t, p.k_s, p.k_t])  # s_x, t_x, s_y, t_y
    damping = np.array(
        [[p.d_s, 0, 0, 0], [0, p.d_t, 0, p.g], [0, 0, p.d_s, 0], [0, -p.g, 0, p.d_t]],
    )
    drive = np.kron(np.eye(2), np.vstack([SUM, DIFFERENCE])) * np.array([[p.b_s], [p.b_t], [p.b_s], [p.b_t]])
    show = np.kron(np.eye(2), np.column_stack([SUM, DIFFERENCE]))
    return {
        "A": np.block([[zero, one], [-stiffness, -damping]]),
        "B": np.vstack([np.zeros((4, 4)), drive]),
        "C": np.hstack([show, np.zeros((4, 4))]),
    }


structure = gbid.LinearStructure(
    "rigid_rotor",
    [
        gbid.Parameter("k_s", 2.0e5, lower=0.0, unit="N/(kg m)"),
        gbid.Parameter("k_t", 4.0e5, lower=0.0, unit="N/(kg m)"),
        gbid.Parameter("d_s", 20.0, lower=0.0, unit="N s/(kg m)"),
        gbid.Parameter("d_t", 20.0, lower=0.0, unit="N s/(kg m)"),
        gbid.Parameter("g", 0.0, unit="rad/s"),
        gbid.Parameter("b_s", 0.1, unit="1/kg"),
        gbid.Parameter("b_t", 0.1, unit="1/kg"),
    ],
    matrices,
    inputs="f",
    outputs="q",
)
