"""Flexible beam with a piezo patch and a sensor: two bending modes, and the lag of the amplifier."""

import casadi as ca

import gbid

MODES = (1, 2)


def matrices(p):
    """Return the matrices for modal displacements and velocities, driven by the voltage behind a lag."""
    A, B, C = ca.SX.zeros(5, 5), ca.SX.zeros(5, 1), ca.SX.zeros(1, 5)
    for i, mode in enumerate(MODES):
        w, z, gain = p[f"w{mode}"], p[f"z{mode}"], p[f"g{mode}"]
        A[2 * i, 2 * i + 1] = 1
        A[2 * i + 1, 2 * i] = -(w**2)
        A[2 * i + 1, 2 * i + 1] = -2 * z * w
        A[2 * i + 1, 4] = gain * w**2
        C[0, 2 * i] = 1
    A[4, 4], B[4, 0] = -1 / p.lag, 1 / p.lag
    return {"A": A, "B": B, "C": C}


structure = gbid.LinearStructure(
    "flexible_beam",
    [
        *(gbid.Parameter(f"w{mode}", w, lower=1.0, unit="rad/s") for mode, w in zip(MODES, (60.0, 400.0), strict=True)),
        *(gbid.Parameter(f"z{mode}", 0.01, lower=1e-5, upper=1.0, unit="1") for mode in MODES),
        *(gbid.Parameter(f"g{mode}", 1e-5, unit="m/V") for mode in MODES),
        gbid.Parameter("lag", 1e-3, lower=1e-5, upper=0.1, unit="s"),
    ],
    matrices,
    inputs="voltage",
    outputs="tip",
)
