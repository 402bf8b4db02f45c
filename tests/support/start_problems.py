"""Ten structures with data of known parameters, and random starts of any sign."""

from dataclasses import dataclass, field
from functools import cache

import numpy as np
from scipy.linalg import expm, solve_continuous_are

from gbid import LinearStructure, Parameter, Recording
from gbid.structure import evaluate

SPRING = {"k": 1000.0, "d": 2.0, "b": 50.0}
MAGLEV = {"a": 1600.0, "b": 30.0, "r": 25.0, "l": 40.0}


@dataclass(frozen=True)
class StartProblem:
    """A structure, a recording of it, its true parameters, and how to fit it."""

    structure: LinearStructure
    recording: Recording
    true: dict
    options: dict = field(default_factory=dict)


def _held_levels(n, hold, rng, channels=1):
    return np.column_stack([np.repeat(rng.choice([-1.0, 1.0], -(-n // hold)), hold)[:n] for _ in range(channels)])


def _structure(name, true, matrices, inputs="u"):
    return LinearStructure(name, [Parameter(key, v) for key, v in true.items()], matrices, inputs, "y")


def _simulated(structure, true, u, h, noise, rng, start=None, **options):
    """Simulation with white noise of a size relative to the outputs."""
    more = {} if start is None else {"initial_state": np.array(start)}
    y = evaluate(structure, true).simulate(u, h, **more)
    y = y + noise * y.std(axis=0) * rng.standard_normal(y.shape)
    signals = {"y": y} | ({"u": u} if u.shape[1] else {})
    return StartProblem(structure, Recording(signals, h), true, {"focus": "simulation", **options})


def _recursion(structure, true, reference, h, noise, rng, weights=None, **options):
    """Recursion with process noise by the disturbance gain, under state feedback for an unstable plant."""
    m = evaluate(structure, true)
    n, n_y = len(m.A), len(m.C)
    gain = np.zeros((1, n)) if weights is None else m.B.T @ solve_continuous_are(m.A, m.B, np.diag(weights), np.eye(1))
    K = np.zeros((n, n_y)) if m.K is None else m.K
    held = expm(np.block([[m.A, m.B, K], [np.zeros((1 + n_y, n + 1 + n_y))]]) * h)[:n]
    x, inputs, outputs = np.zeros(n), [], []
    for r in reference:
        e = noise * rng.standard_normal(n_y)
        u = r - gain @ x
        inputs.append(u)
        outputs.append(m.C @ x + e)
        x = held @ np.concatenate([x, u, e])
    return StartProblem(structure, Recording({"u": np.array(inputs), "y": np.array(outputs)}, h), true, options)


def _spring(p):
    return {"A": [[0, 1], [-p.k, -p.d]], "B": [[0], [p.b]], "C": [[1, 0]]}


def spring(rng):
    return _simulated(_structure("spring", SPRING, _spring), SPRING, _held_levels(2000, 20, rng), 5e-3, 0.02, rng)


def spring_with_gain(rng):
    true = {**SPRING, "g1": 10.0, "g2": 50.0}
    structure = _structure("spring with gain", true, lambda p: {**_spring(p), "K": [[p.g1], [p.g2]]})
    return _recursion(structure, true, _held_levels(2000, 20, rng), 5e-3, 2e-3, rng)


def lag(rng):
    true = {"a": 3.0, "g": 2.0}
    structure = _structure("lag", true, lambda p: {"A": [[-p.a]], "B": [[p.g]], "C": [[1]]})
    return _simulated(structure, true, _held_levels(1000, 20, rng), 0.02, 0.1, rng)


def two_masses(rng):
    true = {"k1": 900.0, "k2": 400.0, "d1": 2.0, "d2": 1.0, "b": 30.0}

    def matrices(p):
        first = [-p.k1 - p.k2, p.k2, -p.d1 - p.d2, p.d2]
        A = [[0, 0, 1, 0], [0, 0, 0, 1], first, [p.k2, -p.k2, p.d2, -p.d2]]
        return {"A": A, "B": [[0], [0], [p.b], [0]], "C": [[1, 0, 0, 0], [0, 1, 0, 0]]}

    return _simulated(_structure("two masses", true, matrices), true, _held_levels(3000, 15, rng), 0.01, 0.02, rng)


def motor(rng):
    true = {"b1": 4.0, "K2": 20.0}
    structure = _structure("motor", true, lambda p: {"A": [[0, 1], [0, -p.b1]], "B": [[0], [p.K2]], "C": [[1, 0]]})
    return _simulated(structure, true, _held_levels(1500, 10, rng), 0.01, 0.01, rng)


def cross_coupled(rng):
    true = {"kx": 900.0, "ky": 1100.0, "c": 60.0, "d": 3.0, "b": 40.0}

    def matrices(p):
        A = [[0, 0, 1, 0], [0, 0, 0, 1], [-p.kx, -p.c, -p.d, 0], [p.c, -p.ky, 0, -p.d]]
        return {"A": A, "B": [[0, 0], [0, 0], [p.b, 0], [0, p.b]], "C": [[1, 0, 0, 0], [0, 1, 0, 0]]}

    u = _held_levels(3000, 15, rng, 2)
    return _simulated(_structure("cross-coupled", true, matrices), true, u, 5e-3, 0.03, rng, criterion="det")


def _maglev(p):
    """Body above a magnet, per unit mass, and the current of the coil: unstable, three states."""
    return {"A": [[0, 1, 0], [p.a, 0, -p.b], [0, 0, -p.r]], "B": [[0], [0], [p.l]], "C": [[1, 0, 0], [0, 0, 1]]}


def maglev(rng, n=4000):
    """Magnetic levitation under feedback: position and current are measured with white noise."""
    made = _recursion(
        _structure("maglev", MAGLEV, _maglev), MAGLEV, 20 * _held_levels(n, 40, rng), 1e-3, 0.0, rng, (1e4, 1, 1)
    )
    y = made.recording.signal("y")
    y = y + 1e-2 * y.std(axis=0) * rng.standard_normal(y.shape)
    options = {"focus": "simulation", "criterion": "det"}
    return StartProblem(made.structure, made.recording.with_signals(y=y), MAGLEV, options)


def pendulum(rng):
    """Inverted pendulum under feedback, with a disturbance gain."""
    true = {"a": 25.0, "d": 0.5, "b": 10.0, "g1": 10.0, "g2": 50.0}
    structure = _structure(
        "pendulum",
        true,
        lambda p: {"A": [[0, 1], [p.a, -p.d]], "B": [[0], [p.b]], "C": [[1, 0]], "K": [[p.g1], [p.g2]]},
    )
    return _recursion(structure, true, 5 * _held_levels(2000, 30, rng), 0.01, 0.01, rng, (100.0, 1.0))


def free_decay(rng):
    true = {"k": 4000.0, "d": 3.0}
    structure = _structure("decay", true, lambda p: {"A": [[0, 1], [-p.k, -p.d]], "C": [[1, 0]]}, ())
    return _simulated(structure, true, np.zeros((1500, 0)), 2e-3, 0.06, rng, (1.0, 0.0))


def delayed_mode(rng):
    true = {"k": 400.0, "d": 4.0, "b": 40.0, "tau": 0.013}
    parameters = [
        *(Parameter(name, true[name]) for name in "kdb"),
        Parameter("tau", true["tau"], lower=0.0, upper=0.05),
    ]

    def matrices(p):
        delayed = {"B": [[0], [0]], "B_delayed": [[0], [p.b]], "delay": [p.tau]}
        return {"A": [[0, 1], [-p.k, -p.d]], "C": [[1, 0]], **delayed}

    structure = LinearStructure("delayed", parameters, matrices, "u", "y")
    return _simulated(structure, true, _held_levels(2000, 15, rng), 0.01, 0.02, rng)


_MADE = (spring, spring_with_gain, lag, two_masses, motor, cross_coupled, maglev, pendulum, free_decay, delayed_mode)
START_PROBLEMS = {make.__name__: make for make in _MADE}


@cache
def start_problem(name, seed=7):
    """One of the ten problems by name."""
    return START_PROBLEMS[name](np.random.default_rng(seed))


def random_start(problem, rng):
    """Start within a factor of ten of the truth, a third of the signs wrong: every other start is unstable."""
    drawn = {}
    for q in problem.structure.parameters:
        size = problem.true[q.name] * 10 ** rng.uniform(-1, 1)
        drawn[q.name] = float(np.clip(size if rng.random() < 0.65 else -size, q.lower, q.upper))
    return drawn
