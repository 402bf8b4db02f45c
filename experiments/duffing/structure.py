"""A spring that stiffens: Duffing's oscillator, driven by a force."""

import gbid


def dynamics(x, u, p):
    """Return the derivatives of position [m] and velocity [m/s]; k, d and c are per unit mass."""
    return [x[1], u[0] - p.d * x[1] - p.k * x[0] - p.c * x[0] ** 3]


def output(x, _u, _p):
    """Return what is measured: the position."""
    return x[0]


structure = gbid.NonlinearStructure(
    "duffing",
    [
        gbid.Parameter("k", start=0.5, lower=0.0, unit="1/s^2"),
        gbid.Parameter("d", start=0.5, lower=0.0, unit="1/s"),
        gbid.Parameter("c", start=1.0, unit="1/(m^2 s^2)"),
    ],
    states=["position", "velocity"],
    dynamics=dynamics,
    output=output,
    inputs="force",
    outputs="position",
)
