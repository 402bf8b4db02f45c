"""Cascaded tanks: a pump fills the upper tank, which empties into the lower one; both can overflow."""

import casadi as ca

import gbid
from gbid.structure import smooth_hinge

RIM = 10.0
"""Level at which a tank overflows and the sensor ends [V]; that of the upper tank, not measured, in the same unit."""
CORNER = 0.1
"""Width of the corners [V] of overflow and sensor."""


def tanks(name, sensor=1, exponents=False):
    """Return the tanks: Torricelli's outflows and overflow, with a sensor curve of a degree."""

    def dynamics(x, u, p):
        """Return the derivatives of both levels; a part k_5 of what overflows above falls into the lower tank."""
        above, below = smooth_hinge(x[0], CORNER), smooth_hinge(x[1], CORNER)
        root, out = ca.sqrt(above), p.k_3 * ca.sqrt(below)
        if exponents:
            root, out = above**p.n_1, p.k_3 * below**p.n_3
        over = smooth_hinge(x[0] - RIM, CORNER)
        upper = p.k_4 * (u[0] - p.u_0) - p.k_1 * root - over
        return [upper, p.k_2 * root - out + p.k_5 * over - smooth_hinge(x[1] - RIM, CORNER)]

    def output(x, _u, p):
        """Return the voltage of the sensor, which ends at the rim."""
        level = x[1] + sum(p[f"s_{i}"] * (x[1] - RIM / 2) ** i for i in range(2, sensor + 1))
        return RIM - smooth_hinge(RIM - level, CORNER)

    parameters = [
        gbid.Parameter("k_1", 0.05, lower=0.0, unit="V^0.5/s"),
        gbid.Parameter("k_2", 0.05, lower=0.0, unit="V^0.5/s"),
        gbid.Parameter("k_3", 0.05, lower=0.0, unit="V^0.5/s"),
        gbid.Parameter("k_4", 0.05, lower=0.0, unit="1/s"),
        gbid.Parameter("k_5", 0.3, lower=0.0, upper=1.5, unit="1"),
        gbid.Parameter("u_0", 0.0, unit="V"),
    ]
    parameters += [
        gbid.Parameter(f"s_{i}", 0.0, unit="1/V" if i == 2 else f"1/V^{i - 1}") for i in range(2, sensor + 1)
    ]
    if exponents:
        parameters += [gbid.Parameter(f"n_{i}", 0.5, lower=0.1, upper=1.0, unit="1") for i in (1, 3)]
    return gbid.NonlinearStructure(
        name, parameters, ["upper", "lower"], dynamics, output, inputs="pump", outputs="level", steps=4
    )


straight = tanks("straight sensor")
structure = tanks("sensor curve of second degree", sensor=2)
cubic = tanks("sensor curve of third degree", sensor=3)
exponents = tanks("sensor curve of second degree, exponents of the outflows", sensor=2, exponents=True)
