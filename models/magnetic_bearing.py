"""One axis of a magnetic levitation: negative stiffness, driven by the control current, and its position loop."""

import gbid

SAMPLE_TIME = 1e-4  # of the shop's controller [s]
STIFFNESS_GAIN, DAMPING_GAIN = 10e3 / 3, 28.0 / 3  # [A/m], [A s/m]
FOLLOWS = 0.3  # share by which the filtered velocity follows the difference quotient in a sample


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

quotient = FOLLOWS / SAMPLE_TIME
shop = gbid.LinearModel(  # states: position of the sample before, and filtered velocity
    [[0.0, 0.0], [-quotient, 1 - FOLLOWS]],
    [[1.0], [quotient]],
    [[DAMPING_GAIN * quotient, -DAMPING_GAIN * (1 - FOLLOWS)]],
    [[-STIFFNESS_GAIN - DAMPING_GAIN * quotient]],
    dt=SAMPLE_TIME,
    name="shop",
)
"""PD controller of the shop, from position to current, as it runs: it acts within the sample of its measurement."""

loop = gbid.ClosedLoop(structure, shop, computation_samples=0, inputs="added", outputs="position")
"""Position loop: from the current that is added to the output of the controller to the position."""
