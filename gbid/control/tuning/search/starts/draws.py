"""Start values of the search: a grid for few gains, random starts for many."""

from __future__ import annotations

import numpy as np
import scipy

from gbid.arrays import FloatArray
from gbid.control.tuning.search.limits import Limits
from gbid.control.tuning.search.nonsmooth.active import merit
from gbid.control.tuning.search.nonsmooth.quasi_newton import ascend
from gbid.control.tuning.search.plane import true_rates
from gbid.control.tuning.search.problem import GainProblem
from gbid.control.tuning.search.spectrum import eigenvalues

_SHARES = (1.0, 0.5, 0.25, 0.12, 0.06, 0.03)
_PENALTY = 10.0
_BOUNDING = 4
"""Largest number of loops of a family in a bound: a few far apart give nearly the bound of all."""
_BEHIND = 0.1
"""How far behind the best merit of the grid a bound may be for peaks to be computed."""
_WIDE = 8.0
"""Width of the bounds, in units of the gain, from which on a grid and random starts are denser near the middle."""


def random_starts(problem: GainProblem, neutral: FloatArray, unit: FloatArray, n: int, seed: int) -> list[FloatArray]:
    """Return random starts around the neutral gains, each moved or climbed to where its loops are stable.

    Their distances from the neutral gains lie between the units of the gains and the widths of the bounds, with a
    logarithmic distribution. So bounds that are far too wide still leave starts where loops can be stable.

    Parameters
    ----------
    problem : GainProblem
        The design problem.
    neutral : (d,) array
        Gains near which the loops are probably stable.
    unit : (d,) array
        Units of the gains.
    n : int
        Number of starts.
    seed : int
        Seed of the Sobol sequence.
    """
    d, low, high = len(neutral), problem.lower, problem.upper
    rows = scipy.stats.qmc.Sobol(d + 1, seed=np.random.default_rng(seed)).random(1 << max(n - 1, 1).bit_length())[:n]
    # with positive bounds over more than a decade, starts have a logarithmic distribution
    decades = (low > 0) & (high > 10 * low)
    first, last = np.where(decades, low, 1.0), np.where(decades, high, 1.0)
    starts = []
    for u, far in zip(rows[:, :d], rows[:, d], strict=True):
        x = np.where(decades, first * (last / first) ** u, low + u * (high - low))
        reach = np.where(decades, 1.0, np.minimum(_WIDE * unit / (high - low), 1.0) ** (1.0 - far))
        x = neutral + reach * (x - neutral)
        for share in _SHARES:
            start = neutral + np.where(decades, 1.0, share) * (x - neutral)
            if problem.stable(start):
                break
        else:
            start = stabilised(problem, x, unit)
        starts.append(start)
    return starts


def stabilised(problem: GainProblem, x: FloatArray, unit: FloatArray) -> FloatArray:
    """Return gains whose loops are stable, by an ascent of the slowest decay; or where that ascent ends."""
    decay = GainProblem(problem.families, Limits("decay"), problem.lower, problem.upper, problem.scale)
    enough = 1.1 * problem.slowest / problem.scale + 1e-3
    found = ascend(
        lambda y: decay.merit_and_slope(y, 0.0),
        x,
        problem.lower,
        problem.upper,
        unit,
        max_evaluations=60 + 15 * len(x),
        enough=enough,
    )
    problem.evaluations += decay.evaluations
    return found.x


def grid_starts(problem: GainProblem, neutral: FloatArray, unit: FloatArray, n: int, most: int) -> list[FloatArray]:
    """Return the best points of a grid that are not neighbours, best first.

    They are more than the local maxima of the grid, because along a limit the grid would miss optima. The objective
    without its limits is an upper bound of the merit and cheap. So peaks are computed only where this bound is high
    enough.
    """
    d = len(problem.lower)
    axes = [_axis(*row, n) for row in zip(problem.lower, neutral, problem.upper, unit, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, d)
    places = np.stack(np.meshgrid(*[np.arange(n)] * d, indexing="ij"), axis=-1).reshape(-1, d)
    aims = np.array([_merit_bound(problem, x) for x in grid])
    merits = np.full(len(grid), -np.inf)
    best = -np.inf
    for i in np.argsort(-aims, kind="stable"):
        if aims[i] <= best - _BEHIND:
            break
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


def _merit_bound(problem: GainProblem, x: FloatArray) -> float:
    """Return an upper bound of the merit, the objective minus a penalty of the slowest pole, from some of the loops."""
    value, slow = np.inf, -np.inf
    for family in problem.families:
        some = np.linspace(0, len(family) - 1, min(len(family), _BOUNDING)).astype(int)
        values = true_rates(eigenvalues(family.states(x)[some]), family.sample_time)
        if np.isnan(values).any():
            return -np.inf
        worst = float(problem.aim(values, family.sample_time).min())
        value, slow = min(value, worst), max(slow, float(values.real.max()))
    return value - _PENALTY * max(0.0, (problem.slowest + slow) / problem.scale)


def _axis(low: float, middle: float, high: float, unit: float, n: int) -> FloatArray:
    """Return n nodes over the bounds; between wide bounds they are denser near the middle."""
    if high - low <= _WIDE * unit:
        return np.linspace(low, high, n)
    ends = np.arcsinh((low - middle) / unit), np.arcsinh((high - middle) / unit)
    nodes = middle + unit * np.sinh(np.linspace(*ends, n))
    nodes[0], nodes[-1] = low, high
    return np.asarray(nodes)
