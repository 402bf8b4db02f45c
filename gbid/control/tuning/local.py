"""Local search over gains: SQP steps on the active functions, with coalescence of eigenvalues and curvature."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np

from gbid.control.tuning.certificate import Certificate, Coalescence, back_to_coalescence, coalescences
from gbid.control.tuning.problem import (
    DIFFERENCE,
    PENALTY,
    ActiveFunction,
    ActiveFunctions,
    GainProblem,
    LoopState,
    Score,
    merit,
)
from gbid.core.arrays import FloatArray

# ---- Small convex quadratic programmes by CasADi's DAQP, which reads and writes numpy arrays directly.
#
# The usual call with `casadi.DM` takes ten times as long as the solution.

_INPUTS = ("h", "g", "a", "lba", "uba", "lbx", "ubx")
_PROXIMAL = {"eps_prox": 1e-4, "eta_prox": 1e-8}
"""Weight and tolerance of proximal iterations: without them rows are broken by percents where H is nearly zero."""
_INFEASIBLE = -1
"""DAQP's status of a programme without a solution."""


class QuadraticProgramme:
    """Solver of ``min x' H x / 2 + g' x`` with ``low <= A x <= high`` and bounds, for one size.

    Parameters
    ----------
    n, m : int
        Number of variables and of rows of A.

    Attributes
    ----------
    infeasible : bool
        Whether the last programme had no solution within its rows and bounds.
    """

    def __init__(self, n: int, m: int) -> None:
        shapes = {"h": ca.Sparsity.dense(n, n), "a": ca.Sparsity.dense(m, n)}
        self._solver: Any = ca.conic("step", "daqp", shapes, {"error_on_fail": False, "daqp": _PROXIMAL})
        buffer: Any
        buffer, self._trigger = self._solver.buffer()  # its stub asks for a size besides, which a memoryview has
        self._buffer, self.infeasible = buffer, False
        self._given = {name: self._array(self._solver.numel_in(name)) for name in map(str, self._solver.name_in())}
        self._found = {name: self._array(self._solver.numel_out(name)) for name in map(str, self._solver.name_out())}
        for i, array in enumerate(self._given.values()):
            buffer.set_arg(i, array.data)
        for i, array in enumerate(self._found.values()):
            buffer.set_res(i, array.data)

    @staticmethod
    def _array(size: int) -> FloatArray:
        return np.zeros(max(size, 1))

    def solve(self, *given: FloatArray) -> tuple[FloatArray, FloatArray] | None:
        """Return solution and multipliers of the rows for H, g, A, low, high, lower, upper; None when it fails."""
        for name, value in zip(_INPUTS, given, strict=True):
            self._given[name][: value.size] = value.ravel(order="F")  # CasADi stores column after column
        self.infeasible = False
        try:
            self._trigger()
        except RuntimeError:  # the solver finds its numbers unfit
            return None
        x, rows = self._found["x"].copy(), self._found["lam_a"].copy()
        ended = self._buffer.stats()
        self.infeasible = ended["return_status"] == _INFEASIBLE
        return (x, rows) if ended["success"] and np.isfinite(x).all() else None


_SOLVERS = threading.local()
"""Solvers of one thread: each has arrays of its own, which two threads must not share."""


def quadratic_programme(n: int, m: int) -> QuadraticProgramme:
    """Return this thread's solver for n variables and m rows."""
    if not hasattr(_SOLVERS, "of_size"):
        _SOLVERS.of_size = lru_cache(maxsize=64)(QuadraticProgramme)
    solver: QuadraticProgramme = _SOLVERS.of_size(n, m)
    return solver


# ---- Step of the gains along the ridges between the functions near the worst one, by a quadratic programme.

_RIDGES = (1e-9, 1e-6, 1e-4)
"""Curvature that is added to a step's quadratic programme; more when the solver fails with less."""


@dataclass(frozen=True)
class RidgeStep:
    """Step of the gains, its predicted gain in merit, and the weights of active functions and power sums."""

    move: FloatArray
    gain: float
    weights: tuple[tuple[ActiveFunction, float], ...]
    limit_weight: float
    keeps_limits: bool
    group: tuple[Coalescence, ...]
    coalescence_weights: FloatArray


