"""Two nearly coincident, lightly damped modes and three real lags, from two inputs to two outputs.

Modal form: each mode has a damping rate sigma and a frequency omega, each lag a pole. The scale of a modal
state is free, so it is fixed where the mode or lag shows most: mode 1 and lag 2 at output 1, the others at
output 2. Starts are read off the pulse tests: both rings last about a quarter of a second at about 11 Hz,
on top of a slow return.
"""

import gbid

RATE = {"lower": 0.1, "upper": 120.0, "unit": "rad/s"}  # half the sampling frequency is 126 rad/s
STARTS = {
    "b1c_1": 1.0,  # input 1 drives mode 1, input 2 mode 2; the rest is found by the fit
    "b2c_2": 1.0,
    "g1_1": 0.1,
    "g2_1": 0.1,
    "g3_2": 0.1,
}


def parameters():
    """Poles, input gains of modes (b) and lags (g), and shapes at the other output (c and h)."""
    found = [
        gbid.Parameter("sigma1", 4.0, **RATE),
        gbid.Parameter("omega1", 72.0, **RATE),
        gbid.Parameter("sigma2", 4.0, **RATE),
        gbid.Parameter("omega2", 69.0, **RATE),
        gbid.Parameter("lag1", 4.0, **RATE),
        gbid.Parameter("lag2", 7.0, **RATE),
        gbid.Parameter("lag3", 12.0, **RATE),
    ]
    gains = [f"b{mode}{part}_{u}" for mode in (1, 2) for part in "cs" for u in (1, 2)]
    gains += [f"g{lag}_{u}" for lag in (1, 2, 3) for u in (1, 2)]
    shapes = [f"c{mode}{part}" for mode in (1, 2) for part in "cs"] + [f"h{lag}" for lag in (1, 2, 3)]
    return found + [gbid.Parameter(name, STARTS.get(name, 0.0)) for name in gains + shapes]


def matrices(p):
    """Real modal form: states are the two parts of each mode, then the lags."""
    A = [[0] * 7 for _ in range(7)]
    for k, (sigma, omega) in ((0, (p.sigma1, p.omega1)), (2, (p.sigma2, p.omega2))):
        A[k][k], A[k][k + 1], A[k + 1][k], A[k + 1][k + 1] = -sigma, omega, -omega, -sigma
    for i in (1, 2, 3):
        A[3 + i][3 + i] = -p[f"lag{i}"]
    B = [[p[f"b{mode}{part}_{u}"] for u in (1, 2)] for mode in (1, 2) for part in "cs"]
    B += [[p[f"g{lag}_{u}"] for u in (1, 2)] for lag in (1, 2, 3)]
    C = [
        [1, 0, p.c2c, p.c2s, p.h1, 1, p.h3],
        [p.c1c, p.c1s, 1, 0, 1, p.h2, 1],
    ]
    return {"A": A, "B": B, "C": C}


structure = gbid.LinearStructure("twin_mode_rig", parameters(), matrices, inputs="u", outputs="y")
