"""A structure of one's own: a mass on a spring, driven by a voltage."""

import gbid


def matrices(p):
    """States are position [m] and velocity [m/s]; stiffness k and damping d per unit mass, gain b."""
    return {
        "A": [[0, 1], [-p.k, -p.d]],
        "B": [[0], [p.b]],
        "C": [[1, 0]],
        # "K": [[p.k1], [p.k2]] would add a disturbance gain for focus: prediction
    }


structure = gbid.LinearStructure(
    "mass_on_spring",
    [
        gbid.Parameter("k", start=4e4, lower=0.0, unit="1/s^2"),
        gbid.Parameter("d", start=10.0, lower=0.0, unit="1/s"),
        gbid.Parameter("b", start=1.0, unit="m/(s^2 V)"),
    ],
    matrices,
    inputs="drive",
    outputs="position",
)
