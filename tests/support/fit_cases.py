"""Structures, data and plain loops that the tests of identification share."""

import casadi as ca
import numpy as np
import pytest
from scipy.linalg import expm

from gbid.identify.data import FitData, Record
from gbid.lpv import load_model
from gbid.recording import Recording
from gbid.structure import LinearStructure, Parameter, PiezoPair, evaluate

H = 0.1  # sample time of the small structures [s]
TS = 2e-4  # sample time of the rotor [s]
POINT = (5.0, 6000.0)

KEY = dict(load_model("theisen2016").key_parameters(*POINT))
ACTUATORS = dict(load_model("theisen2016").actuators)

# ---- a small structure in which every matrix depends on the parameters ----


def _every_matrix(p):
    return {
        "A": [[-p.a, p.w], [-p.w, -0.3 * p.a]],
        "B": [[1.0, p.b], [0.2, 1.0]],
        "C": [[1.0, p.c], [p.a, 0.5]],
        "D": [[p.d, 0.0], [0.1, p.d]],
        "K": [[p.k, 0.0], [0.3, p.k]],
    }


EVERY = LinearStructure("every", [Parameter(name) for name in "awbcdk"], _every_matrix, "u", "y")
EVERY_AT = {"a": 0.8, "w": 3.0, "b": -0.5, "c": 0.7, "d": 0.15, "k": 1.2}

# ---- a delayed input beside one that acts at once, also by a feedthrough ----

LATE = LinearStructure(
    "late",
    [Parameter("a", 2.0, 0.0), Parameter("w", 4.0, 0.0), Parameter("b", 1.0), Parameter("tau", 0.3, 0.0, 1.0)],
    lambda p: {
        "A": [[0, 1], [-p.w * p.w, -p.a]],
        "B": [[0, 0], [0, p.b]],
        "B_delayed": [[0, 0], [p.b * p.w, 0]],
        "delay": [p.tau, 0],
        "C": [[1, 0.3 * p.b], [0, p.a]],
        "D": [[0, p.b], [0, 0]],
    },
)
LATE_AT = {"a": 1.2, "w": 5.0, "b": 1.5, "tau": 0.234}

# ---- one mode and its gain: the smallest fit that is not linear in its parameters ----


def _mode(p):
    return {
        "A": [[0, 1], [-p.w * p.w, -2 * p.z * p.w]],
        "B": [[0], [p.g * p.w * p.w]],
        "C": [[1, 0]],
        "K": [[p.l1], [p.l2]],
    }


MODE = LinearStructure(
    "mode",
    [
        Parameter("w", 6.0, lower=0.1, upper=30.0, unit="rad/s"),
        Parameter("z", 0.1, lower=0.0, upper=1.0),
        Parameter("g", 1.0),
        Parameter("l1", 0.0),
        Parameter("l2", 0.0),
    ],
    _mode,
)
MODE_AT = {"w": 5.0, "z": 0.05, "g": 2.0, "l1": 0.0, "l2": 0.0}


def levels(n, n_inputs=1, hold=4, seed=0):
    """Random binary inputs of amplitude one, (n, n_inputs)."""
    random = np.random.default_rng(seed)
    return np.repeat(random.choice([-1.0, 1.0], (-(-n // hold), n_inputs)), hold, axis=0)[:n]


def smooth(n, n_inputs=2, seed=0):
    """Sums of sines that no hold passes over, (n, n_inputs)."""
    random = np.random.default_rng(seed)
    t = np.arange(n)[:, None]
    return sum(
        random.normal(size=n_inputs) * np.sin(random.uniform(0.02, 0.6) * t + random.uniform(0, 6, n_inputs))
        for _ in range(6)
    )


def simulated(structure, values, u, *, h=H, hold="zoh", x0=None, noise=0.0, seed=1, name="data"):
    """Recording of a structure at given values, white noise added to the output."""
    model = evaluate(structure, values)
    y = model.simulate(u, h, initial_state=x0, intersample=hold)
    y = y + noise * np.random.default_rng(seed).normal(size=y.shape)
    parts = np.split(y, len(structure.outputs), axis=1)  # u and p of a plant have two channels each
    return Recording({structure.inputs[0]: u, **dict(zip(structure.outputs, parts, strict=True))}, h, name=name)


def innovations(structure, values, u, *, noise, h=H, seed=1, name="data"):
    """Recording of ``xd = A x + B u + K e``, ``y = C x + D u + e`` with everything held between samples."""
    model = evaluate(structure, values).discretise(h)
    e = noise * np.random.default_rng(seed).normal(size=(len(u), len(model.C)))
    x, y = np.zeros(model.n_states), np.empty_like(e)
    for k in range(len(u)):
        y[k] = model.C @ x + model.D @ u[k] + e[k]
        x = model.A @ x + model.B @ u[k] + model.K @ e[k]
    return Recording({"u": u, "y": y}, h, name=name)


def piezo_motion(n, seed=0, hold=40):
    """Piezo positions as the actuators make them of binary references [m], (n, 2)."""
    return evaluate(PiezoPair(), ACTUATORS).simulate(4.5e-6 * levels(n, 2, hold, seed), TS)


def fit_data(records, h=H):
    """FitData of (u, y) pairs."""
    n_u, n_y = records[0][0].shape[1], records[0][1].shape[1]
    return FitData(
        tuple(Record(f"r{i}", np.asarray(u, float), np.asarray(y, float)) for i, (u, y) in enumerate(records)),
        h,
        tuple(f"u{i}" for i in range(n_u)),
        tuple(f"y{i}" for i in range(n_y)),
        ("",) * n_y,
    )


def predicted(model, u, y, h, holds, x0, feedback):
    """One-step-ahead outputs by the plain loop; each sample by one exponential of state, input, slope and error."""
    A, B, C, D = model.A, model.B, model.C, model.D
    K = model.K if feedback else np.zeros((len(A), len(C)))
    n, n_u, n_y = len(A), B.shape[1], len(C)
    m = n + 2 * n_u + n_y
    big = np.zeros((m, m))
    big[:n] = np.hstack([A, B, np.zeros((n, n_u)), K])
    big[n : n + n_u, n + n_u : n + 2 * n_u] = np.eye(n_u)
    step = expm(big * h)[:n]
    linear = np.array([hold == "foh" for hold in holds])
    x, rows = np.asarray(x0, float), []
    for k in range(len(u)):
        yhat = C @ x + D @ u[k]
        rows.append(yhat)
        if k + 1 < len(u):
            slope = linear * (u[k + 1] - u[k]) / h
            x = step @ np.concatenate([x, u[k], slope, y[k] - yhat])
    return np.array(rows)


def assert_derivatives(problem, n):
    """Compare gradient and Jacobian of a fit problem with differences in its first `n` variables, near the start."""
    x = problem.start + 0.01 * np.random.default_rng(0).standard_normal(len(problem.start))
    gradient, jacobian = np.asarray(problem.gradient(x)).ravel(), np.asarray(ca.DM(problem.jacobian(x)))
    for i in range(n):
        step = np.eye(len(x))[i] * 1e-5
        after, before = (float(problem.cost(x + s)) for s in (step, -step))
        assert gradient[i] == pytest.approx((after - before) / 2e-5, rel=1e-5, abs=1e-8)
        rows = [np.asarray(problem.constraints(x + s)).ravel() for s in (step, -step)]
        np.testing.assert_allclose(jacobian[:, i], (rows[0] - rows[1]) / 2e-5, rtol=1e-4, atol=1e-7)
