"""Fits begun in the basin of a local minimum end at the lowest one, or say that another start ended lower (GB111)."""

import numpy as np
import pytest

from gbid import LinearStructure, Parameter, Recording, fit
from gbid.structure import evaluate

H, N = 0.01, 2000


def modes(names, *, delayed=False, driven=True):
    """Structure of modes in parallel, with parameters w, z and g of each, behind a delay; or their free decay."""
    own = [f"{what}{i}" for i in names for what in ("wzg" if driven else "wz")]
    parameters = [Parameter(name) for name in own] + [Parameter("tau", None, 0.0, 1.5)] * delayed

    def matrices(p):
        A = [[0] * 2 * len(names) for _ in range(2 * len(names))]
        for k, i in enumerate(names):
            A[2 * k][2 * k + 1] = 1
            A[2 * k + 1][2 * k : 2 * k + 2] = -(p[f"w{i}"] ** 2), -2 * p[f"z{i}"] * p[f"w{i}"]
        given = {"A": A, "C": [[1, 0] * len(names)]}
        if driven:
            B = [[p[f"g{i}"] * p[f"w{i}"] ** 2 if row else 0] for i in names for row in range(2)]
            given |= {"B": [[0]] * len(A), "B_delayed": B, "delay": [p.tau]} if delayed else {"B": B}
        return given

    return LinearStructure("modes", parameters, matrices, "u" if driven else (), "y")


ONE, TWO, LATE, DECAY = modes(("",)), modes("12"), modes(("",), delayed=True), modes(("",), driven=False)
AT = {"w": 20.0, "z": 0.02, "g": 1.0}
PAIR = {"w1": 15.0, "z1": 0.02, "g1": 1.0, "w2": 40.0, "z2": 0.015, "g2": 0.5}
RINGING = {"w": 20.0, "z": 0.002}
PERIODS = {"w": 25.0, "z": 0.05, "g": 1.0, "tau": 0.1}
CASES = {
    "frequency": (ONE, AT, 12, 0.05, {"w": 60.0}),
    "noise hides the frequency": (ONE, AT, 12, 1.0, {"w": 60.0}),
    "both modes at one": (TWO, PAIR, 7, 0.05, {"w2": 15.5}),
    "both modes above": (TWO, PAIR, 7, 0.05, {"w1": 70.0, "w2": 90.0}),
    "delay": (LATE, PERIODS, 10, 0.05, {"tau": 0.6}),
    "noise hides the delay": (LATE, PERIODS, 10, 1.0, {"tau": 0.8}),
    "periods of a sine": (LATE, PERIODS, 0, 0.02, {"tau": 0.1 + 2 / 3.5}),
    "decay": (DECAY, RINGING, None, 0.05, {"w": 30.0}),
    "noise hides the decay": (DECAY, RINGING, None, 1.0, {"w": 30.0}),
    "fast decay": (DECAY, {"w": 150.0, "z": 3e-4}, None, 0.3, {"w": 180.0}),
}


@pytest.mark.parametrize("case", CASES)
def test_a_local_minimum_is_left_or_named(case):
    structure, true, hold, noise, begun = CASES[case]
    random, model = np.random.default_rng(5), evaluate(structure, true)
    if hold is None:
        y = model.simulate(np.zeros((N, 0)), H, initial_state=np.array([1.0, 0.0]))
    else:
        u = np.repeat(random.choice([-1.0, 1.0], N), max(hold, 1))[:N]
        if hold == 0:
            u = sum(a * np.sin(2 * np.pi * f * H * np.arange(N)) for a, f in ((1, 3.5), (0.1, 3.1)))
        y = model.simulate(u[:, None], H)
    y = y + noise * y.std() * random.normal(size=y.shape)
    recording = Recording({"y": y} | ({} if hold is None else {"u": u[:, None]}), H, name="run")
    lowest = fit(structure, recording, start=true, focus="simulation")
    result = fit(structure, recording, start={**true, **begun}, focus="simulation")
    named = any("GB111" in note for note in result.notes)
    assert result.success
    assert named or result.loss <= lowest.loss * 1.001
