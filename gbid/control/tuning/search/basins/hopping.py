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
_ROUNDS = 3
"""Largest number of rounds of random moves with limits, as long as the best design has no certificate."""
_PROGRESS = 3e-4
"""Relative gain of a random move below which it counts as in vain."""
_NEAR = 1e-4
"""Relative difference of values after random moves that count as the same optimum."""
_KNOWN = 3e-4
"""Relative difference of values of two lines of random moves that count as the same optimum."""
_OTHER = 1e-3
"""Relative difference of values from which on designs count as different optima."""
_RETURNED = 2
"""Number of longest random moves to the same optimum after which it is taken for the best one."""


@dataclass(frozen=True)
class HoppedLine:
    """Best design of a line of random moves, whether a longer one in vain ended at its value, and its optima."""

    best: LocalOptimum
    returned: bool
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
    climber: Climber,
    finals: list[LocalOptimum],
    rng: np.random.Generator,
    most: int,
    note: Note,
) -> LocalOptimum:
    """Move the best design at random; also another one, unless long moves come back to the best one.

    A local optimum of which no move comes back may be a narrow one beside the way to a better one.
    """
    best, kinds = best_of(finals), len(climber.hop_sizes)
    others = [one for one in finals if abs(one.score.value - best.score.value) > _OTHER * abs(best.score.value)]
    if not others:
        best = hop_basins(climber, best, rng, most, 3 * kinds, note).best
    first: HoppedLine | None = None
    for start in [best, max(others, key=rank)] if others else []:
        line = hop_basins(climber, start, rng, most, 2 * kinds, note, first)
        best = line.best if better(line.best.score, best.score) or line.best.score == best.score else best
        if line.best is best and line.returned:
            break
        first = line
    for _ in range(_ROUNDS - 1):
        best = climber.with_certificate(best)
        if climber.problem.exhausted or climber.certified(best):
            break
        best = hop_basins(climber, best, rng, most, 3 * kinds, note).best
    return best


def hop_basins(
    climber: Climber,
    best: LocalOptimum,
    rng: np.random.Generator,
    most: int,
    in_vain: int,
    note: Note,
    before: HoppedLine | None = None,
) -> HoppedLine:
    """Move a design at random and optimise again, until a number of moves in a row gave no improvement.

    With limits, fewer moves are enough when several of the longest ones end at the same value. After a line `before`,
    an end is any optimum from which that one went on to a better one.
    """
    vain = longest = long = 0
    optima = [best.score]
    for i in range(most):
        if vain == in_vain or longest == _RETURNED or climber.problem.exhausted:
            break
        size = climber.hop_sizes[i % len(climber.hop_sizes)]
        again = climber.hop(best, size, rng)
        progress = again.score.value - best.score.value > _PROGRESS * abs(best.score.value)
        repaired = again.score.violation <= FEASIBLE < best.score.violation
        improved = better(again.score, best.score)
        vain = 0 if improved and (progress or repaired) else vain + 1
        near = vain > 0 and _same(again.score, best.score)
        longest = 0 if not vain else longest + (near and size == climber.hop_sizes[-1] and not climber.free)
        long = 0 if not vain else long + (near and size in climber.hop_sizes[-2:])
        best = again if improved else best
        note("basin hopping", best.score)
        if improved:
            optima.append(best.score)
            if before is None or _same(best.score, before.best.score, _KNOWN):
                continue
            if any(_same(best.score, one, _KNOWN) for one in before.optima):
                break
    return HoppedLine(best, bool(long), tuple(optima))


def _same(one: Score, other: Score, share: float = _NEAR) -> bool:
    return one.violation <= FEASIBLE and abs(one.value - other.value) <= share * abs(other.value)


def _apart(found: list[LocalOptimum], distance: FloatArray) -> list[LocalOptimum]:
    """Return designs that differ by more than a distance in some gain, best first."""
    chosen: list[LocalOptimum] = []
    for one in sorted(found, key=rank, reverse=True):
        if all((np.abs(one.x - other.x) > distance).any() for other in chosen):
            chosen.append(one)
    return chosen
