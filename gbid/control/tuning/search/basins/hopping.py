"""Basin hopping: random moves of a design, each with a new local optimisation."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from gbid.arrays import FloatArray
from gbid.control.tuning.search.basins.climber import Climber
from gbid.control.tuning.search.basins.ranking import FEASIBLE, best_of, better, rank
from gbid.control.tuning.search.nonsmooth.active import Score
from gbid.control.tuning.search.sqp import LocalOptimum

Note = Callable[[str, Score], None]
_HOPPED = 2
"""Number of different designs for basin hopping; the best one before it need not be the best one after it."""
_FIRST, _LATER = 12, 4
"""Number of random moves of each size with limits until the first improvement, and after an improvement."""
_PROGRESS = 3e-4
"""Relative gain of a random move below which it counts as in vain."""
_OTHER = 1e-3
"""Relative difference of values from which on designs count as different optima."""
_STALLED = 0.03
"""Relative gain by random moves from which on the first climbs are taken for stalled ones."""
_KNOWN = 3e-4
"""Relative difference of values of two lines of random moves that count as the same optimum."""
_SAME = 1e-4
"""Relative difference of values after random moves that count as the same optimum."""
_WIDE, _RETURNED = 3, 8
"""Number of random moves to the same optimum, the shortest moves not counted, from which on its basin counts as wide,
and after which no more moves are made."""


@dataclass(frozen=True)
class HoppedLine:
    """Best design of a line of random moves, how many longer moves came back to it, and the optima on the way."""

    best: LocalOptimum
    returned: int
    optima: tuple[Score, ...]


def hop_freely(
    climber: Climber, finals: list[LocalOptimum], rng: np.random.Generator, most: int, note: Note
) -> LocalOptimum:
    """Move the best different designs at random, then the best one that was found."""
    kinds = len(climber.hop_sizes)
    apart = _apart(finals, 0.1 * (climber.problem.upper - climber.problem.lower))[:_HOPPED]
    lines = [hop_basins(climber, start, rng, most, kinds, note).best for start in apart]
    return hop_basins(climber, best_of(lines), rng, most, 2 * kinds, note).best


def hop_with_limits(
    climber: Climber, finals: list[LocalOptimum], rng: np.random.Generator, most: int, note: Note
) -> LocalOptimum:
    """Move the best design at random, then other ones where the best one cannot be trusted.

    All others where it has no certificate, or where the moves made it much better: the first climbs had stalled, so
    their order says little. One other where the moves came back or led nowhere: a better one may lie far off.
    """
    kinds = len(climber.hop_sizes)
    start = best_of(finals)
    others = [one for one in finals if abs(one.score.value - start.score.value) > _OTHER * abs(start.score.value)]
    line = hop_basins(climber, start, rng, most, _LATER * kinds, note, first=_FIRST * kinds)
    known = line.optima
    best = climber.with_certificate(line.best)
    much_better = best.score.value - start.score.value > _STALLED * abs(start.score.value)
    stuck = line.returned >= _WIDE or _same(best.score, start.score, _OTHER)
    doubted = len(others) if much_better else int(stuck)
    for moved, other in enumerate(sorted(others, key=rank, reverse=True)):
        if climber.problem.exhausted or (moved >= doubted and climber.certified(best)):
            break
        line = hop_basins(climber, other, rng, most, 2 * kinds, note, known)
        known += line.optima
        if better(line.best.score, best.score):
            line = hop_basins(climber, line.best, rng, most, 3 * kinds, note, known)
            known += line.optima
            best = climber.with_certificate(line.best)
    return best


def hop_basins(
    climber: Climber,
    best: LocalOptimum,
    rng: np.random.Generator,
    most: int,
    in_vain: int,
    note: Note,
    known: tuple[Score, ...] = (),
    first: int = 0,
) -> HoppedLine:
    """Move a design at random and optimise again, until a number of moves in a row gave no improvement.

    Before any improvement `first` moves may be in vain, if that is more: where one move of five leads to a better
    design, ten in a row miss it once in ten times. With limits, fewer moves are enough when several of them come back
    to the same optimum, or when one leads to an optimum that is known from another line.
    """
    vain = returned = 0
    optima: list[Score] = []
    for i in range(most):
        enough = vain >= (in_vain if vain < i else max(first, in_vain))
        if enough or returned == _RETURNED or climber.problem.exhausted:
            break
        size = climber.hop_sizes[i % len(climber.hop_sizes)]
        again = climber.hop(best, size, rng)
        progress = again.score.value - best.score.value > _PROGRESS * abs(best.score.value)
        repaired = again.score.violation <= FEASIBLE < best.score.violation
        improved = better(again.score, best.score)
        vain = 0 if improved and (progress or repaired) else vain + 1
        counts = _same(again.score, best.score) and size > climber.hop_sizes[0] and not climber.free
        returned = returned + counts if vain else 0
        best = again if improved else best
        note("basin hopping", best.score)
        if improved and any(_same(best.score, one, _KNOWN) for one in known):
            break
        if improved:
            optima.append(best.score)
    return HoppedLine(best, returned, tuple(optima))


def _same(one: Score, other: Score, share: float = _SAME) -> bool:
    return one.violation <= FEASIBLE and abs(one.value - other.value) <= share * abs(other.value)


def _apart(found: list[LocalOptimum], distance: FloatArray) -> list[LocalOptimum]:
    """Return designs that differ by more than a distance in some gain, best first."""
    chosen: list[LocalOptimum] = []
    for one in sorted(found, key=rank, reverse=True):
        if all((np.abs(one.x - other.x) > distance).any() for other in chosen):
            chosen.append(one)
    return chosen
