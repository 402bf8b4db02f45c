"""Structures of different kinds with their truths and recordings, for start values from the data."""

from dataclasses import dataclass

import casadi as ca
import numpy as np
from fit_cases import ACTUATORS, KEY, TS, levels, piezo_motion

from gbid.recording import Recording
from gbid.structure import LinearStructure, Parameter, PiezoPair, RotorBearing, evaluate


@dataclass(frozen=True)
class StartCase:
    """Structure without start values, its true parameters, and a function of the seed that makes recordings."""

    name: str
    structure: object
    truth: dict
    make: object
    options: dict


def _noise(seed, shape, colour=0.0):
    """White noise, or an autoregression of first order with the same variance."""
    white = np.random.default_rng([seed, 9]).normal(size=shape)
    if not colour:
        return white
    for k in range(1, len(white)):
        white[k] = colour * white[k - 1] + np.sqrt(1 - colour**2) * white[k]
    return white


def recorded(structure, truth, u, h, seed, share, *, hold="zoh", colour=0.0, x0=None, name="data"):
    """Recording with noise of a share of the standard deviation of each output."""
    y = evaluate(structure, truth).simulate(u, h, intersample=hold, initial_state=x0)
    y = y + share * y.std(0) * _noise(seed, y.shape, colour)
    signals = {structure.outputs[0]: y}
    if len(structure.inputs):
        signals[structure.inputs[0]] = u
    return Recording(signals, h, name=name)


def chain(n):
    """Masses of one, springs and dampers from a wall; a force on the first mass, first and last position measured."""

    def matrices(p):
        K, D = ca.SX(n, n), ca.SX(n, n)
        for i in range(n):
            for M, q in ((K, p[f"k{i}"]), (D, p[f"d{i}"])):
                M[i, i] += q
                if i:
                    M[i - 1, i - 1] += q
                    M[i, i - 1] -= q
                    M[i - 1, i] -= q
        A = ca.blockcat([[ca.SX(n, n), ca.SX.eye(n)], [-K, -D]])
        B, C = ca.SX(2 * n, 1), ca.SX(2, 2 * n)
        B[n, 0], C[0, 0], C[1, n - 1] = p.b, 1, 1
        return {"A": A, "B": B, "C": C}

    names = [f"{letter}{i}" for letter in "kd" for i in range(n)]
    return LinearStructure(f"chain of {n}", [Parameter(name, None, 0.0) for name in (*names, "b")], matrices)


CHAIN_AT = {"k0": 4e3, "k1": 9e3, "k2": 6e3, "d0": 1.0, "d1": 2.0, "d2": 1.5, "b": 500.0}

MOTOR = LinearStructure(
    "dc motor",
    [Parameter(name, None, 0.0) for name in ("R", "L", "k", "J", "c")],
    lambda p: {"A": [[-p.R / p.L, -p.k / p.L], [p.k / p.J, -p.c / p.J]], "B": [[1 / p.L], [0]], "C": [[1, 0], [0, 1]]},
)
MOTOR_AT = {"R": 1.2, "L": 3e-3, "k": 0.05, "J": 2e-5, "c": 1e-5}

THERMAL = LinearStructure(
    "thermal network",
    [Parameter(name, None, 0.0) for name in ("C1", "C2", "C3", "R12", "R23", "Ra")],
    lambda p: {
        "A": [
            [-1 / (p.R12 * p.C1), 1 / (p.R12 * p.C1), 0],
            [1 / (p.R12 * p.C2), -(1 / p.R12 + 1 / p.R23) / p.C2, 1 / (p.R23 * p.C2)],
            [0, 1 / (p.R23 * p.C3), -(1 / p.R23 + 1 / p.Ra) / p.C3],
        ],
        "B": [[1 / p.C1], [0], [0]],
        "C": [[1, 0, 0], [0, 0, 1]],
    },
)
THERMAL_AT = {"C1": 50.0, "C2": 200.0, "C3": 400.0, "R12": 0.5, "R23": 0.8, "Ra": 0.3}

LEVITATION = LinearStructure(
    "magnetic bearing",
    [Parameter("ks", None, 0.0), Parameter("ki", None, 0.0), Parameter("rate", None, 0.0), Parameter("g", None)],
    lambda p: {
        "A": [[0, 1, 0], [p.ks, 0, p.ki], [0, 0, -p.rate]],
        "B": [[0], [0], [p.g * p.rate]],
        "C": [[1, 0, 0], [0, 0, 1]],
    },
)
LEVITATION_AT = {"ks": 2.5e3, "ki": 25.0, "rate": 400.0, "g": 0.8}


