"""Global search: choice of start values, and the best of the local optima."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from scipy.stats import qmc

from gbid.arrays import FloatArray
from gbid.control.tuning.search.problem import GainProblem, Score
from gbid.control.tuning.search.sqp import LocalOptimum, merit, optimise_locally
from gbid.control.tuning.search.step import SearchStep

Progress = Callable[[SearchStep], None]
PENALTY = 10.0
_GRID = {1: 61, 2: 25, 3: 9}
"""Number of grid points per gain, for up to three gains."""
_HOP_SIZES = (0.0015, 0.005, 0.015, 0.05)
_HOPPED = 3
"""Number of different designs for basin hopping; the best one before it need not be the best one after it."""
FEASIBLE = 1e-6
"""Largest relative violation of a limit that is tolerated."""


@dataclass(frozen=True)
class Effort:
    """Computational effort of the search.

    Parameters
    ----------
    starts : int, optional
        Number of random starts. By default a grid for up to three gains, 24 starts for up to twelve, else 12.
    seed : int
        Seed of the random starts.
    finalists : int
        Number of the best designs that are fully optimised.
    hops : int
        Largest number of basin hops of each of the best designs, with more than three gains. A hop is a random move
        and a new local optimisation. It is needed because a local optimisation may stop early where eigenvalues meet.
        Hopping ends after several hops without improvement.
    """

    starts: int | None = None
    seed: int = 0
    finalists: int = 5
    hops: int = 48


@dataclass(frozen=True)
class SearchOutcome:
    """Best design of a search, and its history."""

    best: LocalOptimum
    history: tuple[SearchStep, ...]


def search(
    problem: GainProblem,
    neutral: FloatArray,
    effort: Effort,
    first: Iterable[FloatArray] = (),
    progress: Progress | None = None,
) -> SearchOutcome:
    """Return the best design within the bounds.

    Parameters
    ----------
    problem : GainProblem
        The design problem.
    neutral : (d,) array
        Gains near which the loops are probably stable. Random starts are moved towards it until they are stable.
    effort : Effort
        Computational effort.
    first : iterable of (d,) arrays
        Additional start values.
    progress : callable, optional
        Called with a `SearchStep` after each stage.

    Returns
    -------
    SearchOutcome

    Notes
    -----
    For up to three gains: a grid, whose best points that are not neighbours are optimised. For more gains: a Sobol
    sequence, with some steps of local optimisation from each start. Then the best designs are fully optimised.
    """
    history: list[SearchStep] = []

    top: list[Score] = []

    def note(stage: str, score: Score) -> None:
        if not top or better(score, top[0]):
            top[:] = [score]
        history.append(SearchStep(stage, problem.evaluations, problem.in_units(top[0].value), top[0].violation))
        if progress is not None:
            progress(history[-1])

    d = len(neutral)
    given = [np.clip(np.asarray(x, float), problem.lower, problem.upper) for x in (neutral, *first)]
    if d in _GRID and effort.starts is None:
        candidates = given + _basins(problem, _GRID[d], 2 * effort.finalists)
        rough = [optimise_locally(problem, x, max_iterations=12, tolerance=1e-4, curvature=False) for x in candidates]
        note("global", _best(rough).score)
    else:
        draws = _draws(problem, neutral, effort)
        rough = []
        for start in (*given, *draws):
            rough.append(optimise_locally(problem, start, max_iterations=40, curvature=d <= 3, tolerance=1e-5))
            note("global", _best(rough).score)
    rough.sort(key=lambda found: merit(found.score, PENALTY), reverse=True)
    finals: list[LocalOptimum] = []
    for start in rough[: effort.finalists]:
        if any(np.allclose(start.x, other.x, rtol=0, atol=1e-6) for other in finals):
            continue
        finals.append(optimise_locally(problem, start.x, max_iterations=300))
        note("local", _best(finals).score)
    best = _best(finals)
    if d not in _GRID and effort.hops:
        rng = np.random.default_rng(effort.seed)
        hopped = []
        for start in _apart(finals, 0.1 * (problem.upper - problem.lower))[:_HOPPED]:
            hopped.append(_hop_basins(problem, start, rng, effort.hops, len(_HOP_SIZES), note))
        best = _hop_basins(problem, _best(hopped), rng, effort.hops, 2 * len(_HOP_SIZES), note)
    if not best.converged:
        best = optimise_locally(problem, best.x, max_iterations=600, radius=0.005)
        note("local", best.score)
    return SearchOutcome(best, tuple(history))


def _hop_basins(
    problem: GainProblem,
    best: LocalOptimum,
    rng: np.random.Generator,
    most: int,
    in_vain: int,
    note: Callable[[str, Score], None],
) -> LocalOptimum:
    """Move a design at random and optimise again, until a number of moves in a row gave no improvement."""
    vain = 0
    for i in range(most):
        if vain == in_vain:
            break
        size = _HOP_SIZES[i % len(_HOP_SIZES)]
        moved = best.x + size * rng.standard_normal(len(best.x)) * (problem.upper - problem.lower)
        again = optimise_locally(problem, moved, max_iterations=120, radius=0.02)
        vain = 0 if better(again.score, best.score) else vain + 1
        best = best if vain else again
        note("basin hopping", best.score)
    return best


def _apart(found: list[LocalOptimum], distance: FloatArray) -> list[LocalOptimum]:
    """Return designs that differ by more than a distance in some gain, best first."""
    chosen: list[LocalOptimum] = []
    for one in sorted(found, key=lambda design: merit(design.score, PENALTY), reverse=True):
        if all((np.abs(one.x - other.x) > distance).any() for other in chosen):
            chosen.append(one)
    return chosen


def better(one: Score, other: Score) -> bool:
    """Return whether a design is better than another: first by the limits, then by the objective."""
    kept = one.violation <= FEASIBLE, other.violation <= FEASIBLE
    if kept[0] != kept[1]:
        return kept[0]
    return one.value > other.value if kept[0] else one.violation < other.violation


def _best(found: list[LocalOptimum]) -> LocalOptimum:
    best = found[0]
    for one in found[1:]:
        best = one if better(one.score, best.score) else best
    return best


def _basins(problem: GainProblem, n: int, most: int) -> list[FloatArray]:
    """Return the best points of a grid that are not neighbours, best first.

    They are more than the local maxima of the grid, because along a limit the grid would miss optima. The objective
    without its limits is an upper bound of the merit and cheap. So peaks are computed only where this bound is high
    enough.
    """
    d = len(problem.lower)
    axes = [np.linspace(low, high, n) for low, high in zip(problem.lower, problem.upper, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, d)
    aims = np.array([problem.aim_bound(x) for x in grid])
    merits = np.full(len(grid), -np.inf)
    best = -np.inf
    for i in np.argsort(-aims, kind="stable"):
        if aims[i] <= best - 0.1:
            break
        merits[i] = merit(problem.score(grid[i]), PENALTY)
        best = max(best, merits[i])
    chosen: list[FloatArray] = []
    cell = (problem.upper - problem.lower) / (n - 1)
    for i in np.argsort(-merits, kind="stable"):
        if len(chosen) == most or not np.isfinite(merits[i]):
            break
        if all(np.abs((grid[i] - other) / cell).max() > 1.5 for other in chosen):
            chosen.append(grid[i])
    return chosen


def _draws(problem: GainProblem, neutral: FloatArray, effort: Effort) -> list[FloatArray]:
    """Return random starts, each moved towards the neutral gains until its loops are stable."""
    d = len(neutral)
    n = effort.starts if effort.starts is not None else (24 if d <= 12 else 12)
    unit = qmc.Sobol(d, seed=np.random.default_rng(effort.seed)).random(1 << max(n - 1, 1).bit_length())[:n]
    starts = []
    for u in unit:
        # with positive bounds over more than a decade, starts have a logarithmic distribution
        decades = (problem.lower > 0) & (problem.upper > 10 * problem.lower)
        low, high = np.where(decades, problem.lower, 1.0), np.where(decades, problem.upper, 1.0)
        x = np.where(decades, low * (high / low) ** u, problem.lower + u * (problem.upper - problem.lower))
        for share in (1.0, 0.5, 0.25, 0.12, 0.06, 0.03):
            start = neutral + np.where(decades, 1.0, share) * (x - neutral)
            if problem.stable(start):
                break
        starts.append(start)
    return starts
