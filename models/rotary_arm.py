"""First link of a rotary pendulum: an integrating motor with viscous friction."""

import gbid


def matrices(p):
    """Angle and angular velocity; friction b1 [1/s], gain K2 [rad/s^2 per unit of input]."""
    return {"A": [[0, 1], [0, -p.b1]], "B": [[0], [p.K2]], "C": [[1, 0]]}


structure = gbid.LinearStructure(
    "rotary_arm",
    [gbid.Parameter("b1", 1.0, lower=0.0, upper=1000.0, unit="1/s"), gbid.Parameter("K2", -1.0, unit="rad/s^2")],
    matrices,
    inputs="u",
    outputs="y",
)