def ridge_step(
    functions: ActiveFunctions,
    group: tuple[Coalescence, ...],
    H: FloatArray,
    width: FloatArray,
    box: tuple[FloatArray, FloatArray],
    penalty: float,
) -> RidgeStep | None:
    """Return the step of the gains by a quadratic programme over step, gain in objective, and violation of limits.

    Parameters
    ----------
    functions : ActiveFunctions
        Score, and functions of objective and limits.
    group : tuple of Coalescence
        Eigenvalues that nearly coalesce at the end of the step. Their means take their place in the objective.
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
    lower, upper = np.empty(d + 2), np.empty(d + 2)
    lower[:d], upper[:d] = box[0] / reach, box[1] / reach
    lower[d:], upper[d:] = (-1e6, 0.0), 1e6
    equalities = [row for one in group for row in one.rows]
    if equalities:
        scaled = np.array([slope for _, slope in equalities]) * reach
        norm = np.maximum(np.sqrt((scaled * scaled).sum(axis=1)), 1e-300)
        equal, sides = scaled / norm[:, None], -np.array([value for value, _ in equalities]) / norm
        ends = equal * lower[:d], equal * upper[:d]
        if (np.minimum(*ends).sum(axis=1) > sides).any() or (np.maximum(*ends).sum(axis=1) < sides).any():
            return None  # an equality has no solution within the bounds
    aim = [piece for piece in functions.aim if not any(one.holds(piece) for one in group)] if group else functions.aim
    aim, limits = [*aim, *(one.mean for one in group)], functions.limits
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
        rows[n_held:, :d] = equal
        low[n_held:] = high[n_held:] = sides
    curve = np.zeros((d + 2, d + 2))
    curve[:d, :d] = H * (reach[:, None] * reach / size)
    # a sum is finite when its terms are
    if not np.isfinite(rows.sum() + low.sum() + curve.sum()):
        return None
    linear = np.zeros(d + 2)
    linear[d:] = -1.0, penalty
    if not aim:  # all modes are real: t has the largest possible value as its bound
        upper[d] = (1.0 - now) / size + 1.0
    # gradients of eigenvalues that nearly coalesce are very large; rows of equal length keep the programme well scaled
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
    limit_weight, kept = float(duals[n_aim:n_held].sum()), bool(y[d + 1] < 1e-7)
    equal_weights = solution[1][n_held:] / length[n_held:] * size / norm if equalities else np.zeros(0)
    return RidgeStep(y[:d] * reach, gain, weights, limit_weight, kept, group, equal_weights)


def _curvature(problem: GainProblem, x: FloatArray, step: RidgeStep, states: Sequence[LoopState]) -> FloatArray:
    """Return the convex part of the curvature (d, d) of the functions that determined the last step.

    Where eigenvalues met at its end, it is that of the Lagrangian along the gains with which they stay together.
    Without it the next steps zigzag across the valleys of this surface.
    """
    signed = [(piece, -weight if piece.kind == "aim" else weight) for piece, weight in step.weights]
    H, width = problem.curvature(x, states, signed), problem.upper - problem.lower
    begin = _coalescence_slopes(problem, x, step, states) if step.group else None
    if begin is None or not np.isfinite(begin[1]).all():
        return _convex(H)
    rows = begin[1] * width
    _, sizes, basis = np.linalg.svd(rows / np.maximum(np.linalg.norm(rows, axis=1), 1e-300)[:, None])
    along = basis[int((sizes > 1e-8 * sizes[0]).sum()) :] * width
    changes = np.zeros_like(along)
    for change, direction in zip(changes, along, strict=True):
        end = x + DIFFERENCE * direction
        h = DIFFERENCE if ((problem.lower <= end) & (end <= problem.upper)).all() else -DIFFERENCE
        slopes = _coalescence_slopes(problem, x + h * direction, step)
        if slopes is None:
            return _convex(H)
        change[:] = (slopes[0] - begin[0]) / h
    reduced, along = (changes + along @ H) @ along.T, along / width**2
    return along.T @ _convex(reduced) @ along if np.isfinite(reduced).all() else _convex(H)


def _coalescence_slopes(
    problem: GainProblem, x: FloatArray, step: RidgeStep, states: Sequence[LoopState] = ()
) -> tuple[FloatArray, FloatArray] | None:
    """Gradient of the step's objective over clusters of coalescent eigenvalues, and gradients of their power sums."""
    states, slope, rows = states or problem.states(x), np.zeros_like(x), []
    for coalescence in step.group:
        mean = coalescence.mean
        cluster = problem.cluster(states, mean.family, mean.loop, mean.place, mean.size)
        if cluster is None or cluster.real != coalescence.cluster.real:
            return None
        weight = sum(weight for piece, weight in step.weights if piece is mean)
        slope = slope - weight * problem.mean_of(mean.family, cluster)[1]
        rows += [row for _, row in replace(coalescence, cluster=cluster).rows]
    return slope + step.coalescence_weights @ np.array(rows), np.array(rows)


