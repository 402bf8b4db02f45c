"""Bouc-Wen hysteresis: an oscillator whose spring has a memory, the hysteretic force z."""

import casadi as ca

import gbid

CORNER = 1e-4
"""Width of the corners of the absolute values: of the velocity [m/s], and with STIFFNESS of the force z [N]."""
STIFFNESS = 1e5
"""Scale of the stiffness and of the rates of z [N/m], so that the parameters of its equation are near one."""


def oscillator(name, hysteresis=True, cubic=False):
    """Return the oscillator with or without its hysteresis, with a linear or a cubic spring."""

    def dynamics(x, u, p):
        """Return the derivatives of position [m], velocity [m/s] and hysteretic force [N]."""
        v = x[1]
        force = u[0] - p.c * v - STIFFNESS * p.k * x[0]
        if cubic:
            force -= 1e12 * p.k_3 * x[0] ** 3
        if not hysteresis:
            return [v, force / p.m]
        z = x[2]
        size_v, size_z = ca.sqrt(v**2 + CORNER**2), ca.sqrt(z**2 + (STIFFNESS * CORNER**2) ** 2)
        return [v, (force - z) / p.m, STIFFNESS * p.a * v - 1e3 * (p.g * size_v * z + p.d * v * size_z)]

    parameters = [
        gbid.Parameter("m", 2.5, lower=0.1, unit="kg"),
        gbid.Parameter("c", 20.0, lower=0.0, unit="N s/m"),
        gbid.Parameter("k", 0.5, lower=0.0, unit="1e5 N/m"),
    ]
    if cubic:
        parameters += [gbid.Parameter("k_3", 0.0, unit="1e12 N/m^3")]
    if hysteresis:
        parameters += [
            gbid.Parameter("a", 0.4, unit="1e5 N/m"),
            gbid.Parameter("g", 0.5, unit="1e3/m"),
            gbid.Parameter("d", -0.5, unit="1e3/m"),
        ]
    return gbid.NonlinearStructure(
        name,
        parameters,
        ["position", "velocity", "z"][: 3 if hysteresis else 2],
        dynamics,
        lambda x, _u, _p: x[0],
        inputs="force",
        outputs="position",
        intersample="foh",
        steps=4,
    )


linear = oscillator("linear spring", hysteresis=False)
cubic = oscillator("cubic spring", hysteresis=False, cubic=True)
structure = oscillator("Bouc-Wen hysteresis")
