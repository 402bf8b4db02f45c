"""One axis of an active magnetic bearing: the pull of two magnets with the square of current over air gap."""

import gbid


def dynamics(x, u, p):
    """Return the derivatives of position [m] and velocity [m/s].

    The control current u [A] adds to the bias current of one magnet and is taken from that of the other. Near the
    centre the difference of the pulls is a negative stiffness ``4 c i_0^2 / s_0^3`` and a gain ``4 c i_0 / s_0^2``.
    """
    right = ((p.i_0 + u[0]) / (p.s_0 - x[0])) ** 2
    left = ((p.i_0 - u[0]) / (p.s_0 + x[0])) ** 2
    return [x[1], p.c * (right - left) - p.d * x[1]]


structure = gbid.NonlinearStructure(
    "active_magnetic_bearing",
    [
        gbid.Parameter("i_0", 2.0, fixed=True, unit="A"),
        gbid.Parameter("s_0", 0.5e-3, lower=0.3e-3, upper=1e-3, unit="m"),
        gbid.Parameter("c", 3e-6, lower=0.0, unit="m^3/(s^2 A^2)"),
        gbid.Parameter("d", 0.0, unit="1/s"),
        gbid.Parameter("l_1", 2e3, unit="1/s"),
        gbid.Parameter("l_2", 2e6, unit="1/s^2"),
    ],
    states=["position", "velocity"],
    dynamics=dynamics,
    output=lambda x, _u, _p: x[0],
    inputs="current",
    outputs="position",
    disturbance_gain=lambda p: [[p.l_1], [p.l_2]],
)
