"""Local optimisation of the worst of many eigenvalues and peaks by sequential quadratic programming (SQP)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from gbid.arrays import FloatArray
from gbid.control.tuning.search.nonsmooth.active import ActiveFunction, ActiveFunctions, Score, merit
from gbid.control.tuning.search.nonsmooth.certificate import Certificate
from gbid.control.tuning.search.nonsmooth.meetings import Meeting, back_to_meeting, meetings
from gbid.control.tuning.search.problem import GainProblem
from gbid.control.tuning.search.steps.curvature import curvature_by_differences
from gbid.control.tuning.search.steps.ridge_step import RidgeStep, ridge_step


@dataclass(frozen=True)
class LocalOptimum:
    """Local optimum: gains, score, iterations, whether the optimisation ended by itself, and its certificate."""

    x: FloatArray
    score: Score
    iterations: int
    converged: bool
    certificate: Certificate | None = None


_PENALTY = 10.0
_PATIENCE = 10
"""Number of iterations over which the rise of the merit is judged."""
_HOPE = 10.0
"""By how many times its last rise a climb may still be expected to rise."""
_MOVED = 1e-3
"""By how much the corrections of a move to a meeting may raise the objective."""
_LATE = 30
"""Number of iterations after which a climb that has not reached its goal ends; those that do are there before."""
_CHECKED = (15, 20, 25)
"""Iterations after which a climb may be too far behind its goal."""
_SETTLED = 1e-5
"""Rise below which a climb that has passed its goal ends; the best design of all is climbed to the end later."""


def optimise_locally(
    problem: GainProblem,
    start: FloatArray,
    *,
    radius: float = 0.1,
    max_iterations: int = 200,
    tolerance: float = 1e-9,
    rough: bool = False,
    goal: float = -np.inf,
    behind: float = np.inf,
    repair: bool = True,
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
    rough : bool
        Whether H stays zero and no steps to meetings are tried: a third of the time for a design near the optimum.
    goal : float
        Merit below which the optimum has no use. The optimisation ends when it will hardly be reached, or has been
        and rises no more.
    behind : float
        By what share of its goal a climb may be behind for each iteration that is left to reach it.
    repair : bool
        Whether small violations of limits that are left are made smaller with a larger penalty.
    on_step : callable, optional
        Called with iteration and score.

    Returns
    -------
    LocalOptimum
    """
    x = np.clip(start, problem.lower, problem.upper)
    found = _climb(problem, x, radius, max_iterations, tolerance, rough, _PENALTY, goal, behind, on_step)
    if repair and 1e-8 < found.score.violation < 0.1 and merit(found.score, _PENALTY) > goal:
        again = _climb(problem, found.x, 1e-3, 40, tolerance, rough, 1e3 * _PENALTY, goal, behind, on_step)
        found = replace(again, iterations=found.iterations + again.iterations)
    return found


def _climb(
    problem: GainProblem,
    x: FloatArray,
    radius: float,
    max_iterations: int,
    tolerance: float,
    rough: bool,
    penalty: float,
    goal: float,
    behind: float,
    on_step: Callable[[int, Score], None] | None,
) -> LocalOptimum:
    width = problem.upper - problem.lower
    H = np.zeros((len(x), len(x)))
    functions = problem.functions(x)
    groups: list[tuple[Meeting, ...]] | None = None
    stalled, milestone, lately = 0, merit(functions.score, penalty), merit(functions.score, penalty)
    for iteration in range(1, max_iterations + 1):
        if not functions.score.usable or problem.exhausted:
            return LocalOptimum(x, functions.score, iteration, False)
        box = np.maximum(-radius * width, problem.lower - x), np.minimum(radius * width, problem.upper - x)
        # peaks are not computed for a design whose objective alone is below the present merit
        floor = merit(functions.score, penalty)
        plain = ridge_step(functions, list(functions.aim), [], H, width, box, penalty)
        best, improvement = plain, -np.inf
        if plain is not None:
            penalty = max(penalty, 2.0 * plain.limit_weight if plain.keeps_limits else 0.0)
            improvement = merit(problem.score(x + plain.move, floor), penalty) - floor
        met: list[_MeetingStep] = []
        if not rough and (plain is None or improvement < 0.5 * plain.gain or plain.gain <= 1e-13):
            groups = meetings(problem, x, functions) if groups is None else groups
            met = _meeting_steps(groups, functions, H, width, box, penalty)
        for step, means in met:
            penalty = max(penalty, 2.0 * step.limit_weight if step.keeps_limits else 0.0)
            if step.gain <= improvement:
                continue
            move = back_to_meeting(problem, x, step.move, means, floor + max(improvement, 0.0) - _MOVED)
            if move is None:
                continue
            step = replace(step, move=move)
            gained = merit(problem.score(x + step.move, floor + max(improvement, 0.0)), penalty) - floor
            if gained > improvement:
                best, improvement = step, gained
        if plain is not None and max([plain.gain, *(step.gain for step, _ in met)]) <= 1e-13:
            return LocalOptimum(x, functions.score, iteration, True)
        # a step with meeting eigenvalues may promise a loss, but it is accepted only when it improves the merit
        promised = np.inf if best is None else max(best.gain, 0.0)
        good = improvement > 0.05 * promised
        if best is not None and (good or improvement > 1e-7):
            x = np.clip(x + best.move, problem.lower, problem.upper)
            functions, groups = problem.functions(x), None
            if on_step is not None:
                on_step(iteration, functions.score)
            if not rough:
                H = curvature_by_differences(problem, x, best)
        if improvement > 0.5 * promised:
            radius = min(2 * radius, 0.5)
        elif not good:
            radius *= 0.35
        stalled = stalled + 1 if improvement < 1e-9 else 0
        creeps = False
        if iteration % 30 == 0:
            reached = merit(functions.score, penalty)
            creeps, milestone = reached - milestone < 1e-5, reached
        if iteration % _PATIENCE == 0:
            reached = merit(functions.score, _PENALTY)
            rise = max(reached - lately, 0.0)
            if reached + _HOPE * rise < goal or (iteration >= _LATE and reached < goal):
                return LocalOptimum(x, functions.score, iteration, False)
            if reached > goal > -np.inf and rise < _SETTLED:
                return LocalOptimum(x, functions.score, iteration, False)
            lately = reached
        if behind < np.inf and iteration in _CHECKED:
            demanded = goal - behind * (_LATE - iteration) * abs(goal)
            if merit(functions.score, _PENALTY) < demanded:
                return LocalOptimum(x, functions.score, iteration, False)
        if radius < tolerance or stalled > 12 or creeps:
            return LocalOptimum(x, functions.score, iteration, True)
    return LocalOptimum(x, functions.score, max_iterations, False)


_MeetingStep = tuple[RidgeStep, tuple[ActiveFunction, ...]]


def _meeting_steps(
    groups: list[tuple[Meeting, ...]],
    functions: ActiveFunctions,
    H: FloatArray,
    width: FloatArray,
    box: tuple[FloatArray, FloatArray],
    penalty: float,
) -> list[_MeetingStep]:
    """Return steps at whose ends eigenvalues nearly meet, with the means of these, the most promising first."""
    found = []
    for group in groups:
        keep = [piece for piece in functions.aim if not any(one.holds(piece) for one in group)]
        means = tuple(one.mean for one in group)
        rows = [row for one in group for row in one.rows]
        step = ridge_step(functions, [*keep, *means], rows, H, width, box, penalty)
        if step is not None:
            found.append((step, means))
    return sorted(found, key=lambda pair: -pair[0].gain)
