"""Random start values of the search."""

from __future__ import annotations

import numpy as np

from gbid.arrays import FloatArray
from gbid.control.tuning.search.limits import Limits
from gbid.control.tuning.search.nonsmooth.quasi_newton import ascend
from gbid.control.tuning.search.problem import GainProblem
from gbid.control.tuning.search.starts.spread import spread_points

_SHARES = (1.0, 0.5, 0.25, 0.12, 0.06, 0.03)
WIDE = 8.0
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
        Seed of the random numbers.
    """
    d, low, high = len(neutral), problem.lower, problem.upper
    rows = spread_points(n, d + 1, seed)
    # with positive bounds over more than a decade, starts have a logarithmic distribution
    decades = (low > 0) & (high > 10 * low)
    first, last = np.where(decades, low, 1.0), np.where(decades, high, 1.0)
    starts = []
    for u, far in zip(rows[:, :d], rows[:, d], strict=True):
        x = np.where(decades, first * (last / first) ** u, low + u * (high - low))
        reach = np.where(decades, 1.0, np.minimum(WIDE * unit / (high - low), 1.0) ** (1.0 - far))
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
