"""Global search: choice of start values, and the best of the local optima."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from gbid.arrays import FloatArray
from gbid.control.tuning.search.nonsmooth.active import Score, merit
from gbid.control.tuning.search.nonsmooth.certificate import certify
from gbid.control.tuning.search.nonsmooth.quasi_newton import ascend
from gbid.control.tuning.search.problem import GainProblem
from gbid.control.tuning.search.sqp import LocalOptimum, optimise_locally
from gbid.control.tuning.search.starts.draws import grid_starts, random_starts
from gbid.control.tuning.search.starts.units import gain_units
from gbid.control.tuning.search.step import SearchStep

Progress = Callable[[SearchStep], None]
PENALTY = 10.0
_GRID = {1: 61, 2: 25, 3: 9}
"""Number of grid points per gain, for up to three gains."""
_HOP_SIZES = (0.0015, 0.005, 0.015, 0.05)
_FREE_HOPS = (1e-3, 1e-2, 0.1, 0.5)
"""Sizes of random moves without limits on responses, in units or shares of the gains."""
_HOPPED = 2
"""Number of different designs for basin hopping; the best one before it need not be the best one after it."""
_FINALISTS = 3
"""Largest number of finalists where more than eigenvalues counts: their rough optimisation already is nearly full."""
_SAME = 1e-3
"""Distance of rough designs of few gains, as a share of the bounds, within which they belong to one optimum."""
_ROUNDS = 3
"""Largest number of rounds of random moves with limits, as long as the best design has no certificate."""
_PROGRESS = 3e-4
"""Relative gain of a random move below which it counts as in vain."""
_NEAR = 1e-4
"""Relative difference of values after random moves that count as the same optimum."""
_RETURNED = 2
"""Number of longest random moves to the same optimum after which it is taken for the best one."""
_AGREE = 1e-5
"""Relative difference of local optima that count as one."""
FEASIBLE = 1e-6
"""Largest relative violation of a limit that is tolerated."""


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
    climber = Climber(problem, gain_units(problem, given[0]))
    rough: list[LocalOptimum] = []
    if d in _GRID and effort.starts is None:
        for x in (*given, *grid_starts(problem, given[0], climber.unit, _GRID[d], effort.finalists)):
            rough.append(optimise_locally(problem, x, max_iterations=12, tolerance=1e-4, curvature=False))
        note("global", _best(rough).score)
    else:
        n = effort.starts if effort.starts is not None else climber.starts
        for start in (*given, *random_starts(problem, given[0], climber.unit, n, effort.seed)):
            rough.append(climber.rough(start))
            note("global", _best(rough).score)
            if problem.exhausted:
                break
    rough.sort(key=lambda found: merit(found.score, PENALTY), reverse=True)
    finals: list[LocalOptimum] = []
    for start in rough[: effort.finalists if climber.free or d in _GRID else min(effort.finalists, _FINALISTS)]:
        same = (problem.upper - problem.lower) * (_SAME if d in _GRID else 1e-6)
        if any((np.abs(start.x - other.x) <= same).all() for other in finals):
            continue
        finals.append(start if problem.exhausted else climber.full(start.x))
        note("local", _best(finals).score)
    best = _best(finals)
    if d not in _GRID and effort.hops and not _settled(problem, climber, finals):
        rng = np.random.default_rng(effort.seed)
        kinds = len(climber.hop_sizes)
        if climber.free:
            apart = _apart(finals, 0.1 * (problem.upper - problem.lower))[:_HOPPED]
            best = _best([_hop_basins(climber, start, rng, effort.hops, kinds, note) for start in apart])
        for _ in range(1 if climber.free else _ROUNDS):
            best = _hop_basins(climber, best, rng, effort.hops, (2 if climber.free else 3) * kinds, note)
            if climber.free or certify(problem, best.x, certificate_units(climber.unit, best.x))[0].holds:
                break
    if not best.converged and not problem.exhausted:
        best = optimise_locally(problem, best.x, max_iterations=600, radius=0.005)
        note("local", best.score)
    return SearchOutcome(best, tuple(history))


def refine(problem: GainProblem, start: FloatArray, effort: Effort, progress: Progress | None = None) -> SearchOutcome:
    """Return the best design near one that was found for other loops, such as those in continuous time.

    With more than three gains by basin hopping as well: a local optimum of the other loops often lies beside the narrow
    region in which eigenvalues of these loops meet.
    """
    history: list[SearchStep] = []

    def note(stage: str, score: Score) -> None:
        history.append(SearchStep(stage, problem.evaluations, problem.in_units(score.value), score.violation))
        if progress is not None:
            progress(history[-1])

    best = optimise_locally(problem, start, max_iterations=300, radius=0.02)
    note("local", best.score)
    if len(start) not in _GRID and effort.hops:
        climber, rng = Climber(problem, gain_units(problem, best.x)), np.random.default_rng(effort.seed)
        best = _hop_basins(climber, best, rng, effort.hops, 2 * len(climber.hop_sizes), note)
    return SearchOutcome(best, tuple(history))


@dataclass(frozen=True, eq=False)
class Climber:
    """Local optimisation of a problem: steps over all active functions, and BFGS where nothing but damping counts.

    Limits make a ridge of every design on them, along which BFGS is slow. Without limits it is the faster one: its
    evaluations need one gradient only.
    """

    problem: GainProblem
    unit: FloatArray

    @property
    def free(self) -> bool:
        """Whether only eigenvalues count."""
        limits = self.problem.limits
        return not (limits.has_responses or limits.measures or self.problem.linear)

    @property
    def starts(self) -> int:
        """Number of random starts."""
        if not self.free:
            return 8
        return 24 if len(self.unit) <= 12 else 12

    @property
    def hop_sizes(self) -> tuple[float, ...]:
        """Sizes of random moves."""
        return _FREE_HOPS if self.free else _HOP_SIZES

    def rough(self, start: FloatArray) -> LocalOptimum:
        """Return a design near a start that is better, with few evaluations."""
        if self.free:
            return self._ascent(start, 100 + 20 * len(start))
        return optimise_locally(self.problem, start, max_iterations=100, tolerance=1e-5)

    def full(self, start: FloatArray) -> LocalOptimum:
        """Return a local optimum."""
        if self.free:
            start = self._ascent(start, 200 + 60 * len(start)).x
        return optimise_locally(self.problem, start, max_iterations=300)

    def hop(self, best: LocalOptimum, size: float, rng: np.random.Generator) -> LocalOptimum:
        """Return the local optimum after a random move of some size; less good where it will not be better."""
        x = best.x
        step = size * rng.standard_normal(len(x))
        if not self.free:
            moved = x + step * (self.problem.upper - self.problem.lower)
            return optimise_locally(
                self.problem, moved, max_iterations=60, radius=0.02, goal=merit(best.score, PENALTY)
            )
        found = self._ascent(x + step * np.maximum(self.unit, np.abs(x)), 100 + 40 * len(x))
        return optimise_locally(self.problem, found.x, max_iterations=20, radius=1e-3)

    @property
    def _left(self) -> int:
        return max((self.problem.most_evaluations or 0) - self.problem.evaluations, 1)

    def _ascent(self, start: FloatArray, most: int) -> LocalOptimum:
        problem = self.problem
        x = np.clip(start, problem.lower, problem.upper)
        found = ascend(
            lambda y: problem.merit_and_slope(y, PENALTY),
            x,
            problem.lower,
            problem.upper,
            self.unit,
            max_evaluations=most if problem.most_evaluations is None else min(most, self._left),
        )
        return LocalOptimum(found.x, problem.score(found.x), found.evaluations, True)


def _settled(problem: GainProblem, climber: Climber, finals: list[LocalOptimum]) -> bool:
    """Return whether three of the best designs have the same value and the best one is certified."""
    best = _best(finals)
    close = [
        one
        for one in finals
        if abs(one.score.value - best.score.value) <= _AGREE * abs(best.score.value) and one.score.violation <= FEASIBLE
    ]
    return len(close) > 2 and certify(problem, best.x, certificate_units(climber.unit, best.x))[0].holds


def certificate_units(unit: FloatArray, x: FloatArray) -> FloatArray:
    """Return the units of a certificate: a gain's own magnitude, or its unit where it is small."""
    return np.maximum(unit, np.abs(x))


def _hop_basins(
    climber: Climber,
    best: LocalOptimum,
    rng: np.random.Generator,
    most: int,
    in_vain: int,
    note: Callable[[str, Score], None],
) -> LocalOptimum:
    """Move a design at random and optimise again, until a number of moves in a row gave no improvement.

    With limits, fewer moves are enough when several of the longest ones end at the same value.
    """
    vain = returned = 0
    for i in range(most):
        if vain == in_vain or returned == _RETURNED or climber.problem.exhausted:
            break
        size = climber.hop_sizes[i % len(climber.hop_sizes)]
        again = climber.hop(best, size, rng)
        progress = again.score.value - best.score.value > _PROGRESS * abs(best.score.value)
        repaired = again.score.violation <= FEASIBLE < best.score.violation
        improved = better(again.score, best.score)
        vain = 0 if improved and (progress or repaired) else vain + 1
        near = abs(again.score.value - best.score.value) <= _NEAR * abs(best.score.value)
        returned = 0 if not vain else returned + (near and size == max(climber.hop_sizes) and not climber.free)
        best = again if improved else best
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
