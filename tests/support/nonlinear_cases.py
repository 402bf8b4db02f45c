"""Nonlinear structures and recordings of the tests."""

from __future__ import annotations

import numpy as np

from gbid import LinearStructure, NonlinearStructure, Parameter, Recording
from gbid.structure import nonlinear_model

LINEAR_TRUTH = {"k": 100.0, "d": 1.0, "b": 3.5, "g1": 2.0, "g2": 1.0}
_KNOWN = [Parameter("k", 90.0), Parameter("d", 1.2), Parameter("b", 3.0), Parameter("g1", 0.5), Parameter("g2", 1.0)]
SAME = {
    "linear": LinearStructure(
        "mass",
        _KNOWN,
        lambda p: {"A": [[0, 1], [-p.k, -p.d]], "B": [[0], [p.b]], "C": [[1, 0]], "K": [[p.g1], [p.g2]]},
        intersample="foh",
    ),
    "nonlinear": NonlinearStructure(
        "mass",
        _KNOWN,
        ["x", "v"],
        lambda x, u, p: [x[1], -p.k * x[0] - p.d * x[1] + p.b * u[0]],
        lambda x, _u, _p: x[0],
        intersample="foh",
        disturbance_gain=lambda p: [[p.g1], [p.g2]],
        steps=16,
    ),
}
"""The same equations, as a linear and as a nonlinear structure."""

DUFFING_TRUTH = {"k": 1.0, "d": 0.2, "c": 0.5}
DUFFING = NonlinearStructure(
    "duffing",
    [Parameter("k", 0.8), Parameter("d", 0.3), Parameter("c", 0.8)],
    ["x", "v"],
    lambda x, u, p: [x[1], u[0] - p.d * x[1] - p.k * x[0] - p.c * x[0] ** 3],
    lambda x, _u, _p: x[0],
)


def mass_recording(seed: int, n: int = 1200) -> Recording:
    """Return a recording of `SAME` with the disturbance of its innovations form."""
    rng = np.random.default_rng(seed)
    u = np.cumsum(rng.normal(size=(n, 1)), axis=0) * 0.1
    e, y = 0.002 * rng.normal(size=(n, 1)), np.zeros((n, 1))
    model, x = nonlinear_model(SAME["nonlinear"], LINEAR_TRUTH, steps=16), np.zeros(2)
    step = model.step_function(["foh"], feeds_back=True)
    for k in range(n):
        y[k] = x[0] + e[k]
        x = np.array(
            step(x, np.array([[u[min(k + 1, n - 1), 0], u[k, 0], 0.0]]), y[k], model.parameters, 0.02)[0], float
        ).ravel()
    return Recording({"u": u, "y": y}, 0.02, name=f"mass {seed}")


def duffing_recording(seed: int, n: int = 1000, noise: float = 0.01, steps: int = 8) -> Recording:
    """Return a recording of a Duffing oscillator under a random binary force with measurement noise."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.choice([-1.0, 1.0], n // 20 + 1), 20)[:n, None]
    y = nonlinear_model(DUFFING, DUFFING_TRUTH, steps=steps).simulate(u, 0.1)
    return Recording({"u": u, "y": y + noise * rng.normal(size=y.shape)}, 0.1, name=f"duffing {seed}")
