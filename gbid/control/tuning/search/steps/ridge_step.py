"""Step of the gains along the ridges between the functions near the worst one, by a quadratic programme."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gbid.arrays import FloatArray
from gbid.control.tuning.search.nonsmooth.active import ActiveFunction, ActiveFunctions
from gbid.control.tuning.search.steps.quadratic_programme import quadratic_programme

_RIDGES = (1e-9, 1e-6, 1e-4)
"""Curvature that is added to a step's quadratic programme; more when the solver fails with less."""


@dataclass(frozen=True)
class RidgeStep:
    """Move of the gains, the promised gain in merit, and the weights of the active functions."""

    move: FloatArray
    gain: float
    weights: tuple[tuple[ActiveFunction, float], ...]
    limit_weight: float
    keeps_limits: bool


def ridge_step(
    functions: ActiveFunctions,
    aim: list[ActiveFunction],
    equalities: list[tuple[float, FloatArray]],
    H: FloatArray,
    width: FloatArray,
    box: tuple[FloatArray, FloatArray],
    penalty: float,
) -> RidgeStep | None:
    """Return the solution of the quadratic programme for the move (in units of the box) and for t and s.

    Parameters
    ----------
    functions : ActiveFunctions
        Score and functions of the limits.
    aim : list of ActiveFunction
        Functions of the objective.
    equalities : list of (value, gradient)
        Functions that become zero.
    H : (d, d) array
        Curvature.
    width : (d,) array
        Widths of the bounds.
    box : (lower, upper)
        Bounds of the move.
    penalty : float
        Weight of the largest violation.

    Returns
    -------
    RidgeStep, or None when there is no solution.
    """
    d, now = len(width), functions.score.value
    reach = np.maximum(box[1] - box[0], 1e-300)
    size = float(np.max(reach / width))
    limits = functions.limits
    n_aim, n_held = len(aim), len(aim) + len(limits)
    rows = np.zeros((n_held + len(equalities), d + 2))
    low, high = np.zeros(len(rows)), np.full(len(rows), np.inf)
    if aim:
        rows[:n_aim, :d] = np.array([piece.slope for piece in aim]) * (reach / size)
        rows[:n_aim, d] = -1.0
        low[:n_aim] = (now - np.array([piece.value for piece in aim])) / size
    if limits:
        rows[n_aim:n_held, :d] = np.array([piece.slope for piece in limits]) * (-reach / size)
        rows[n_aim:n_held, d + 1] = 1.0
        low[n_aim:n_held] = np.array([piece.value for piece in limits]) / size
    if equalities:
        scaled = np.array([slope for _, slope in equalities]) * reach
        norm = np.maximum(np.sqrt((scaled * scaled).sum(axis=1)), 1e-300)
        rows[n_held:, :d] = scaled / norm[:, None]
        low[n_held:] = high[n_held:] = -np.array([value for value, _ in equalities]) / norm
    curve = np.zeros((d + 2, d + 2))
    curve[:d, :d] = H * (reach[:, None] * reach / size)
    # a sum is finite when its terms are
    if not np.isfinite(rows.sum() + low.sum() + curve.sum()):
        return None
    linear = np.zeros(d + 2)
    linear[d:] = -1.0, penalty
    # without active functions of the objective (all modes real) t has the largest possible value as its bound
    lower, upper = np.empty(d + 2), np.empty(d + 2)
    lower[:d], upper[:d] = box[0] / reach, box[1] / reach
    lower[d:], upper[d:] = (-1e6, 0.0), ((1.0 - now) / size + 1.0 if not aim else 1e6, 1e6)
    if equalities and not _within_reach(rows[n_held:], low[n_held:], lower, upper):
        return None
    # gradients of eigenvalues that nearly meet are very large; rows of equal length keep the programme well scaled
    length = np.maximum(np.abs(rows).max(axis=1), 1.0)
    rows, low, high = rows / length[:, None], low / length, high / length
    programme, diagonal, added = quadratic_programme(d + 2, len(rows)), np.arange(d + 2), 0.0
    solution = None
    for ridge in _RIDGES:
        curve[diagonal, diagonal] += ridge - added
        solution, added = programme.solve(curve, linear, rows, low, high, lower, upper), ridge
        if solution is not None or programme.infeasible:
            break
    if solution is None:
        return None
    y, duals = solution[0], np.abs(solution[1] / length)
    gain = float(y[d] - penalty * y[d + 1]) * size + penalty * functions.score.violation
    held = [*aim, *limits]
    weights = tuple((held[i], float(duals[i])) for i in np.flatnonzero(duals[:n_held] > 1e-9))
    return RidgeStep(y[:d] * reach, gain, weights, float(duals[n_aim:n_held].sum()), bool(y[d + 1] < 1e-7))


def _within_reach(rows: FloatArray, sides: FloatArray, lower: FloatArray, upper: FloatArray) -> bool:
    """Return whether each equality has a solution within the bounds."""
    ends = rows * lower, rows * upper
    least, most = np.minimum(*ends).sum(axis=1), np.maximum(*ends).sum(axis=1)
    return bool(((least <= sides) & (sides <= most)).all())
