"""One axis of an active magnetic bearing: negative stiffness, driven by the control current."""

import gbid


def matrices(p):
    """Return the matrices for position and velocity of the rotor.

    The bias field pulls away from the centre with k_s; the control current acts with k_i, both per mass.
    """
    return {
        "A": [[0, 1], [p.k_s, -p.d]],
        "B": [[0], [p.k_i]],
        "C": [[1, 0]],
        "K": [[p.l1], [p.l2]],
    }


structure = gbid.LinearStructure(
    "magnetic_bearing",
    [
        gbid.Parameter("k_s", lower=0.0, unit="N/(kg m)"),
        gbid.Parameter("d", 0.0, lower=0.0, upper=100.0, unit="N s/(kg m)"),
        gbid.Parameter("k_i", lower=0.0, unit="N/(kg A)"),
        gbid.Parameter("l1", unit="1/s"),
        gbid.Parameter("l2", unit="1/s^2"),
    ],
    matrices,
    inputs="current",
    outputs="position",
)
