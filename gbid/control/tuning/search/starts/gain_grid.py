"""Start values on a grid, for few gains."""

from __future__ import annotations

from heapq import heapify, heappop, heappush

import numpy as np

from gbid.arrays import FloatArray
from gbid.control.tuning.search.nonsmooth.active import merit
from gbid.control.tuning.search.peaks import IntArray
from gbid.control.tuning.search.plane import true_rates
from gbid.control.tuning.search.problem import GainProblem
from gbid.control.tuning.search.spectrum import eigenvalues
from gbid.control.tuning.search.starts.draws import WIDE

_PENALTY = 10.0
_BOUNDING = 4
"""Largest number of loops of a family in a bound: a few far apart give nearly the bound of all."""
_BEHIND = 0.1
"""How far behind the best merit of the grid a bound may be for all loops to be computed."""


def grid_starts(problem: GainProblem, neutral: FloatArray, unit: FloatArray, n: int, most: int) -> list[FloatArray]:
    """Return the best points of a grid that are not neighbours, best first.

    They are more than the local maxima of the grid, because along a limit the grid would miss optima. The merit in one
    loop, without peaks, is an upper bound and cheap; the merit in some loops is a tighter one. All loops are computed
    only where both are high enough.
    """
    d = len(problem.lower)
    axes = [_axis(*row, n) for row in zip(problem.lower, neutral, problem.upper, unit, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, d)
    places = np.stack(np.meshgrid(*[np.arange(n)] * d, indexing="ij"), axis=-1).reshape(-1, d)
    some = [np.linspace(0, len(f) - 1, min(len(f), _BOUNDING)).astype(np.intp) for f in problem.families]
    tighter = any(len(family) > len(own) for family, own in zip(problem.families, some, strict=True))
    # the node of highest bound comes next: its bound is made tighter, or its merit is computed
    queue = [(-bound, i, False) for i, bound in enumerate(_bounds_of_one(problem, grid, neutral, some))]
    heapify(queue)
    merits = np.full(len(grid), -np.inf)
    best = -np.inf
    while queue and -queue[0][0] > best - _BEHIND:
        _, i, tight = heappop(queue)
        if tighter and not tight:
            heappush(queue, (-merit(problem.score(grid[i], best - _BEHIND, some), _PENALTY), i, True))
            continue
        score = problem.score(grid[i], worst=best - _BEHIND)
        if score.value > best - _BEHIND:
            merits[i] = merit(score, _PENALTY)
            best = max(best, merits[i])
    chosen: list[int] = []
    for i in np.argsort(-merits, kind="stable"):
        if len(chosen) == most or not np.isfinite(merits[i]):
            break
        if all(np.abs(places[i] - places[other]).max() > 1 for other in chosen):
            chosen.append(int(i))
    return [grid[i] for i in chosen]


def _bounds_of_one(problem: GainProblem, designs: FloatArray, neutral: FloatArray, some: list[IntArray]) -> FloatArray:
    """Return upper bounds of the merits (q,) without peaks, from one loop of each family.

    It is the worst one of some loops at the neutral gains.
    """
    value, slow = np.full(len(designs), np.inf), np.full(len(designs), -np.inf)
    for family, own in zip(problem.families, some, strict=True):
        T = family.sample_time
        aims = problem.aim(true_rates(eigenvalues(family.states(neutral)[own]), T), T)
        one = own[int(np.nan_to_num(aims).min(axis=1).argmin())]
        rates = true_rates(eigenvalues(np.stack([family.states(x)[one] for x in designs])), T)
        value = np.minimum(value, problem.aim(rates, T).min(axis=1))
        slow = np.maximum(slow, rates.real.max(axis=1))
    found = value - _PENALTY * np.maximum(0.0, (problem.slowest + slow) / problem.scale)
    return np.asarray(np.where(np.isnan(found), -np.inf, found))


def _axis(low: float, middle: float, high: float, unit: float, n: int) -> FloatArray:
    """Return n nodes over the bounds; between wide bounds they are denser near the middle."""
    if high - low <= WIDE * unit:
        return np.linspace(low, high, n)
    ends = np.arcsinh((low - middle) / unit), np.arcsinh((high - middle) / unit)
    nodes = middle + unit * np.sinh(np.linspace(*ends, n))
    nodes[0], nodes[-1] = low, high
    return np.asarray(nodes)
