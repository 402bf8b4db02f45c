"""Curvature of the functions that determine a step, for the next one."""

from __future__ import annotations

import numpy as np

from gbid.arrays import FloatArray
from gbid.control.tuning.search.problem import GainProblem
from gbid.control.tuning.search.steps.ridge_step import RidgeStep

_DIFFERENCE = 1e-6


def curvature_by_differences(problem: GainProblem, x: FloatArray, step: RidgeStep) -> FloatArray:
    """Return the second derivative of the weighted functions, by differences of their gradients, made convex.

    Means of clusters are left out: they need a Schur form for every gain and change the steps little.
    """
    width = problem.upper - problem.lower
    weights = [(piece, weight) for piece, weight in step.weights if piece.kind != "cluster"]
    if not weights:
        return np.zeros((len(x), len(x)))
    h = np.where(x + _DIFFERENCE * width > problem.upper, -_DIFFERENCE, _DIFFERENCE) * width
    slopes = problem.slopes_at([piece for piece, _ in weights], [x, *(x + np.diag(h))])
    signs = np.array([-w if piece.kind == "aim" else w for piece, w in weights])
    # functions without a gradient at a nearby design are left out
    return _convex(np.einsum("n,qnd->qd", signs, np.nan_to_num((slopes[1:] - slopes[0]) / h[:, None, None])))


def _convex(H: FloatArray) -> FloatArray:
    values, vectors = np.linalg.eigh((H + H.T) / 2)
    return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T)
