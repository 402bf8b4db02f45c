"""Local optimisation of the worst of many eigenvalues and peaks by sequential quadratic programming (SQP)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np

from gbid.arrays import FloatArray
from gbid.control.tuning.search.nonsmooth.active import ActiveFunction, ActiveFunctions, Score, merit
from gbid.control.tuning.search.nonsmooth.certificate import Certificate
from gbid.control.tuning.search.nonsmooth.meetings import back_to_meeting, meetings
from gbid.control.tuning.search.problem import GainProblem


@dataclass(frozen=True)
class LocalOptimum:
    """Local optimum: gains, score, iterations, whether the optimisation ended by itself, and its certificate."""

    x: FloatArray
    score: Score
    iterations: int
    converged: bool
    certificate: Certificate | None = None


_PENALTY = 10.0
_DIFFERENCE = 1e-6
_RIDGES = (1e-9, 1e-6, 1e-4)
"""Curvature that is added to a step's quadratic programme; more when the solver fails with less."""


def optimise_locally(
    problem: GainProblem,
    start: FloatArray,
    *,
    radius: float = 0.1,
    max_iterations: int = 200,
    tolerance: float = 1e-9,
    curvature: bool = True,
    on_step: Callable[[int, Score], None] | None = None,
) -> LocalOptimum:
    r"""Return a local optimum.

    Each step solves, for the move d of the gains within a trust region,

    .. math:: \max\; t - \rho s - \tfrac12 d^T H d \quad\text{with}\quad
              f_j + g_j d \ge t,\;\; c_k + a_k d \le s,\;\; s \ge 0

    over all functions f (damping factors) of the objective and c of the limits near the worst. H is the curvature of
    the functions that were active in the step before. Where two eigenvalues a, b meet, their gradients are unbounded.
    There a second step is computed with their mean and with ``((a - b)/2)^2 = 0`` as a constraint, because both are
    smooth (at the optimum the two coalesce: Burke, Lewis, Overton, 2001). The better step is taken.

    Parameters
    ----------
    problem : GainProblem
        The design problem.
    start : (d,) array
        Start value of the gains.
    radius : float
        Initial trust region, as a share of the width of the bounds.
    max_iterations : int
        Largest number of iterations.
    tolerance : float
        Smallest trust region, in the same unit; the optimisation then ends.
    curvature : bool
        Whether H is computed (by differences of the gradients) or zero.
    on_step : callable, optional
        Called with iteration and score.

    Returns
    -------
    LocalOptimum
    """
    x = np.clip(start, problem.lower, problem.upper)
    found = _climb(problem, x, radius, max_iterations, tolerance, curvature, _PENALTY, on_step)
    if 1e-8 < found.score.violation < 0.1:
        again = _climb(problem, found.x, 1e-3, 40, tolerance, curvature, 1e3 * _PENALTY, on_step)
        found = replace(again, iterations=found.iterations + again.iterations)
    return found


def _climb(
    problem: GainProblem,
    x: FloatArray,
    radius: float,
    max_iterations: int,
    tolerance: float,
    curvature: bool,
    penalty: float,
    on_step: Callable[[int, Score], None] | None,
) -> LocalOptimum:
    width = problem.upper - problem.lower
    H = np.zeros((len(x), len(x)))
    functions = problem.functions(x)
    stalled, milestone = 0, merit(functions.score, penalty)
    for iteration in range(1, max_iterations + 1):
        if not functions.score.usable or problem.exhausted:
            return LocalOptimum(x, functions.score, iteration, False)
        box = np.maximum(-radius * width, problem.lower - x), np.minimum(radius * width, problem.upper - x)
        # peaks are not computed for a design whose objective alone is below the present merit
        floor = merit(functions.score, penalty)
        plain = _step(functions, list(functions.aim), [], H, width, box, penalty)
        best, improvement = plain, -np.inf
        if plain is not None:
            penalty = max(penalty, 2.0 * plain.limit_weight if plain.keeps_limits else 0.0)
            improvement = merit(problem.score(x + plain.move, floor), penalty) - floor
        met: list[_Step] = []
        if plain is None or improvement < 0.5 * plain.gain or plain.gain <= 1e-13:
            met = _meeting_steps(problem, x, functions, H, width, box, penalty)
        for step in met:
            penalty = max(penalty, 2.0 * step.limit_weight if step.keeps_limits else 0.0)
            gained = merit(problem.score(x + step.move, floor), penalty) - floor
            if gained > improvement:
                best, improvement = step, gained
        if plain is not None and max([plain.gain, *(step.gain for step in met)]) <= 1e-13:
            return LocalOptimum(x, functions.score, iteration, True)
        # a step with meeting eigenvalues may promise a loss, but it is accepted only when it improves the merit
        promised = np.inf if best is None else max(best.gain, 0.0)
        good = improvement > 0.05 * promised
        if best is not None and (good or improvement > 1e-7):
            x = np.clip(x + best.move, problem.lower, problem.upper)
            functions = problem.functions(x)
            if on_step is not None:
                on_step(iteration, functions.score)
            if curvature:
                H = _curvature(problem, x, best)
        if improvement > 0.5 * promised:
            radius = min(2 * radius, 0.5)
        elif not good:
            radius *= 0.35
        stalled = stalled + 1 if improvement < 1e-9 else 0
        creeps = False
        if iteration % 30 == 0:
            reached = merit(functions.score, penalty)
            creeps, milestone = reached - milestone < 1e-5, reached
        if radius < tolerance or stalled > 12 or creeps:
            return LocalOptimum(x, functions.score, iteration, True)
    return LocalOptimum(x, functions.score, max_iterations, False)


