"""Optimisation over many loops, which enter as they turn out to be worse than those designed for."""

from __future__ import annotations

import numpy as np

from gbid.arrays import FloatArray
from gbid.control.tuning.loops_at_points import LoopsAtPoints
from gbid.control.tuning.maximise import solve
from gbid.control.tuning.search.global_search import Effort, Progress
from gbid.control.tuning.search.problem import GainProblem
from gbid.control.tuning.search.sqp import LocalOptimum
from gbid.control.tuning.search.step import SearchStep

_FEW, _MANY = 5, 30
"""Loops that are designed for at once: with many gains, with up to three."""


def solve_over_points(
    problem: GainProblem,
    plants: LoopsAtPoints,
    points: FloatArray,
    neutral: FloatArray,
    effort: Effort,
    first: list[FloatArray],
    progress: Progress | None,
) -> tuple[LocalOptimum, tuple[SearchStep, ...]]:
    """Search over all loops; of many first over those that matter, adding those that turn out worse.

    A design that is best for some of the loops and no worse in the others is best for all. With few gains every
    round searches globally, so that this holds of the result as well; with many it climbs on from the last.
    """
    whole = problem.families
    few_gains = len(neutral) <= 3
    if len(whole[0]) <= (_MANY if few_gains else _FEW):
        return solve(problem, neutral, effort, first, progress)
    chosen = _corners(points)
    problem.families = (plants.family(points, chosen),)
    found, history = solve(problem, neutral, effort, first, progress)
    while True:
        measures = problem.by_loop(whole[0], found.x)
        measures[0] += found.score.value
        measures[1:] -= found.score.violation
        worst = {int(row.argmax()) for row in measures if row.max() > 1e-7} - set(chosen)
        if not worst:
            break
        chosen += sorted(worst)
        problem.families, problem.cuts = (plants.family(points, chosen),), []
        if few_gains:
            found, more = solve(problem, neutral, effort, [found.x, *first], progress)
        else:
            found, more = solve(problem, neutral, effort, found=found, progress=progress)
        history += more
    problem.families, problem.cuts = whole, []
    found, more = solve(problem, neutral, effort, found=found, progress=progress)
    return found, history + more


def _corners(points: FloatArray) -> list[int]:
    """Return indices of the points nearest to the corners of the rectangle that they span."""
    low, high = points.min(axis=0), points.max(axis=0)
    unit = (points - low) / np.where(high > low, high - low, 1.0)
    corners = [(0.0, 0.0), (0.0, 1.0), (1.0, 0.0), (1.0, 1.0)]
    return list(dict.fromkeys(int(np.argmin(((unit - corner) ** 2).sum(axis=1))) for corner in corners))
