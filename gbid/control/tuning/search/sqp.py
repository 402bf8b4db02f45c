"""Local optimisation of the worst of many eigenvalues and peaks by sequential quadratic programming (SQP)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np

from gbid.arrays import FloatArray
from gbid.control.tuning.search.problem import ActiveFunction, ActiveFunctions, GainProblem, Score


@dataclass(frozen=True)
class LocalOptimum:
    """Local optimum: gains, score, number of iterations, and whether the optimisation converged."""

    x: FloatArray
    score: Score
    iterations: int
    converged: bool


_PENALTY = 10.0
_DIFFERENCE = 1e-6


def merit(score: Score, penalty: float) -> float:
    """Return the merit to be maximised: objective minus a penalty on the largest violation."""
    return score.value - penalty * score.violation


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
        box = np.maximum(-radius * width, problem.lower - x), np.minimum(radius * width, problem.upper - x)
        steps = [_back_to_meeting(problem, x, step) for step in _steps(functions, H, width, box, penalty)]
        penalty = max([penalty, *(2.0 * step.limit_weight for step in steps if step.keeps_limits)])
        promises = [step.gain for step in steps]
        if max(promises, default=0.0) <= 1e-13 and any(not step.meeting for step in steps):
            return LocalOptimum(x, functions.score, iteration, True)
        # peaks are not computed for a design whose objective alone is below the present merit
        floor = merit(functions.score, penalty)
        scores = [problem.score(x + step.move, floor) for step in steps]
        merits = [merit(score, penalty) for score in scores]
        best = int(np.argmax(merits)) if steps else 0
        improvement = merits[best] - floor if steps else 0.0
        # a step with meeting eigenvalues may promise a loss, but it is accepted only when it improves the merit
        promised = max(promises[best], 0.0) if steps else np.inf
        good = improvement > 0.05 * promised
        if good or improvement > 1e-7:
            x = np.clip(x + steps[best].move, problem.lower, problem.upper)
            functions = problem.functions(x)
            if on_step is not None:
                on_step(iteration, functions.score)
            if curvature:
                H = _curvature(problem, x, steps[best])
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
    meeting: tuple[ActiveFunction, ...] = ()


def _steps(
    functions: ActiveFunctions, H: FloatArray, width: FloatArray, box: tuple[FloatArray, FloatArray], penalty: float
) -> list[_Step]:
    """Return the plain step, and steps in which pairs of eigenvalues meet."""
    steps = [_step(functions, list(functions.aim), [], H, width, box, penalty)]
    close = sorted(
        (entry for entry in functions.pairs if entry[0].value < functions.score.value + 0.1),
        key=lambda entry: abs(entry[1].gap) / abs(entry[1].mean) ** 2,
    )
    keep, rows = list(functions.aim), []
    means: list[ActiveFunction] = []
    for mean, pair in close[:2]:
        own = [piece for piece in keep if (piece.family, piece.loop) == (mean.family, mean.loop)]
        gone = sorted(own, key=lambda piece: abs(piece.place - pair.mean))[:2]
        keep = [piece for piece in keep if not any(piece is other for other in gone)] + [mean]
        size = abs(pair.mean) ** 2
        rows += [(pair.gap.real / size, pair.gap_slope.real / size), (pair.gap.imag / size, pair.gap_slope.imag / size)]
        means.append(mean)
        step = _step(functions, keep, rows, H, width, box, penalty)
        steps.append(None if step is None else replace(step, meeting=tuple(means)))
    return [step for step in steps if step is not None]


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
    curve = 1e-9 * np.eye(d + 2)
    curve[:d, :d] += H * np.outer(reach, reach) / size
    linear = np.concatenate([np.zeros(d), [-1.0, penalty]])
    # without active functions of the objective (all modes real) t has the largest possible value as its bound
    lower = np.concatenate([box[0] / reach, [-1e6, 0.0]])
    upper = np.concatenate([box[1] / reach, [(1.0 - now) / size + 1.0 if not aim else 1e6, 1e6]])
    # gradients of eigenvalues that nearly meet are very large; rows of equal length keep the programme well scaled
    A = np.array(rows).reshape(-1, d + 2)
    length = np.maximum(np.linalg.norm(A, axis=1), 1.0)
    solution = _solve(curve, linear, A / length[:, None], np.array(low) / length, np.array(high) / length, lower, upper)
    if solution is None:
        return None
    y, duals = solution[0], solution[1] / length
    gain = float(y[d] - penalty * y[d + 1]) * size + penalty * functions.score.violation
    held = [*aim, *functions.limits]
    weights = tuple((piece, float(abs(w))) for piece, w in zip(held, duals, strict=False) if abs(w) > 1e-9)
    limit_weight = float(np.abs(duals[len(aim) : len(held)]).sum())
    return _Step(y[:d] * reach, gain, weights, limit_weight, bool(y[d + 1] < 1e-7))


def _back_to_meeting(problem: GainProblem, x: FloatArray, step: _Step) -> _Step:
    """Return a step corrected so that its pairs of eigenvalues meet at its end.

    The distance of a pair is a square root. So an error of second order in the step would change it to first order.
    """
    move, width = step.move, problem.upper - problem.lower
    places = [mean.place for mean in step.meeting]
    for _ in range(8 if step.meeting else 0):
        pairs = [
            problem.pair_near(x + move, mean.family, mean.loop, place)
            for mean, place in zip(step.meeting, places, strict=True)
        ]
        found = [pair for pair in pairs if pair is not None]
        if len(found) < len(pairs):
            return step
        places = [pair.mean for pair in found]
        values = np.array([pair.gap / abs(pair.mean) ** 2 for pair in found])
        if np.abs(values).max() < 1e-13:
            break
        slopes = np.array([pair.gap_slope / abs(pair.mean) ** 2 for pair in found]) * width
        rows, sides = np.vstack([slopes.real, slopes.imag]), -np.concatenate([values.real, values.imag])
        move = np.clip(x + move + np.linalg.lstsq(rows, sides, rcond=None)[0] * width, problem.lower, problem.upper) - x
    return replace(step, move=move)


@lru_cache(maxsize=64)
def _solver(n: int, m: int) -> Any:
    shapes = {"h": ca.Sparsity.dense(n, n), "a": ca.Sparsity.dense(m, n)}
    return ca.conic("step", "daqp", shapes, {"error_on_fail": False})


def _solve(
    H: FloatArray, g: FloatArray, A: FloatArray, low: FloatArray, high: FloatArray, lower: FloatArray, upper: FloatArray
) -> tuple[FloatArray, FloatArray] | None:
    """Return the solution of a small convex quadratic programme by CasADi's DAQP, or None."""
    solver = _solver(len(g), len(A))
    answer: dict[str, Any] = solver(h=H, g=g, a=A, lba=low, uba=high, lbx=lower, ubx=upper)
    y = answer["x"].full()[:, 0]
    if not (solver.stats()["success"] and np.isfinite(y).all()):
        return None
    return y, answer["lam_a"].full()[:, 0]


def _curvature(problem: GainProblem, x: FloatArray, step: _Step) -> FloatArray:
    """Return the second derivative of the weighted functions, by differences of their gradients, made convex."""
    width = problem.upper - problem.lower
    if not step.weights:
        return np.zeros((len(x), len(x)))
    h = np.where(x + _DIFFERENCE * width > problem.upper, -_DIFFERENCE, _DIFFERENCE) * width
    slopes = problem.slopes_at([piece for piece, _ in step.weights], [x, *(x + np.diag(h))])
    signs = np.array([-w if piece.kind in ("aim", "pair") else w for piece, w in step.weights])
    # functions without a gradient at a nearby design are left out
    H = np.einsum("n,qnd->qd", signs, np.nan_to_num((slopes[1:] - slopes[0]) / h[:, None, None]))
    values, vectors = np.linalg.eigh((H + H.T) / 2)
    return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T)
