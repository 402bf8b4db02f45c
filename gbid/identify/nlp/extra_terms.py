"""Further cost and constraints of a caller, on parameters and initial states, in the problem of a fit."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import casadi as ca
import numpy as np

from gbid.arrays import FloatArray, IntArray
from gbid.identify.nlp.patterns import Pattern, pairs_of
from gbid.identify.nlp.record_group import Iterate


class ExtraValues(NamedTuple):
    """Values of extra terms at a point, in physical units.

    Attributes
    ----------
    cost : float
        Extra cost, a negative log-likelihood.
    gradient, hessian : (n_used,) and (n_used, n_used) array
        Its derivatives by the unknowns that are used.
    rows, slopes : (n_rows,) and (n_rows, n_used) array
        Constraints, divided by their size, and their derivatives.
    """

    cost: float
    gradient: FloatArray
    hessian: FloatArray
    rows: FloatArray
    slopes: FloatArray


@dataclass(frozen=True, eq=False)
class ExtraTerms:
    """Extra cost and constraints.

    Attributes
    ----------
    cost : casadi.Function
        ``(v) -> (f, gradient, Hessian)`` of the unknowns that are used.
    rows : casadi.Function
        ``(v) -> (c, Jacobian)``.
    curvature : casadi.Function
        ``(v, lam) -> `` Hessian of ``lam' c``.
    used : (n_used,) integer array
        Positions of these unknowns among all parameters and, after them, the initial states of all records.
    windows : (n_records,) integer array
        First window of each record.
    size : (n_rows,) array
        Size of each constraint, by which it is divided for the solver.
    lower, upper : (n_rows,) array
        Bounds of the constraints, divided by it.
    names : tuple of str
        Constraints as the caller wrote them.
    """

    cost: ca.Function
    rows: ca.Function
    curvature: ca.Function
    used: IntArray
    windows: IntArray
    size: FloatArray
    lower: FloatArray
    upper: FloatArray
    names: tuple[str, ...]

    def moved_to(self, windows: IntArray) -> ExtraTerms:
        """Return the same terms where the first window of each record has another number."""
        return replace(self, windows=windows)

    def at(self, theta: FloatArray, starts: FloatArray) -> ExtraValues:
        """Return the values for parameters (n_p,) and window starts (n_windows, n)."""
        v = self._point(theta, starts)
        cost, gradient, hessian = (np.asarray(m, float) for m in self.cost(v))
        rows, slopes = (np.asarray(m, float) for m in self.rows(v))
        slopes = slopes.reshape(len(self.size), len(self.used))
        return ExtraValues(
            float(cost.item()), gradient.ravel(), hessian, rows.ravel() / self.size, slopes / self.size[:, None]
        )

    def bent(self, theta: FloatArray, starts: FloatArray, multipliers: FloatArray) -> FloatArray:
        """Return the Hessian of the constraints times these multipliers, (n_used, n_used)."""
        return np.asarray(self.curvature(self._point(theta, starts), multipliers / self.size), float)

    def violation(self, rows: FloatArray) -> float:
        """Return how far constraints (n_rows,) are beyond their bounds at most."""
        return float(np.maximum(self.lower - rows, rows - self.upper).max(initial=0.0))

    def off_bound(self, rows: FloatArray, near: float) -> FloatArray:
        """Return how far each constraint is from the bound that it lies on, (n_rows,); NaN where it lies on none."""
        below, above = rows - self.lower, rows - self.upper
        return np.where(below < near, below, np.where(above > -near, above, np.nan))

    def _point(self, theta: FloatArray, starts: FloatArray) -> FloatArray:
        return np.concatenate([theta, starts[self.windows].ravel()])[self.used]


@dataclass(frozen=True, eq=False)
class PlacedTerms:
    """Extra terms among the scaled unknowns of a problem.

    Attributes
    ----------
    terms : ExtraTerms
        The terms.
    places : (n_used,) integer array
        Positions of the used unknowns among all unknowns.
    scale : (n_used,) array
        Their scales.
    unit : float
        Ratio of the cost of the problem to a negative log-likelihood.
    """

    terms: ExtraTerms
    places: IntArray
    scale: FloatArray
    unit: float

    @classmethod
    def among(cls, terms: ExtraTerms, theta_scale: FloatArray, state_scale: FloatArray, size: float) -> PlacedTerms:
        """Return the terms in a problem with these scales, whose cost times `size` is a negative log-likelihood."""
        n_theta, n = len(theta_scale), len(state_scale)
        starts = n_theta + terms.windows[:, None] * n + np.arange(n)
        places = np.concatenate([np.arange(n_theta), starts.ravel()])[terms.used]
        scale = np.concatenate([theta_scale, np.tile(state_scale, len(terms.windows))])[terms.used]
        return cls(terms, places, scale, 1 / size)

    def added(self, found: Iterate, theta: FloatArray, starts: FloatArray, pattern: Pattern) -> Iterate:
        """Return the values at a point with those of the extra terms."""
        extra, gradient = self.terms.at(theta, starts), found.gradient.copy()
        gradient[self.places] += self.unit * extra.gradient * self.scale
        return found._replace(
            cost=found.cost + self.unit * extra.cost,
            gradient=gradient,
            hessian=found.hessian + self._entries(self.unit * extra.hessian, pattern),
            extra_rows=extra.rows,
            extra_slopes=extra.slopes * self.scale,
        )

    def without_value(self, found: Iterate) -> Iterate:
        """Return the values at a point without value, with those of the extra terms."""
        rows, used = len(self.terms.size), len(self.places)
        return found._replace(extra_rows=np.full(rows, np.nan), extra_slopes=np.full((rows, used), np.nan))

    def curvature(self, theta: FloatArray, starts: FloatArray, multipliers: FloatArray, pattern: Pattern) -> FloatArray:
        """Return what the constraints add to the entries of the Hessian of the Lagrangian."""
        return self._entries(self.terms.bent(theta, starts, multipliers), pattern)

    def _entries(self, block: FloatArray, pattern: Pattern) -> FloatArray:
        """Return a Hessian by the used unknowns, (n_used, n_used), as entries in the order of a pattern."""
        (low, high), n = pairs_of(self.places), pattern.shape[0]
        found = np.zeros(len(pattern.rows))
        where = np.searchsorted(pattern.rows + n * pattern.columns, low + n * high)
        found[where] = (block * np.outer(self.scale, self.scale))[np.triu_indices(len(block))]
        return found


def compiled_terms(
    symbols: ca.SX,
    cost: ca.SX,
    constraints: list[tuple[float, ca.SX, float]],
    windows: IntArray,
    at: Callable[[ExtraTerms], FloatArray],
) -> ExtraTerms:
    """Return the extra terms of expressions in the symbols of all parameters and initial states.

    Parameters
    ----------
    symbols : casadi.SX
        Parameters and initial states of all records, (n_all, 1).
    cost : casadi.SX
        Extra cost.
    constraints : list of (lower, expression, upper)
        Constraints.
    windows : (n_records,) integer array
        First window of each record.
    at : callable
        Returns scaled slopes of the constraints at the start, which are their sizes.
    """
    rows = ca.vertcat(*(each for _, each, _ in constraints)) if constraints else ca.SX(0, 1)
    used = np.flatnonzero(np.array(ca.DM(ca.jacobian_sparsity(ca.vertcat(cost, rows), symbols), 1.0)).any(axis=0))
    v, lam = symbols[used.tolist()] if len(used) else ca.SX(0, 1), ca.SX.sym("lam", rows.numel())
    H, g = ca.hessian(cost, v)
    bent = ca.hessian(ca.dot(lam, rows), v)[0] if constraints else ca.SX(len(used), len(used))

    def function(name: str, arguments: list[ca.SX], results: list[ca.SX]) -> ca.Function:
        return ca.Function(name, arguments, [ca.densify(each) for each in results], {"cse": True})

    terms = ExtraTerms(
        function("cost", [v], [cost, g, H]),
        function("rows", [v], [rows, ca.jacobian(rows, v)]),
        function("curvature", [v, lam], [bent]),
        used,
        windows,
        np.ones(len(constraints)),
        np.array([lower for lower, _, _ in constraints], float),
        np.array([upper for _, _, upper in constraints], float),
        tuple(str(each) for _, each, _ in constraints),
    )
    size = np.linalg.norm(at(terms), axis=1)
    size = np.where(np.isfinite(size) & (size > 0), size, 1.0)
    return replace(terms, size=size, lower=terms.lower / size, upper=terms.upper / size)