def _convex(H: FloatArray) -> FloatArray:
    values, vectors = np.linalg.eigh((H + H.T) / 2)
    return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T)


# ---- Local optimisation of the worst of many eigenvalues and peaks by sequential quadratic programming (SQP).


_FARTHEST = 4.0
"""Largest trust region in units of the gains."""


@dataclass(frozen=True)
class LocalOptimum:
    """Local optimum: gains, score, number of iterations, whether the search converged, and its certificate."""

    x: FloatArray
    score: Score
    iterations: int
    converged: bool
    certificate: Certificate | None = None


@dataclass(frozen=True)
class LocalOptions:
    """Options of a local search: effort, conditions on a useful optimum, and stopping rules.

    The last seven decide between time and certainty: `docs/benchmarks.md` has the designs of ten seeds and their times.

    Parameters
    ----------
    radius : float
        Initial trust region, as a share of the width of the bounds.
    iterations : int
        Largest number of iterations.
    plain : bool
        Whether the curvature stays zero and no steps to coalescence are tried: a third of the time for a design near
        the optimum.
    unit : (d,) array, optional
        Units of the gains: the trust region is then a share of the units and of the gains, whichever are larger.
    repair : bool
        Whether small violations of limits that are left are made smaller with a larger penalty.
    penalty : float
        Weight of the largest violation at the start; it rises with the multipliers of the limits.
    target : float
        Merit that the optimum must reach: a local search that will hardly reach it ends.
    pace : float
        By what share of the target a local search may be behind for each iteration that is left to reach it.
    known : tuple of LocalOptimum
        Optima from which it must differ.
    near : float or (d,) array
        Distances of the gains from a known optimum within which a design of lower merit leads back to it.
    judged : int
        Number of iterations over which the rise of the merit is judged.
    hope : float
        By how many times its last rise a local search may still be expected to rise.
    early, late : int
        Iterations from which on a local search ends that is too far behind its target, and after which one ends that
        has not reached it; those that reach it have reached it by then.
    settled : float
        Rise over the judged iterations below which a local search ends.
    least_gain : float
        Gain in merit, promised or reached, below which a step is in vain.
    coalescence_loss : float
        By how much the corrections of a move to coalescing eigenvalues may lower the objective.
    """

    radius: float = 0.1
    iterations: int = 200
    plain: bool = False
    unit: FloatArray | None = None
    repair: bool = True
    penalty: float = PENALTY
    target: float = -np.inf
    pace: float = np.inf
    known: tuple[LocalOptimum, ...] = ()
    near: float | FloatArray = 0.0
    judged: int = 10
    hope: float = 10.0
    early: int = 15
    late: int = 30
    settled: float = 1e-5
    least_gain: float = 1e-9
    coalescence_loss: float = 1e-3

    def known_at(self, x: FloatArray, reached: float) -> LocalOptimum | None:
        """Return the known optimum to which a design of a given merit leads back; None without such an optimum."""
        for optimum in self.known:
            if reached <= merit(optimum.score) and (np.abs(x - optimum.x) <= self.near).all():
                return optimum
        return None