@dataclass(frozen=True)
class _Step:
    """Move of the gains, the promised gain in merit, and the weights of the active functions."""

    move: FloatArray
    gain: float
    weights: tuple[tuple[ActiveFunction, float], ...]
    limit_weight: float
    keeps_limits: bool


def _meeting_steps(
    problem: GainProblem,
    x: FloatArray,
    functions: ActiveFunctions,
    H: FloatArray,
    width: FloatArray,
    box: tuple[FloatArray, FloatArray],
    penalty: float,
) -> list[_Step]:
    """Return steps at whose ends eigenvalues meet."""
    found = []
    for group in meetings(problem, x, functions):
        keep = [piece for piece in functions.aim if not any(one.holds(piece) for one in group)]
        means = tuple(one.mean for one in group)
        rows = [row for one in group for row in one.rows]
        step = _step(functions, [*keep, *means], rows, H, width, box, penalty)
        if step is not None:
            found.append(replace(step, move=back_to_meeting(problem, x, step.move, means)))
    return found


def _step(
    functions: ActiveFunctions,
    aim: list[ActiveFunction],
    equalities: list[tuple[float, FloatArray]],
    H: FloatArray,
    width: FloatArray,
    box: tuple[FloatArray, FloatArray],
    penalty: float,
) -> _Step | None:
    """Return the solution of the quadratic programme for the move (in units of the box) and for t and s."""
    d, now = len(width), functions.score.value
    reach = np.maximum(box[1] - box[0], 1e-300)
    size = float(np.max(reach / width))
    rows, low, high = [], [], []
    for piece in aim:
        rows.append(np.concatenate([piece.slope * reach / size, [-1.0, 0.0]]))
        low.append((now - piece.value) / size)
        high.append(np.inf)
    for piece in functions.limits:
        rows.append(np.concatenate([-piece.slope * reach / size, [0.0, 1.0]]))
        low.append(piece.value / size)
        high.append(np.inf)
    for value, slope in equalities:
        norm = max(float(np.linalg.norm(slope * reach)), 1e-300)
        rows.append(np.concatenate([slope * reach / norm, [0.0, 0.0]]))
        low.append(-value / norm)
        high.append(-value / norm)
    curve = np.zeros((d + 2, d + 2))
    curve[:d, :d] += H * np.outer(reach, reach) / size
    linear = np.concatenate([np.zeros(d), [-1.0, penalty]])
    # without active functions of the objective (all modes real) t has the largest possible value as its bound
    lower = np.concatenate([box[0] / reach, [-1e6, 0.0]])
    upper = np.concatenate([box[1] / reach, [(1.0 - now) / size + 1.0 if not aim else 1e6, 1e6]])
    # gradients of eigenvalues that nearly meet are very large; rows of equal length keep the programme well scaled
    A = np.array(rows).reshape(-1, d + 2)
    if not (np.isfinite(A).all() and np.isfinite(low).all() and np.isfinite(curve).all()):
        return None
    length = np.maximum(np.abs(A).max(axis=1, initial=0.0), 1.0)
    A, sides = A / length[:, None], (np.array(low) / length, np.array(high) / length)
    solution = None
    for ridge in _RIDGES:
        solution = solution or _solve(curve + ridge * np.eye(d + 2), linear, A, *sides, lower, upper)
    if solution is None:
        return None
    y, duals = solution[0], solution[1] / length
    gain = float(y[d] - penalty * y[d + 1]) * size + penalty * functions.score.violation
    held = [*aim, *functions.limits]
    weights = tuple((piece, float(abs(w))) for piece, w in zip(held, duals, strict=False) if abs(w) > 1e-9)
    limit_weight = float(np.abs(duals[len(aim) : len(held)]).sum())
    return _Step(y[:d] * reach, gain, weights, limit_weight, bool(y[d + 1] < 1e-7))


@lru_cache(maxsize=64)
def _solver(n: int, m: int) -> Any:
    shapes = {"h": ca.Sparsity.dense(n, n), "a": ca.Sparsity.dense(m, n)}
    return ca.conic("step", "daqp", shapes, {"error_on_fail": False})


def _solve(
    H: FloatArray, g: FloatArray, A: FloatArray, low: FloatArray, high: FloatArray, lower: FloatArray, upper: FloatArray
) -> tuple[FloatArray, FloatArray] | None:
    """Return the solution of a small convex quadratic programme by CasADi's DAQP, or None."""
    solver = _solver(len(g), len(A))
    try:
        answer: dict[str, Any] = solver(h=H, g=g, a=A, lba=low, uba=high, lbx=lower, ubx=upper)
    except RuntimeError:  # the solver finds its numbers unfit: the step is given up, and the trust region shrinks
        return None
    y = answer["x"].full()[:, 0]
    if not (solver.stats()["success"] and np.isfinite(y).all()):
        return None
    return y, answer["lam_a"].full()[:, 0]


def _curvature(problem: GainProblem, x: FloatArray, step: _Step) -> FloatArray:
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
    H = np.einsum("n,qnd->qd", signs, np.nan_to_num((slopes[1:] - slopes[0]) / h[:, None, None]))
    values, vectors = np.linalg.eigh((H + H.T) / 2)
    return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T)
