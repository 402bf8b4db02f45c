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


THREE = {"w": 25.0, "z": 0.05, "g1": 1.0, "g2": 0.8, "g3": 1.2, "tau1": 0.1, "tau2": 0.17, "tau3": 0.05}
BEHIND_THREE = LinearStructure(
    "a mode behind three delays",
    [
        *(Parameter(name) for name in ("w", "z", "g1", "g2", "g3")),
        *(Parameter(f"tau{i}", None, 0, 1.5) for i in (1, 2, 3)),
    ],
    lambda p: {
        "A": [[0, 1], [-(p.w**2), -2 * p.z * p.w]],
        "B": [[0] * 3] * 2,
        "B_delayed": [[0] * 3, [g * p.w**2 for g in (p.g1, p.g2, p.g3)]],
        "delay": [p.tau1, p.tau2, p.tau3],
        "C": [[1, 0]],
    },
    "u",
    "y",
)


@pytest.mark.parametrize("periods", [(1, 0, 0), pytest.param((1, 1, 0), marks=pytest.mark.slow)])
def test_delays_off_by_periods_of_their_inputs_are_left_or_named(periods):
    random, t = np.random.default_rng(5), H * np.arange(N)
    tones = [((1, 3.5 + 0.2 * i), (0.1, 3.1 + 0.2 * i)) for i in range(3)]
    u = np.stack([sum(a * np.sin(2 * np.pi * f * t + random.uniform(0, 6)) for a, f in each) for each in tones], axis=1)
    y = evaluate(BEHIND_THREE, THREE).simulate(u, H)
    recording = Recording({"y": y + 0.3 * y.std() * random.normal(size=y.shape), "u": u}, H, name="run")
    lowest = fit(BEHIND_THREE, recording, start=THREE, focus="simulation")
    away = {f"tau{i + 1}": THREE[f"tau{i + 1}"] + k / tones[i][0][1] for i, k in enumerate(periods)}
    result = fit(BEHIND_THREE, recording, start={**THREE, **away}, focus="simulation")
    assert result.success
    assert any("GB111" in note and "tau1 =" in note for note in result.notes)  # a period of tau1 is hidden by the noise
    assert result.loss <= lowest.loss * 1.002
