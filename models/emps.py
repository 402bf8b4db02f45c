"""A drive with a ball screw (EMPS): mass with dry and viscous friction, which a position loop moves back and forth."""

import casadi as ca

import gbid

GAIN = 35.15065188
"""Force of the motor at the load for 1 V [N/V], as the data say."""
TURN = 1e-3
"""Velocity [m/s] within which friction turns its sign."""


def drive(name, *more):
    """Return the drive with Coulomb and viscous friction, and with more parameters: F_a, or F_s and v_s, or F_3."""

    def dynamics(x, u, p):
        """Return the derivatives of position [m] and velocity [m/s]; the controller drives with a voltage u [V]."""
        v, sign = x[1], ca.tanh(x[1] / TURN)
        friction = p.F_0 + p.F_c * sign + p.F_v * v
        if "F_a" in more:
            friction += p.F_a * ca.sqrt(v**2 + TURN**2)
        if "v_s" in more:
            friction += p.F_s * sign * ca.exp(-((v / p.v_s) ** 2))
        if "F_3" in more:
            friction += p.F_3 * v**3
        return [v, (GAIN * u[0] - friction) / p.m]

    starts = {"m": 100.0, "F_v": 200.0, "F_c": 20.0, "F_0": 0.0, "v_s": 0.02, "l_1": 100.0, "l_2": 3000.0}
    units = {"m": "kg", "F_v": "N s/m", "F_a": "N s/m", "F_3": "N s^3/m^3", "v_s": "m/s", "l_1": "1/s", "l_2": "1/s^2"}
    lowest = {"m": 1.0, "F_v": 0.0, "v_s": 1e-3}
    keys = ("m", "F_v", "F_c", "F_0", *more, "l_1", "l_2")
    return gbid.NonlinearStructure(
        name,
        [
            gbid.Parameter(key, starts.get(key, 0.0), lower=lowest.get(key, -float("inf")), unit=units.get(key, "N"))
            for key in keys
        ],
        states=["position", "velocity"],
        dynamics=dynamics,
        output=lambda x, _u, _p: x[0],
        inputs="voltage",
        outputs="position",
        disturbance_gain=lambda p: [[p.l_1], [p.l_2]],
        steps=1,
    )


structure = drive("dry and viscous friction")
uneven = drive("friction by direction", "F_a")
stribeck = drive("Stribeck friction", "F_s", "v_s")
cubic = drive("viscous friction of third degree", "F_3")
