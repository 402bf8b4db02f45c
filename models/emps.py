"""A drive with a ball screw (EMPS): mass with dry and viscous friction, alone or in its loops of position and speed."""

import casadi as ca

import gbid

GAIN = 35.15065188
"""Force of the motor at the load for 1 V [N/V]; this gain and those of the loops are in the data."""
KP = 160.18
"""Gain of the position loop [1/s]."""
KV = 243.45
"""Gain of the velocity loop [V s/m]."""
SAMPLE = 1e-3
"""Sample time of the controller [s]. It takes the velocity from positions two samples apart, and holds its output."""
TURN = 1e-3
"""Velocity [m/s] within which friction turns its sign."""


def drive(name, *more, loop=False):
    """Return the drive with Coulomb and viscous friction, and with more parameters: F_a or F_3.

    From voltage to position, or with its `loop` from the command, KP KV times the reference plus what is injected [V],
    to voltage and position. The controller is continuous, with the mean delays of the sampled one: half a sample of
    the position for the hold, and one and a half of the velocity, the third state.
    """

    def dynamics(x, u, p):
        """Return the derivatives of position [m], velocity and, with the loop, the delayed velocity [m/s]."""
        v, sign = x[1], ca.tanh(x[1] / TURN)
        friction = p.F_0 + p.F_c * sign + p.F_v * v
        if "F_a" in more:
            friction += p.F_a * ca.sqrt(v**2 + TURN**2)
        if "F_3" in more:
            friction += p.F_3 * v**3
        voltage = u[0] - KV * (KP * (x[0] - SAMPLE / 2 * v) + x[2]) if loop else u[0]
        return [v, (GAIN * voltage - friction) / p.m, *([(v - x[2]) / (1.5 * SAMPLE)] if loop else [])]

    def output(x, u, _p):
        """Return the position; with the loop first the voltage, whose velocity is one sample old."""
        return [u[0] - KV * (KP * x[0] + x[2] + (x[1] - x[2]) / 3), x[0]] if loop else x[0]

    starts = {"m": 100.0, "F_v": 200.0, "F_c": 20.0, "l_1": 100.0, "l_2": 3000.0}
    units = {"m": "kg", "F_v": "N s/m", "F_a": "N s/m", "F_3": "N s^3/m^3", "l_1": "1/s", "l_2": "1/s^2"}
    lowest = {"m": 1.0, "F_v": 0.0}
    keys = ("m", "F_v", "F_c", "F_0", *more, *(() if loop else ("l_1", "l_2")))
    return gbid.NonlinearStructure(
        name,
        [
            gbid.Parameter(key, starts.get(key, 0.0), lower=lowest.get(key, -float("inf")), unit=units.get(key, "N"))
            for key in keys
        ],
        states=["position", "velocity", *(["delayed velocity"] if loop else [])],
        dynamics=dynamics,
        output=output,
        inputs="command" if loop else "voltage",
        outputs=["voltage", "position"] if loop else "position",
        disturbance_gain=None if loop else lambda p: [[p.l_1], [p.l_2]],
        steps=1,
    )


structure = drive("dry and viscous friction")
uneven = drive("friction by direction", "F_a")
cubic = drive("viscous friction of third degree", "F_3")
loop = drive("dry and viscous friction", loop=True)
uneven_loop = drive("friction by direction", "F_a", loop=True)
cubic_loop = drive("viscous friction of third degree", "F_3", loop=True)
