"""Residuals that follow an input: the note names what is missing. Data by exponentials on a fine grid, without gbid."""

import numpy as np
import pytest
import scipy.signal
from scipy.linalg import block_diag, expm, solve_discrete_are

import gbid
from gbid.structure import LinearStructure, Parameter

H, N, FINE = 0.05, 600, 20
MODES = [(6.0, 0.08, 1.0), (14.0, 0.06, 0.6)]
STATED = {"w1": 6.2, "z1": 0.1, "g1": 1.0, "w2": 13.5, "z2": 0.05, "g2": 0.5}
TWO = LinearStructure(
    "two modes",
    [Parameter(name, value, 0.0) for name, value in STATED.items()],
    lambda p: {
        "A": [[0, 1, 0, 0], [-(p.w1**2), -2 * p.z1 * p.w1, 0, 0], [0, 0, 0, 1], [0, 0, -(p.w2**2), -2 * p.z2 * p.w2]],
        "B": [[0], [p.g1 * p.w1**2], [0], [p.g2 * p.w2**2]],
        "C": [[1, 0, 1, 0]],
    },
)


def recorded(missing, seed=0):
    random = np.random.default_rng(seed)
    u = np.repeat(random.choice([-1.0, 1.0], N // 4), 4) + 0.3 * random.normal(size=N)
    fine = np.interp(np.arange(N * FINE) / FINE, np.arange(N), u) if missing == "hold" else np.repeat(u, FINE)
    h, later = H / FINE, FINE // 2
    if missing == "lag":
        a = np.exp(-h / 0.08)
        fine = scipy.signal.lfilter([0, 1 - a], [1, -a], fine)
    if missing == "half a sample":
        fine = np.append(np.full(later, u[0]), fine[:-later])
    A = block_diag(*([[0, 1], [-w * w, -2 * z * w]] for w, z, _ in MODES))
    B = np.array([[entry] for w, _, g in MODES for entry in (0, g * w * w)])
    step = expm(h * np.block([[A, B], [np.zeros((1, 5))]]))
    x, y = np.zeros(4), np.zeros(N * FINE)
    for k in range(N * FINE):
        y[k] = x[0] + x[2]
        x = step[:4, :4] @ x + step[:4, 4] * fine[k]
    if missing == "filter":
        y = scipy.signal.lfilter(*scipy.signal.butter(2, 8.0, fs=1 / h), y)
    y = y[::FINE] + {"feed-through": 0.1 * u, "offset": 0.5}.get(missing, 0.0)
    return gbid.Recording({"u": u, "y": y + 0.01 * y.std() * random.normal(size=N)}, H, name="run")


NAMED = {
    "hold": "the other hold of the inputs (intersample='foh')",
    "half a sample": "a delay of the inputs by 0.5 samples",
    "lag": "a lag with a time constant of 0.07",
    "filter": "a low-pass filter of second order",
    "feed-through": "a feed-through from 'u' to 'y'",
    "offset": "trend='offset'",
}


QUICK = [(0, "hold"), (0, "lag"), (0, None)]
STUDY = [(seed, missing) for seed in range(5) for missing in [*NAMED, None] if (seed, missing) not in QUICK]


@pytest.mark.parametrize(("seed", "missing"), [*QUICK, *(pytest.param(*c, marks=pytest.mark.slow) for c in STUDY)])
def test_what_is_missing_is_named(seed, missing):
    result = gbid.fit(TWO, recorded(missing, seed), focus="simulation")
    codes = ("GB144", "GB130") if missing == "offset" else ("GB144",)  # an offset has a note of its own
    told = [note for note in result.notes if any(code in note for code in codes)]
    if missing is None:
        assert not told
    else:
        assert NAMED[missing] in told[0]


AIRCRAFT = {"za": -1.2, "ma": 3.0, "mq": -1.0, "md": -8.0}
PITCH = LinearStructure(
    "unstable short period",
    [Parameter(name, value * off) for (name, value), off in zip(AIRCRAFT.items(), (1.2, 0.8, 1.3, 0.9), strict=True)],
    lambda p: {"A": [[p.za, 1], [p.ma, p.mq]], "B": [[0], [p.md]], "C": [[1, 0], [0, 1]]},
)


def flown(ramps, seed):
    """Pitch of an unstable aircraft under a state feedback; the elevator ramps between samples, or holds."""
    random = np.random.default_rng(seed)
    A, B = np.array([[AIRCRAFT["za"], 1], [AIRCRAFT["ma"], AIRCRAFT["mq"]]]), np.array([[0], [AIRCRAFT["md"]]])
    step, F = (expm(h * np.block([[A, B], [np.zeros((1, 3))]])) for h in (H / FINE, H))
    P = solve_discrete_are(F[:2, :2], F[:2, 2:], np.eye(2), np.eye(1))
    law = np.linalg.solve(1 + F[:2, 2:].T @ P @ F[:2, 2:], F[:2, 2:].T @ P @ F[:2, :2])[0]
    stick, x, u, y = np.repeat(random.choice([-1.0, 1.0], N // 8), 8), np.zeros(2), np.zeros(N), np.zeros((N, 2))
    for k in range(N):
        y[k] = x + 0.01 * random.normal(size=2)
        after = stick[k] + 0.3 * random.normal() - law @ y[k]
        for share in (np.arange(FINE) + 0.5) / FINE * ramps:
            x = step[:2, :2] @ x + step[:2, 2] * (u[k] + (after - u[k]) * share)
        u[min(k + 1, N - 1)] = after
    return gbid.Recording({"u": u, "y": y}, H, name="flight")


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(1, 5))])
def test_the_hold_of_an_unstable_aircraft_is_named(seed):
    for ramps in (True, False):
        told = [note for note in gbid.fit(PITCH, flown(ramps, seed)).notes if "GB144" in note]
        assert len(told) == ramps
        assert all(NAMED["hold"] in note for note in told)
