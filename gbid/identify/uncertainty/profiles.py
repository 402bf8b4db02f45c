"""Profile likelihoods of estimates: constrained fits along one parameter, and the confidence interval."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal, NamedTuple

import numpy as np
import scipy

from gbid.core.arrays import BoolArray, FloatArray, one_blas_thread
from gbid.identify.options import FitArguments
from gbid.identify.problem.hessian import in_one_window
from gbid.identify.problem.nlp import Box, Iterate, Shooting
from gbid.identify.problem.solve import gauss_newton_step, in_standard_deviations, solve
from gbid.identify.result import Profile, Verdict
from gbid.identify.uncertainty.covariance import Estimate, covariance, grows

End = Literal["crossed", "bound", "edge", "open", "lower"]
"""Why a walk along a parameter ended: the ratio is above the threshold; the parameter is on its bound; the ratio jumps,
or the model has no value beyond; the walk was long or the solver fails, and the ratio is still below; the likelihood is
above that of the fit."""


@dataclass(frozen=True)
class WalkOptions:
    """Options of the walk along a parameter, and of its constrained fits.

    Attributes
    ----------
    steps : float
        Steps to the threshold, in equal parts of the root of the ratio. The end is interpolated: four place it within
        about a thousandth of a standard deviation.
    first : float
        First step of a parameter without standard deviation, as a part of its size.
    at_bound : float
        Distance of a parameter that lies on its bound, or at the edge of the model, as a part of the first step.
    cuts : int
        How often a step is cut, fivefold at most, where the ratio jumps: then the jump counts as found.
    farthest : float
        Distance of an open end, as a multiple of the size of the parameter.
    most : int
        Largest number of points on a side.
    at_rest : float
        Length of the next step, in standard deviations, at which a constrained fit ends. What this step would still
        gain is taken into account: an error of third order in it is left.
    iterations : int
        Largest number of Gauss-Newton steps of a constrained fit; then it is left to IPOPT.
    ridge, damped : float
        Part by which curvatures are raised. The first is above their rounding, and bounds a step along which nothing
        changes. The second is that of Levenberg and Marquardt after a step that does not lower the cost; it rises, and
        falls, tenfold.
    feasible : float
        Distance from a constraint of the caller, as a part of its size, up to which it is met: that of the solver.
    below : float
        Ratio below zero at which the fit counts as not at the minimum. One that converged is at most 0.1 standard
        deviations away, which is a ratio of 0.01.
    """

    steps: float = 4.0
    first: float = 0.1
    at_bound: float = 1e-3
    cuts: int = 6
    farthest: float = 1e3
    most: int = 40
    at_rest: float = 0.1
    iterations: int = 20
    ridge: float = 1e-9
    damped: float = 1e-4
    feasible: float = 1e-6
    below: float = 0.1


WALK = WalkOptions()
_NEAR = 4  # points of a cubic interpolation


class ConstrainedFit(NamedTuple):
    """Minimum of the cost for a fixed value of one parameter: unknowns, iterate, and cost."""

    unknowns: FloatArray
    iterate: Any
    cost: float


class Side(NamedTuple):
    """Walk from the estimate to one side: parameter values, likelihood ratios, and the reason for its end."""

    values: list[float]
    ratios: list[float]
    end: End = "open"


@dataclass(frozen=True, eq=False)
class Profiler:
    """Computation of profile likelihoods around the estimates of a fit; it is pickled as None.

    Attributes
    ----------
    names : tuple of str
        Free parameters.
    loss : float
        Loss of the fit.
    estimate : Estimate
        Problem of the fit at its estimates.
    products : (n_y, n_y) array
        Sum of the products of the errors.
    held : (n_theta,) boolean array
        Parameters on a bound.
    variance : (n_theta,) array
        Variances that the fit trusts.
    curvature : (n_theta,) array
        Variances that the curvature of the cost gives alone.
    coloured : bool
        Whether residuals are coloured.
    """

    names: tuple[str, ...]
    loss: float
    estimate: Estimate
    products: FloatArray
    held: BoolArray
    variance: FloatArray
    curvature: FloatArray
    coloured: bool

    def __reduce__(self) -> tuple[type, tuple[()]]:
        return type(None), ()

    def __call__(self, name: str, unit: str, level: float) -> Profile:
        """Return the profile of a parameter; see `gbid.profile`."""
        with one_blas_thread(), np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            return self._profile(name, unit, level)

    @property
    def likelihood_size(self) -> float:
        """Ratio of the log-likelihood to the cost."""
        return self.estimate.problem.likelihood_size

    def _profile(self, name: str, unit: str, level: float) -> Profile:
        j, threshold = self.names.index(name), float(scipy.special.chdtri(1, 1 - level))
        std, factor = self.spread(j)
        origin, scale = self.origin, float(self.estimate.problem.theta_scale[j])
        to_ratio = 2 * self.likelihood_size / factor
        first = np.sqrt(threshold) / WALK.steps * std / scale
        if not np.isfinite(first):
            first = WALK.first * max(abs(float(origin.unknowns[j])), self.likelihood_size**-0.5)
        sides = [self._walk(j, direction, float(first), to_ratio, threshold) for direction in (-1, 1)]
        values, ratios = ([*reversed(down[1:]), *up] for down, up in zip(sides[0][:2], sides[1][:2], strict=True))
        lower, upper = (_end(side, way, threshold) for side, way in zip(sides, (-1, 1), strict=True))
        return Profile(
            name=name,
            unit=unit,
            estimate=scale * float(origin.unknowns[j]),
            std=std,
            level=level,
            values=scale * np.array(values),
            ratios=np.array(ratios),
            losses=self.losses(np.array(ratios) / to_ratio),
            interval=(scale * lower, scale * upper),
            verdict=_verdict([side.end for side in sides]),
        )

    def _walk(self, j: int, direction: int, first: float, to_ratio: float, threshold: float) -> Side:
        """Walk to one side until the likelihood ratio exceeds the threshold."""
        at, target = self.origin, float(np.sqrt(threshold))
        limit = float(self.estimate.problem.box[max(direction, 0)][j])
        begin, aim, length = float(at.unknowns[j]), target / WALK.steps, first
        side, root, cuts, edge = Side([begin], [0.0]), 0.0, 0, direction * np.inf
        far = WALK.farthest * max(abs(begin), first)
        while len(side.values) <= WALK.most:
            room = direction * (limit - float(at.unknowns[j]))
            if room <= (WALK.at_bound * first if at is self.origin else 0.0):
                side.values[-1] = limit
                return side._replace(end="bound")
            length = min(length, room, abs(edge - float(at.unknowns[j])) / 2)
            following = self.constrained(at, j, direction * length, WALK.damped if cuts else WALK.ridge)
            if following is None:
                if length < WALK.at_bound * first:
                    return side._replace(end="edge")
                edge = float(at.unknowns[j]) + direction * length
                continue
            ratio = to_ratio * (following.cost - self.origin.cost)
            if ratio < -WALK.below:
                return side._replace(end="lower")
            rise = np.sqrt(np.maximum(ratio, 0.0)) - root
            if not rise <= 2 * aim:
                if cuts == WALK.cuts:
                    return side._replace(end="open" if np.isnan(rise) else "edge")
                length, cuts = length * (max(0.2, aim / rise) if rise > 0 else 0.5), cuts + 1
                continue
            side.values.append(float(following.unknowns[j]))
            side.ratios.append(max(ratio, 0.0))
            at, root, cuts = following, root + rise, 0
            if root > target:
                return side._replace(end="crossed")
            if abs(side.values[-1] - begin) > far:
                break
            wanted = aim if target - root > 1.5 * aim else 1.05 * (target - root)
            length *= min(2.0, max(0.2, wanted / rise)) if rise > 0 else 2.0
        return side

    @cached_property
    def posed(self) -> tuple[Shooting, FloatArray]:
        """Problem and its solution, with one window for each segment unless the model grows within it."""
        at = self.estimate
        unknowns = at.problem.pack(at.theta, at.starts)
        if not at.problem.parts or grows(at):
            return at.problem, unknowns
        joined, kept = in_one_window(at.problem)
        return joined, unknowns[kept]

    @cached_property
    def origin(self) -> ConstrainedFit:
        """Minimum of the cost with all parameters free: the solution after some more steps."""
        problem, unknowns = self.posed
        begin = ConstrainedFit(unknowns, problem.at(unknowns), problem.at(unknowns).cost)
        minimum = self.constrained(begin, None, 0.0)
        return begin if minimum is None or np.isnan(minimum.cost) else minimum

    def constrained(
        self, start: ConstrainedFit, j: int | None, change: float, ridge: float = WALK.ridge
    ) -> ConstrainedFit | None:
        """Return the minimum with one unknown fixed at a shifted value, from the minimum `start`.

        It is None where the model has no value or constraints contradict each other, and its cost nan where the solver
        does not converge. The first step is along the tangent of the path of the minima: Newton's, with the unknown
        where it is to be.
        """
        (problem, unknowns), (lower, upper) = self.posed, self.posed[0].box
        box, move, still = (lower.copy(), upper.copy()), np.zeros(len(unknowns)), np.zeros(len(unknowns))
        if j is not None:
            move[j] = change
            box[0][j] = box[1][j] = start.unknowns[j] + change
        n_rows = 0 if problem.extra is None else len(problem.extra.lower)
        direct = not len(problem.limits[0]) and not n_rows  # else the active ones have to be found
        to_ratio, x = 2 * self.likelihood_size, start.unknowns + move
        try:
            if direct and change:
                x = start.unknowns + self._step(start.iterate, start.unknowns, move, box, ridge)
            iterate = problem.at(x)
            if not np.isfinite(iterate.cost):
                return None
            for _ in range(WALK.iterations if direct else 0):
                step = self._step(iterate, x, still, box, ridge)
                length = in_standard_deviations(problem, iterate, step)
                if length < WALK.at_rest and ridge == WALK.ridge:
                    return ConstrainedFit(x, iterate, iterate.cost - length**2 / to_ratio)
                trial = problem.at(x + step)
                if not (np.isfinite(trial.cost) if problem.n_gaps else trial.cost <= iterate.cost):
                    ridge = max(10 * ridge, WALK.damped)
                    continue
                at_rest = not problem.n_gaps and to_ratio * (iterate.cost - trial.cost) < WALK.at_rest**2
                x, iterate, ridge = x + step, trial, max(ridge / 10, WALK.ridge)
                if at_rest and ridge <= WALK.damped:
                    return ConstrainedFit(x, iterate, iterate.cost)
        except (RuntimeError, ValueError, scipy.sparse.linalg.MatrixRankWarning):  # singular
            pass
        solution = solve(replace(problem, box=box), x, FitArguments(max_iterations=50))
        iterate = problem.at(solution.unknowns)
        if problem.extra is not None and not problem.extra.violation(iterate.extra_rows) < WALK.feasible:
            return None
        return ConstrainedFit(solution.unknowns, iterate, iterate.cost if solution.status.success else np.nan)

    def _step(self, iterate: Iterate, x: FloatArray, move: FloatArray, box: Box, ridge: float) -> FloatArray:
        """Return the step to the minimum of a quadratic model within a box; `move` are the first free unknowns."""
        problem = self.posed[0]
        pattern, slopes = problem.hessian_pattern, problem.jacobian_pattern
        beside = pattern.rows != pattern.columns
        hessian = iterate.hessian * np.where(beside, 1.0, 1 + ridge)
        below = np.where(beside, hessian * move[pattern.rows], 0.0)
        gradient = iterate.gradient + np.bincount(pattern.rows, hessian * move[pattern.columns], len(x))
        gradient += np.bincount(pattern.columns, below, len(x))
        gaps = iterate.gaps + np.bincount(slopes.rows, iterate.jacobian * move[slopes.columns], len(iterate.gaps))
        model = iterate._replace(hessian=hessian, gradient=gradient, gaps=gaps)
        return move + gauss_newton_step(problem, model, x, box)

    def spread(self, j: int) -> tuple[float, float]:
        """Return a parameter's standard deviation, and the factor by which its likelihood ratios are too large.

        A parameter on a bound gets them as if it were free; one that is not determined has no standard deviation, and
        the factor of the others.
        """
        variance, curvature = self.variance, self.curvature
        if self.held[j]:
            held = self.held.copy()
            held[j] = False
            spread = covariance(self.estimate, self.products, held, coloured=self.coloured)
            variance, curvature = np.diag(spread.robust if self.coloured else spread.white), np.diag(spread.curvature)
        factors = variance * self.likelihood_size / curvature
        known = np.isfinite(factors) & (factors > 0)
        if known[j]:
            return float(np.sqrt(variance[j])), float(factors[j])
        return np.nan, float(np.median(factors[known])) if known.any() else 1.0

    def losses(self, rises: FloatArray) -> FloatArray:
        """Return the losses at which the cost exceeds its minimum by `rises`."""
        return np.asarray(self.loss * np.exp(2 * rises) if self.estimate.problem.parts else self.loss + 2 * rises)


def _end(side: Side, direction: int, threshold: float) -> float:
    """Return the end of a confidence interval on one side, scaled; infinite where it is open."""
    if side.end in ("open", "lower"):
        return direction * np.inf
    if side.end != "crossed":
        return side.values[-1]
    roots, values = np.sqrt(side.ratios), np.array(side.values)
    falls = np.flatnonzero(np.diff(roots) <= 0)
    near = slice(max(int(falls[-1]) + 1 if len(falls) else 0, len(roots) - _NEAR), None)  # points on a rising stretch
    curve = np.polyfit(roots[near], values[near], len(roots[near]) - 1)
    return float(np.clip(np.polyval(curve, np.sqrt(threshold)), *np.sort(values[-2:])))


def _verdict(ends: Sequence[End]) -> Verdict:
    if "lower" in ends:
        return "not a minimum"
    closed = sum(end in ("crossed", "edge") for end in ends)
    words: tuple[Verdict, ...] = ("flat", "one-sided", "identifiable")
    return words[closed]
