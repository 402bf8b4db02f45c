"""Order of designs: first by their limits, then by the objective."""

from __future__ import annotations

from gbid.control.tuning.search.nonsmooth.active import Score, merit
from gbid.control.tuning.search.sqp import LocalOptimum

PENALTY = 10.0
FEASIBLE = 1e-6
"""Largest relative violation of a limit that is tolerated."""


def better(one: Score, other: Score) -> bool:
    """Return whether a design is better than another: first by the limits, then by the objective."""
    kept = one.violation <= FEASIBLE, other.violation <= FEASIBLE
    if kept[0] != kept[1]:
        return kept[0]
    return one.value > other.value if kept[0] else one.violation < other.violation


def rank(found: LocalOptimum) -> float:
    """Return the merit of a design, objective minus a penalty on the largest violation."""
    return merit(found.score, PENALTY)


def best_of(found: list[LocalOptimum]) -> LocalOptimum:
    """Return the best of several designs."""
    best = found[0]
    for one in found[1:]:
        best = one if better(one.score, best.score) else best
    return best
