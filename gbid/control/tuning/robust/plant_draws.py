"""Performance of a design on drawn plants, one by one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import bdtrc, betaincinv

from gbid.arrays import FloatArray
from gbid.brief import Brief
from gbid.control.tuning.plants.plant_set import PlantSet
from gbid.control.tuning.search.problem import GainProblem

_BLOCK = 300
HOLDS = 1e-3
"""Relative violation up to which a limit counts as kept by a drawn plant, whose peaks are found on a grid."""


@dataclass(frozen=True, eq=False)
class PlantDraws(Brief):
    """Performance of a design on drawn plants, each the worst of the operating points.

    Attributes
    ----------
    value : (n,) array
        Objective: smallest damping factor, or slowest decay [1/s].
    violation : (n,) array
        Largest relative violation of a limit; at most 0 where all limits hold.
    """

    value: FloatArray
    violation: FloatArray

    @property
    def keeps_limits(self) -> FloatArray:
        """Whether each plant keeps all limits, as 0 or 1 (n,)."""
        return (self.violation <= HOLDS).astype(float)

    def share(self, value: float) -> float:
        """Return the share of plants that reach a value and keep all limits.

        Parameters
        ----------
        value : float
            Damping factor or decay [1/s].
        """
        return float(((self.value >= value - 1e-9) & (self.violation <= HOLDS)).mean())

    def reached(self, probability: float) -> float:
        """Return the value that a share of the plants reaches.

        Parameters
        ----------
        probability : float
            The share.
        """
        ranked = np.sort(self.value)
        return float(ranked[int(np.floor((1 - probability) * len(ranked) + 1e-9))])

    def promised(self, probability: float, confidence: float) -> float:
        """Return the value that a plant reaches with a probability, at a confidence, whatever the distribution.

        It is the k-th smallest value of the draws. That a share of at least `probability` of all plants reaches it has
        the confidence ``P(Binomial(n, 1 - probability) >= k)``. Minus infinity when there are too few draws.

        Parameters
        ----------
        probability, confidence : float
            Between 0 and 1.
        """
        n = len(self.value)
        k = int(np.sum(bdtrc(np.arange(n), n, 1 - probability) >= confidence))  # it falls with k
        return float(np.sort(self.value)[k - 1]) if k > 0 else -np.inf


def lower_bound(share: float, n: int, confidence: float) -> float:
    """Return the lower confidence bound of a probability from the share of n trials (Clopper and Pearson 1934)."""
    k = round(share * n)
    return float(betaincinv(k, n - k + 1, 1 - confidence)) if k else 0.0


def on_draws(problem: GainProblem, plants: PlantSet, points: FloatArray, x: FloatArray, n: int) -> PlantDraws:
    """Return the performance of gains on n drawn plants, without the nominal one.

    Parameters
    ----------
    problem : GainProblem
        Objective and limits.
    plants : PlantSet
        Plants with n draws: m loops of the nominal plant, then m of each draw.
    points : (m, 2) array
        Operating points.
    x : (d,) array
        Gains.
    n : int
        Number of draws.
    """
    m = len(points)
    each = max(1, _BLOCK // m)
    values, violations = [], []
    for first in range(1, n + 1, each):
        many = min(each, n + 1 - first)
        rows = problem.by_loop(plants.family(points, range(m * first, m * (first + many))), x)
        by_plant = rows.reshape(len(rows), many, m).max(axis=2)
        values.append([problem.in_units(float(v)) for v in -by_plant[0]])
        violations.append(by_plant[1:].max(axis=0))
    return PlantDraws(np.concatenate(values), np.concatenate(violations))
