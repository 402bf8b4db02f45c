"""Optimisation over many loops with a working set: loops are added when the design is worse there."""

from __future__ import annotations

from dataclasses import replace

from gbid.arrays import FloatArray
from gbid.control.tuning.plants.plant_set import PlantSet
from gbid.control.tuning.search.global_search import Effort, Progress, SearchOutcome, search
from gbid.control.tuning.search.problem import GainProblem
from gbid.control.tuning.search.sqp import LocalOptimum
from gbid.control.tuning.search.step import SearchStep
from gbid.control.tuning.solving import solve

_FEW, _MANY = 5, 30
"""Largest number of loops without a working set: with many gains, and with up to three."""


def solve_over_points(
    problem: GainProblem,
    plants: PlantSet,
    points: FloatArray,
    neutral: FloatArray,
    effort: Effort,
    first: list[FloatArray],
    progress: Progress | None,
    of_others: bool = False,
) -> tuple[LocalOptimum, tuple[SearchStep, ...]]:
    """Return the optimum over all loops and the history; many loops are handled with a working set.

    The search starts with some loops and adds those in which the design is worse. A design that is optimal for some
    loops and not worse in the others is optimal for all. With `of_others` the first
    designs are those of similar loops, and the first search goes on from them. With few gains every round is a global
    search, so that this also holds for the result. With many gains each round is a local optimisation from the last
    design.
    """
    whole = problem.families
    few_gains = len(neutral) <= 3
    if len(whole[0]) <= (_MANY if few_gains else _FEW):
        return solve(problem, neutral, effort, first, progress, of_others=of_others)
    chosen = plants.first(points)
    problem.families = (plants.family(points, chosen),)
    found, history = solve(problem, neutral, effort, first, progress, of_others=of_others)
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


def sketch_over_points(
    problem: GainProblem,
    plants: PlantSet,
    points: FloatArray,
    neutral: FloatArray,
    effort: Effort,
    first: list[FloatArray],
    progress: Progress | None,
) -> SearchOutcome:
    """Return different good designs of the loops with which a search begins, as first designs of similar loops."""
    if len(problem.families[0]) > _FEW:
        problem.families = (plants.family(points, plants.first(points)),)
    return search(problem, neutral, replace(effort, sketch=True), first, progress)
