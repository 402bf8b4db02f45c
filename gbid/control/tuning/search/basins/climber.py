"""Climbs to local optima, as many iterations as their stage is worth."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from gbid.arrays import FloatArray
from gbid.control.tuning.search.basins.ranking import PENALTY, better, rank
from gbid.control.tuning.search.nonsmooth.certificate import certify
from gbid.control.tuning.search.nonsmooth.quasi_newton import ascend
from gbid.control.tuning.search.problem import GainProblem
from gbid.control.tuning.search.sqp import LocalOptimum, optimise_locally

GRID = {1: 61, 2: 25, 3: 9}
"""Number of grid points per gain, for up to three gains."""
_HOP_SIZES = (0.005, 0.01, 0.02, 0.05)
"""Sizes of random moves with limits on responses, as shares of the bounds; the way out of a basin may be a few %."""
_FINE_HOPS = (0.0015, 0.005, 0.015, 0.05)
"""The same on the way to a design for sampled loops, whose eigenvalues meet in narrower regions."""
_HOP_RADIUS, _FINE_RADIUS = 0.01, 0.02
"""Trust regions after random moves, and after those."""
_FREE_HOPS = (1e-3, 1e-2, 0.1, 0.5)
"""Sizes of random moves without limits on responses, in units or shares of the gains."""
_ROUGH = 30
"""Number of iterations from each start where more than eigenvalues counts; the better two thirds get as many again."""
LATER_RADIUS = 0.02
"""Trust region with which these go on, as a share of the bounds."""
_SMALL = 8
"""Largest number of gains for which twice as many starts with limits take about a second."""
_FEW = 6
"""Largest number of gains whose first climbs are not plain: they are cheap, and end in the lower basin less often."""
_NEXT = 1e-3
"""Distance from a bound, as a share of the bounds, of a gain that is next to it."""
_SHORT = (1e-3, 5e-3)
"""Trust regions of the short climbs from a design without a certificate."""
_BEHIND = 4e-3
"""By what share of its goal a climb may be behind for each iteration that is left to reach it."""
_RACED = 100
"""Largest number of iterations of a full optimisation in a race: one that creeps gets on faster by a random move."""


@dataclass(frozen=True, eq=False)
class Climber:
    """Local optimisation of a problem: steps over all active functions, and BFGS where nothing but damping counts.

    Limits make a ridge of every design on them, along which BFGS is slow. Without limits it is the faster one: its
    evaluations need one gradient only.

    Parameters
    ----------
    problem : GainProblem
        The design problem.
    unit : (d,) array
        Units of the gains.
    fine : bool
        Whether some random moves are shorter, as a design for a sampled loop needs them.
    """

    problem: GainProblem
    unit: FloatArray
    fine: bool = False
    _certified: dict[bytes, bool] = field(default_factory=dict, init=False, repr=False)

    @property
    def free(self) -> bool:
        """Whether only eigenvalues count."""
        limits = self.problem.limits
        return not (limits.has_responses or limits.measures or self.problem.linear)

    @property
    def starts(self) -> int:
        """Number of random starts."""
        if not self.free:
            return 8 if len(self.unit) > _SMALL else 16
        return 24 if len(self.unit) <= 12 else 12

    @property
    def hop_sizes(self) -> tuple[float, ...]:
        """Sizes of random moves."""
        if self.free:
            return _FREE_HOPS
        return _FINE_HOPS if self.fine else _HOP_SIZES

    def rough(self, start: FloatArray, goal: float, radius: float = 0.1) -> LocalOptimum:
        """Return a design near a start that is better, with few evaluations; fewer where the goal is out of reach."""
        if self.free:
            return self._ascent(start, 100 + 20 * len(start))
        plain = radius > LATER_RADIUS and len(start) > _FEW
        return optimise_locally(
            self.problem,
            start,
            radius=radius,
            max_iterations=_ROUGH,
            tolerance=1e-5,
            goal=goal,
            behind=self._behind,
            rough=plain,
            repair=False,
        )

    def full(self, start: FloatArray, goal: float | None = None) -> LocalOptimum:
        """Return a local optimum; with a goal, as in a race of many starts, only one that soon reaches it."""
        if goal is not None:
            return optimise_locally(self.problem, start, max_iterations=_RACED, goal=goal, behind=self._behind)
        if not self.free:
            return optimise_locally(self.problem, start, max_iterations=300)
        if len(start) in GRID:
            found = optimise_locally(self.problem, start, max_iterations=_RACED)
            if found.converged and self.certified(found):
                return found
        return optimise_locally(self.problem, self._ascent(start, 200 + 60 * len(start)).x, max_iterations=300)

    def hop(self, best: LocalOptimum, size: float, rng: np.random.Generator) -> LocalOptimum:
        """Return the local optimum after a random move of some size; less good where it will not be better."""
        x = best.x
        step = size * rng.standard_normal(len(x))
        if not self.free:
            moved = x + step * (self.problem.upper - self.problem.lower)
            radius, goal = _FINE_RADIUS if self.fine else _HOP_RADIUS, rank(best)
            return optimise_locally(self.problem, moved, max_iterations=60, radius=radius, goal=goal, behind=_BEHIND)
        found = self._ascent(x + step * np.maximum(self.unit, np.abs(x)), 100 + 40 * len(x))
        return optimise_locally(self.problem, found.x, max_iterations=20, radius=1e-3)

    def with_certificate(self, best: LocalOptimum) -> LocalOptimum:
        """Return a certified design by short climbs from a design without a certificate, or else the best one of them.

        A climb along a narrow ridge may creep and end early: others with other first steps do not. One of them begins
        with the gains at the bounds that they are next to.
        """
        low, high = self.problem.lower, self.problem.upper
        near = _NEXT * (high - low)
        at_bounds = np.where(best.x - low < near, low, np.where(high - best.x < near, high, best.x))
        for start in [best.x, at_bounds] if (at_bounds != best.x).any() else [best.x]:
            for radius in _SHORT:
                if self.certified(best) or self.problem.exhausted:
                    return best
                found = optimise_locally(self.problem, start, max_iterations=60, radius=radius)
                best = found if better(found.score, best.score) else best
        return best

    def certified(self, best: LocalOptimum) -> bool:
        """Return whether a design is optimal to first order."""
        key = best.x.tobytes()
        if key not in self._certified:  # to find no certificate takes a hundred times as long as to find one
            self._certified[key] = certify(self.problem, best.x, certificate_units(self.unit, best.x))[0].holds
        return self._certified[key]

    @property
    def _behind(self) -> float:
        """How far climbs from starts may be behind; without an end for few gains, whose starts are cheap."""
        return _BEHIND if len(self.unit) > _SMALL else np.inf

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


def certificate_units(unit: FloatArray, x: FloatArray) -> FloatArray:
    """Return the units of a certificate: a gain's own magnitude, or its unit where it is small."""
    return np.maximum(unit, np.abs(x))
