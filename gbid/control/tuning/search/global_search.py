"""Global search: choice of start values, and the best of the local optima."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from gbid.arrays import FloatArray
from gbid.control.tuning.search.basins.climber import GRID, LATER_RADIUS, Climber
from gbid.control.tuning.search.basins.hopping import hop_basins, hop_freely, hop_with_limits
from gbid.control.tuning.search.basins.ranking import FEASIBLE, best_of, better, rank
from gbid.control.tuning.search.nonsmooth.active import Score
from gbid.control.tuning.search.problem import GainProblem
from gbid.control.tuning.search.sqp import LocalOptimum, optimise_locally
from gbid.control.tuning.search.starts.draws import random_starts
from gbid.control.tuning.search.starts.gain_grid import grid_starts
from gbid.control.tuning.search.starts.units import gain_units
from gbid.control.tuning.search.step import SearchStep

Progress = Callable[[SearchStep], None]
_FINALISTS = 3
"""Number of the best designs that are then fully optimised."""
_SKETCHED = 6
"""Number of random moves of each of them in a search for other loops."""
_OTHER_RADII = (0.2, 0.02)
"""Trust regions of further climbs from the most promising design of other loops, as shares of the bounds."""
_SAME = 1e-3
"""Distance of rough designs of few gains, as a share of the bounds, within which they belong to one optimum."""
_AGREE = 1e-5
"""Relative difference of local optima that count as one."""


@dataclass(frozen=True)
class Effort:
    """Computational effort of the search.

    Parameters
    ----------
    starts : int, optional
        Number of random starts. By default a grid for up to three gains; for more gains 24 for up to twelve, else
        12, but 8 where more than eigenvalues counts.
    seed : int
        Seed of the random starts.
    finalists : int
        Number of the best designs that are fully optimised.
    hops : int
        Largest number of basin hops of each of the best designs, with more than three gains. A hop is a random move
        and a new local optimisation. It is needed because a local optimisation may stop early where eigenvalues meet.
        Hopping ends after several hops without improvement.
    sketch : bool
        Whether the search, for more than three gains, ends with several different designs: each of the best after a few
        hops, as starts for other loops.
    """

    starts: int | None = None
    seed: int = 0
    finalists: int = 5
    hops: int = 48
    sketch: bool = False


@dataclass(frozen=True)
class SearchOutcome:
    """Best design of a search, its history, and the different designs with which it ended."""

    best: LocalOptimum
    history: tuple[SearchStep, ...]
    ends: tuple[LocalOptimum, ...]


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
    For up to three gains: a grid, whose best points that are not neighbours are optimised. For more gains: evenly
    spread points, with some steps of local optimisation from each start. Then the best designs are fully optimised.
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
    climber = Climber(problem, gain_units(problem, given[0]), fine=effort.sketch)
    rough: list[LocalOptimum] = []
    if d in GRID and effort.starts is None:
        for x in (*given, *grid_starts(problem, given[0], climber.unit, GRID[d], effort.finalists)):
            rough.append(optimise_locally(problem, x, max_iterations=10, tolerance=1e-4, rough=True, repair=False))
        note("global", best_of(rough).score)
    else:
        n = effort.starts if effort.starts is not None else climber.starts
        for start in (*given, *random_starts(problem, given[0], climber.unit, n, effort.seed)):
            rough.append(climber.rough(start, max(map(rank, rough), default=-np.inf)))
            note("global", best_of(rough).score)
            if problem.exhausted:
                break
    rough.sort(key=rank, reverse=True)
    raced = not climber.free and d not in GRID and len(rough) > _FINALISTS
    if raced:
        lead, further = rank(rough[0]), []
        for one in rough[: -(-2 * len(rough) // 3)]:
            further.append(climber.rough(one.x, lead, LATER_RADIUS))
            lead = lead if effort.sketch else max(lead, rank(further[-1]))
        note("global", best_of(further).score)
        rough = sorted(further, key=rank, reverse=True)[:_FINALISTS]
    finals: list[LocalOptimum] = []
    for start in rough[: effort.finalists]:
        same = (problem.upper - problem.lower) * (_SAME if d in GRID else 1e-6)
        if any((np.abs(start.x - other.x) <= same).all() for other in finals):
            continue
        goal = max(map(rank, finals), default=-np.inf) if raced else None
        finals.append(start if problem.exhausted else climber.full(start.x, goal))
        note("local", best_of(finals).score)
        if d in GRID and _settled(climber, finals):
            break
    if d not in GRID and effort.sketch:
        rng = np.random.default_rng(effort.seed)
        if _settled(climber, finals):
            return SearchOutcome(best_of(finals), tuple(history), (best_of(finals),))
        best_ones = sorted(finals, key=rank, reverse=True)[:_FINALISTS]
        ends = [hop_basins(climber, one, rng, _SKETCHED, _SKETCHED, note).best for one in best_ones]
        return SearchOutcome(best_of(ends), tuple(history), tuple(ends))
    best = best_of(finals)
    if d not in GRID and effort.hops and not _settled(climber, finals):
        rng = np.random.default_rng(effort.seed)
        hop = hop_freely if climber.free else hop_with_limits
        best = hop(climber, finals, rng, effort.hops, note)
    if d in GRID and not climber.free and not problem.exhausted:
        # a climb along a flat limit may have stopped early; a fresh one with short steps costs little
        again = optimise_locally(problem, best.x, max_iterations=60, radius=1e-3)
        best = again if better(again.score, best.score) else best
    if not best.converged and not problem.exhausted:
        best = optimise_locally(problem, best.x, max_iterations=600, radius=0.005)
        note("local", best.score)
    return SearchOutcome(best, tuple(history), (best,))


def refine(
    problem: GainProblem, starts: Sequence[FloatArray], effort: Effort, progress: Progress | None = None
) -> SearchOutcome:
    """Return the best design near some that were found for other loops, such as those in continuous time.

    The best design of the other loops need not lie near the best one of these. So all of them are climbed. From the one
    that leads highest further climbs begin with longer and shorter steps, and the best end is moved at random: a local
    optimum of the other loops often lies beside the narrow region in which eigenvalues of these loops meet.
    """
    history: list[SearchStep] = []
    found: list[LocalOptimum] = []

    def note(stage: str, score: Score) -> None:
        history.append(SearchStep(stage, problem.evaluations, problem.in_units(score.value), score.violation))
        if progress is not None:
            progress(history[-1])

    climber = Climber(problem, gain_units(problem, starts[0]), fine=True)
    same = _SAME * (problem.upper - problem.lower)
    apart = [x for i, x in enumerate(starts) if not any((np.abs(x - y) <= same).all() for y in starts[:i])]
    for x in apart:
        found.append(climber.full(x, None if climber.free else max(map(rank, found), default=-np.inf)))
        note("local", best_of(found).score)
    best = best_of(found)
    leader = next(x for x, one in zip(apart, found, strict=True) if one is best)
    for radius in () if climber.free else _OTHER_RADII:
        best = best_of([best, optimise_locally(problem, leader, max_iterations=100, radius=radius)])
        note("local", best.score)
    if effort.hops:
        rng = np.random.default_rng(effort.seed)
        best = hop_basins(climber, best, rng, effort.hops, 2 * len(climber.hop_sizes), note).best
        best = climber.with_certificate(best)
        note("local", best.score)
    if not best.converged and not climber.certified(best):
        best = optimise_locally(problem, best.x, max_iterations=600, radius=0.005)
        note("local", best.score)
    return SearchOutcome(best, tuple(history), (best,))


def _settled(climber: Climber, finals: list[LocalOptimum]) -> bool:
    """Return whether three of the best designs have the same value and the best one is certified."""
    best = best_of(finals)
    close = [
        one
        for one in finals
        if abs(one.score.value - best.score.value) <= _AGREE * abs(best.score.value) and one.score.violation <= FEASIBLE
    ]
    return len(close) > 2 and climber.certified(best)
