"""Random design problems: loops of all sizes and scales, unstable, uncontrollable, defective, undefined in places."""

from __future__ import annotations

from typing import Any, NamedTuple

import casadi as ca
import numpy as np


class RandomProblem(NamedTuple):
    """Closed-loop matrix of gains, their number, bounds, and what is asked for."""

    function: Any
    n_gains: int
    lower: float
    upper: float
    objective: str
    kind: str


KINDS = ("plain", "dynamic", "nan", "infinite", "uncontrollable", "repeated", "integrators", "scaled", "constant")


def random_problem(seed: int) -> RandomProblem:
    """Problem of a seed: 1 to 40 states, 1 to 16 gains, scales of 1e-9 to 1e9."""
    rng = np.random.default_rng(seed)
    kind = KINDS[seed % len(KINDS)]
    n, d = int(rng.integers(1, 41)), int(rng.integers(1, 17))
    A = rng.normal(size=(n, n)) / np.sqrt(n) + (rng.normal() - 1.0) * np.eye(n)
    g = ca.SX.sym("g", d)
    if kind == "repeated":
        A = rng.normal() * np.eye(n) + np.diag(np.ones(n - 1), 1)
    elif kind == "integrators":
        A = np.diag(np.ones(n - 1), 1)
    elif kind == "uncontrollable":
        A[n // 2 :, : n // 2] = 0.0
    m, p = 1 + d // 4, 4
    K = ca.reshape(ca.vertcat(g, ca.SX.zeros(m * p - d)), m, p) if m * p > d else ca.reshape(g, 1, d)
    B, C = rng.normal(size=(n, K.shape[0])), rng.normal(size=(K.shape[1], n))
    if kind == "uncontrollable":
        B[n // 2 :] = 0.0
    matrix = A + ca.SX(B) @ K @ ca.SX(C)
    if kind == "dynamic":
        block = ca.SX.zeros(2, 2)
        block[0, 0], block[1, 1] = g[0], g[-1]
        matrix = ca.diagcat(matrix, block)
    elif kind == "nan":
        matrix = matrix + ca.sqrt(g[0]) * 0.1
    elif kind == "infinite":
        matrix = matrix + 1e-3 / g[0]
    elif kind == "constant":
        matrix = ca.SX(A) + 0 * g[0]
    scale = 10.0 ** rng.uniform(-9, 9) if kind == "scaled" else 1.0
    width = 10.0 ** rng.uniform(-2, 3)
    function = ca.Function("A", [g], [scale * matrix])
    return RandomProblem(function, d, -width, width, "decay" if rng.random() < 0.5 else "damping", kind)