def levitated(seed, n=4000, h=1e-3):
    """Recording of the levitation in a loop with a PD controller, excited at its reference."""
    plant = evaluate(LEVITATION, LEVITATION_AT).discretise(h)
    random = np.random.default_rng([seed, 4])
    r = 0.5 * np.repeat(random.choice([-1.0, 1.0], n // 5), 5)
    x, u, y, before = np.zeros(3), np.zeros((n, 1)), np.zeros((n, 2)), 0.0
    for k in range(n):
        y[k] = plant.C @ x + [2e-4 * random.normal(), 1e-2 * random.normal()]
        u[k] = r[k] - 400.0 * y[k, 0] - 8.0 * (y[k, 0] - before) / h
        before = y[k, 0]
        x = plant.A @ x + plant.B[:, 0] * u[k]
    assert np.abs(y).max() < 10
    return Recording({"u": u, "y": y}, h, name="levitation")


PAIR = LinearStructure(
    "gyroscopic pair",
    [
        Parameter("k1", None, 0.0),
        Parameter("k2", None, 0.0),
        Parameter("g", None),
        Parameter("d", None, 0.0),
        Parameter("b", None),
    ],
    lambda p: {
        "A": [[0, 0, 1, 0], [0, 0, 0, 1], [-p.k1, 0, -p.d, -p.g], [0, -p.k2, p.g, -p.d]],
        "B": [[0, 0], [0, 0], [p.b, 0], [0, p.b]],
        "C": [[1, 0, 0, 0], [0, 1, 0, 0]],
    },
)
PAIR_AT = {"k1": 900.0, "k2": 1600.0, "g": 6.0, "d": 0.4, "b": 100.0}

LATE_LAG = LinearStructure(
    "lag with dead time",
    [Parameter("gain", None), Parameter("T", None, 1e-6), Parameter("dead_time", None, 0.0)],
    lambda p: {"A": [[-1 / p.T]], "B": [[0]], "B_delayed": [[p.gain / p.T]], "delay": [p.dead_time], "C": [[1]]},
)
LATE_LAG_AT = {"gain": -3.0, "T": 0.4, "dead_time": 0.73}

PENDULUM = LinearStructure(
    "pendulum",
    [Parameter("k", None, 0.0), Parameter("d", None, 0.0), Parameter("c", None, 0.0)],
    lambda p: {"A": [[0, 1, 0], [-p.k, -p.d, 1], [0, 0, -p.c]], "B": ca.SX(3, 0), "C": [[1, 0, 0]]},
    inputs=(),
)
PENDULUM_AT = {"k": 60.0, "d": 0.3, "c": 1.5}


def swings(seed):
    """Two free decays from different initial states."""
    return [
        recorded(PENDULUM, PENDULUM_AT, np.zeros((800, 0)), 0.02, seed + 50 * i, 0.02, x0=x0, name=f"swing {i}")
        for i, x0 in enumerate(([0.3, 0.0, 0.5], [0.0, 2.0, -1.0]))
    ]


def _open_loop(structure, truth, n, n_inputs, hold_samples, h, share, **options):
    return lambda seed: recorded(structure, truth, levels(n, n_inputs, hold_samples, seed), h, seed, share, **options)


ROTOR = RotorBearing(delay="exact", disturbance_gain="none")
CASES = (
    StartCase("chain of 3", chain(3), CHAIN_AT, _open_loop(chain(3), CHAIN_AT, 4000, 1, 3, 5e-3, 0.05), {}),
    StartCase(
        "chain of 3, coloured noise",
        chain(3),
        CHAIN_AT,
        _open_loop(chain(3), CHAIN_AT, 6000, 1, 3, 5e-3, 0.2, colour=0.95),
        {},
    ),
    StartCase("dc motor", MOTOR, MOTOR_AT, _open_loop(MOTOR, MOTOR_AT, 3000, 1, 10, 5e-4, 0.03), {}),
    StartCase("thermal network", THERMAL, THERMAL_AT, _open_loop(THERMAL, THERMAL_AT, 3000, 1, 20, 5.0, 0.02), {}),
    StartCase("magnetic bearing", LEVITATION, LEVITATION_AT, levitated, {"focus": "simulation"}),
    StartCase("gyroscopic pair", PAIR, PAIR_AT, _open_loop(PAIR, PAIR_AT, 3000, 2, 3, 1e-2, 0.1), {}),
    StartCase("lag with dead time", LATE_LAG, LATE_LAG_AT, _open_loop(LATE_LAG, LATE_LAG_AT, 1500, 1, 6, 0.1, 0.1), {}),
    StartCase("pendulum, free decays", PENDULUM, PENDULUM_AT, swings, {}),
    StartCase(
        "rotor in a gas bearing",
        ROTOR,
        KEY,
        lambda seed: recorded(ROTOR, KEY, piezo_motion(8000, seed), TS, seed, 0.03, hold="foh"),
        {},
    ),
    StartCase(
        "piezo pair",
        PiezoPair(),
        ACTUATORS,
        lambda seed: recorded(PiezoPair(), ACTUATORS, 4.5e-6 * levels(5000, 2, 20, seed), TS, seed, 0.02),
        {},
    ),
)
