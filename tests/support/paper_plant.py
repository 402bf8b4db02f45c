"""The published plant with exact delays, by numpy and scipy alone: no code of gbid simulates it."""

from itertools import pairwise

import numpy as np
from scipy.linalg import expm

TS = 2e-4


def square(letter, true):
    return np.array([[true[f"{letter}_{out}{into}"] for into in "xy"] for out in "xy"])


def motion(r, true):
    """Piezo and disc positions u and p (N, 2) for references r (N, 2) that are held between samples.

    The states are two actuators without, two with the delay, and the rotor. A delayed reference changes once within a
    sample, at the remainder of its delay: between these times all inputs are constant.
    """
    A, B = np.zeros((12, 12)), np.zeros((12, 4))
    for i, axis in enumerate("xy"):
        slow, fast = true[f"p1_{axis}"], true[f"p2_{axis}"]
        for first, column in ((2 * i, i), (4 + 2 * i, 2 + i)):
            A[first : first + 2, first : first + 2] = [[-slow, 0], [fast, -fast]]
            B[first, column] = slow * true[f"kappa_{axis}"]
    A[8:10, 10:12] = np.eye(2)
    A[10:12, 8:10], A[10:12, 10:12], A[10:12, [5, 7]] = (square(letter, true) for letter in "kdb")
    tau = np.array([true["tau_x"], true["tau_y"]])
    complete = np.floor(tau / TS).astype(int)
    changes = tau - complete * TS
    edges = sorted({0.0, TS, *changes.tolist()})
    pieces = []
    for begin, end in pairwise(edges):
        step = expm(np.block([[A, B], [np.zeros((4, 16))]]) * (end - begin))
        pieces.append((step[:12, :12], step[:12, 12:], complete + (begin < changes)))
    longest = int(complete.max()) + 1
    every = np.vstack([np.zeros((longest, 2)), r])
    x, states = np.zeros(12), np.empty((len(r), 12))
    for k in range(len(r)):
        states[k] = x
        for F, G, lag in pieces:
            delayed = every[k + longest - lag, [0, 1]]
            x = F @ x + G @ np.concatenate([every[k + longest], delayed])
    return states[:, [1, 3]], states[:, 8:10]


def references(n, hold, seed, size=4.5e-6):
    """Random binary references (n, 2), independent in x and y, held so many samples."""
    levels = np.random.default_rng(seed).choice([-size, size], (-(-n // hold), 2))
    return levels.repeat(hold, axis=0)[:n]
