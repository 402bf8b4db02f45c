"""Two tanks, one above the other: a pump fills the upper one, which empties into the lower one (Torricelli)."""

import casadi as ca

import gbid

LOW = 1e-4
"""Level [m] below which the outflow is linear, so that its slope stays finite."""


def outflow(level):
    """Return the root of a level [m], smooth and of the same sign as the level."""
    return level / ca.sqrt(ca.sqrt(level**2 + LOW**2))


def dynamics(x, u, p):
    """Return the derivatives of both levels [m]; the pump is driven by a voltage u [V]."""
    upper, lower = outflow(x[0]), outflow(x[1])
    return [p.k * u[0] - p.a_1 * upper, p.a_1 * upper - p.a_2 * lower]


structure = gbid.NonlinearStructure(
    "two_tanks",
    [
        gbid.Parameter("k", 1e-3, lower=0.0, unit="m/(s V)"),
        gbid.Parameter("a_1", 0.01, lower=0.0, unit="m^0.5/s"),
        gbid.Parameter("a_2", 0.01, lower=0.0, unit="m^0.5/s"),
        gbid.Parameter("l_1", 0.0, unit="1/s"),
        gbid.Parameter("l_2", 0.0, unit="1/s"),
    ],
    states=["upper", "lower"],
    dynamics=dynamics,
    output=lambda x, _u, _p: [x[0], x[1]],
    inputs="pump",
    outputs=["upper", "lower"],
    disturbance_gain=lambda p: [[p.l_1, 0], [0, p.l_2]],
)