def optimise_locally(problem: GainProblem, start: FloatArray, options: LocalOptions = LocalOptions()) -> LocalOptimum:
    r"""Return a local optimum by sequential quadratic programming.

    Each step solves, for the move d of the gains within a trust region,

    .. math:: \max\; t - \rho s - \tfrac12 d^T H d \quad\text{with}\quad
              f_j + g_j d \ge t,\;\; c_k + a_k d \le s,\;\; s \ge 0

    over all functions f (damping factors) of the objective and c of the limits near the worst. H is the curvature of
    the functions that were active in the step before. Where two eigenvalues a, b coalesce, their gradients have no
    bound. There a second step is computed with their mean and with ``((a - b)/2)^2 = 0`` as a constraint, because both
    are smooth (coalescence at the optimum: Burke, Lewis, Overton, 2001). The better step is taken.

    Parameters
    ----------
    problem : GainProblem
        The design problem.
    start : (d,) array
        Start value of the gains.
    options : LocalOptions
        Effort and target.

    Returns
    -------
    LocalOptimum
    """
    x, bounds = np.clip(start, problem.lower, problem.upper), problem.upper - problem.lower
    H = np.zeros((len(x), len(x)))
    functions = problem.functions(x)
    groups: list[tuple[Coalescence, ...]] | None = None
    known, converged, radius, penalty = None, False, options.radius, options.penalty
    stalled, before = 0, merit(functions.score)
    for iteration in range(1, options.iterations + 1):
        if not functions.score.usable or problem.evaluations.exhausted:
            break
        width = bounds if options.unit is None else np.minimum(np.maximum(options.unit, np.abs(x)), bounds)
        box = np.maximum(-radius * width, problem.lower - x), np.minimum(radius * width, problem.upper - x)
        # peaks are not computed for a design whose objective alone is below the present merit
        floor = merit(functions.score, penalty)
        first = ridge_step(functions, (), H, width, box, penalty)
        best, improvement = first, -np.inf
        if first is not None:
            penalty = max(penalty, 2.0 * first.limit_weight if first.keeps_limits else 0.0)
            improvement = merit(problem.score(x + first.move, floor), penalty) - floor
        steps: list[RidgeStep] = []
        if not options.plain and (first is None or improvement < 0.5 * first.gain or first.gain <= options.least_gain):
            groups = coalescences(problem, x, functions) if groups is None else groups
            # steps at whose ends eigenvalues nearly coalesce, the most promising first
            possible = [ridge_step(functions, group, H, width, box, penalty) for group in groups]
            steps = sorted((step for step in possible if step), key=lambda step: -step.gain)
        for step in steps:
            penalty = max(penalty, 2.0 * step.limit_weight if step.keeps_limits else 0.0)
            if step.gain <= improvement:
                continue
            least = floor + max(improvement, 0.0) - options.coalescence_loss
            move = back_to_coalescence(problem, x, step.move, step.group, least)
            if move is None:
                continue
            gained = merit(problem.score(x + move, floor + max(improvement, 0.0)), penalty) - floor
            if gained > improvement:
                best, improvement = replace(step, move=move), gained
        if first is not None and max([first.gain, *(step.gain for step in steps)]) <= options.least_gain:
            converged = True
            break
        # a step to coalescence may promise a loss, but it is accepted only when it improves the merit
        promised = np.inf if best is None else max(best.gain, 0.0)
        good = improvement > 0.05 * promised
        if best is not None and (good or improvement > 1e-7):
            x = np.clip(x + best.move, problem.lower, problem.upper)
            functions, groups = problem.functions(x), None
            if not options.plain:
                H = _curvature(problem, x, best, functions.states)
        if improvement > 0.5 * promised:
            radius = min(2 * radius, 0.5 if options.unit is None else _FARTHEST)
        elif not good:
            radius *= 0.35
        stalled = stalled + 1 if improvement < options.least_gain else 0
        if radius < 1e-9 or stalled > 12:
            converged = True
            break
        reached = merit(functions.score)
        known = options.known_at(x, reached) if good else None
        if known is not None:
            break
        if iteration % 5 == 0 and iteration >= options.early and options.target > -np.inf:
            left = max(options.late - iteration, 0)
            if reached < options.target - (options.pace * left * abs(options.target) if left else 0.0):
                break
        if iteration % options.judged == 0:
            rise, before = max(reached - before, 0.0), reached
            if reached + options.hope * rise < options.target:
                break
            if rise < options.settled and (iteration >= options.late or reached > options.target > -np.inf):
                converged = True
                break
    optimum = known or LocalOptimum(x, functions.score, iteration, converged)
    if options.repair and 1e-8 < optimum.score.violation < 0.1 and merit(optimum.score) > options.target:
        optimum = repaired(problem, optimum, options)
    return optimum


def repaired(problem: GainProblem, design: LocalOptimum, options: LocalOptions = LocalOptions()) -> LocalOptimum:
    """Return a design near a given design that violates the limits less or not at all, found with a larger penalty."""
    near = replace(options, radius=1e-3, iterations=40, penalty=1e3 * PENALTY, repair=False)
    again = optimise_locally(problem, design.x, near)
    return replace(again, iterations=design.iterations + again.iterations)
