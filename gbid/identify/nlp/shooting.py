"""Multiple-shooting problem of a prediction-error fit: cost, constraints and their derivatives as numbers.

Unknowns are the free parameters and the state at the start of each window. The cost is the prediction error of Eq. 15,
or the log-determinant of its covariance. Constraints require that each window ends at the start state of the next one.
Unknowns and constraints are scaled to the order of one. One pass over the samples gives all values of an iterate.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import repeat
from typing import Any, Literal

import numpy as np

from gbid.arrays import FloatArray, IntArray
from gbid.identify.kernel.sweep import Sweep, tied
from gbid.identify.nlp.extra_terms import ExtraTerms, PlacedTerms
from gbid.identify.nlp.patterns import (
    LinksByPart,
    Pattern,
    hessian_pattern,
    jacobian_pattern,
    links_by_part,
    theta_pairs,
)
from gbid.identify.nlp.record_group import Iterate, Prior, RecordGroup, tied_limits
from gbid.identify.nlp.stability import EDGE, near_instability
from gbid.identify.predictor import Predictor, PredictorValues

Criterion = Literal["trace", "det"]
_ROUNDING = 1e-13  # floor of the cost, as a part of the outputs' power
_WELL_BELOW = 0.01  # part of that floor that a fit without errors reaches with its next step


@dataclass(frozen=True, eq=False)
class Shooting:
    """Nonlinear programme of a fit.

    Attributes
    ----------
    parts : tuple of RecordGroup
        Groups of records.
    links : (n_links, 2) integer array
        Pairs of windows, counted over all parts. The first must end at the start state of the second.
    criterion : {"trace", "det"}
        Cost: weighted trace or determinant of the covariance of the errors.
    output_weights : (n_y,) array
        Weights of the squared errors in the trace; for the determinant the scale of each output.
    output_scale : float
        Total weighted standard deviation of the outputs.
    theta_scale : (n_p,) array
        Scales of the parameters.
    state_scale : (n,) array
        Scales of the states.
    prior : Prior
        Prior knowledge of the parameters.
    extra : ExtraTerms or None
        Further cost and constraints of the caller.
    stable_only : bool
        Whether unstable predictors are invalid: over a finite record they can have smaller errors than the stable one.
    """

    parts: tuple[RecordGroup, ...]
    links: IntArray
    criterion: Criterion
    output_weights: FloatArray
    output_scale: float
    theta_scale: FloatArray
    state_scale: FloatArray
    prior: Prior
    extra: ExtraTerms | None = None
    stable_only: bool = False
    _last: dict[bytes, Iterate] = field(default_factory=dict)
    _met: dict[bytes, list[Any]] = field(default_factory=dict)

    @property
    def n_theta(self) -> int:
        """Number of free parameters."""
        return len(self.theta_scale)

    @property
    def n_states(self) -> int:
        """Number of states."""
        return len(self.state_scale)

    @cached_property
    def n_windows(self) -> int:
        """Number of shooting windows."""
        return sum(part.blocks.n_windows for part in self.parts)

    @property
    def n_unknowns(self) -> int:
        """Number of unknowns: free parameters and window starts."""
        return self.n_theta + self.n_windows * self.n_states

    @property
    def n_gaps(self) -> int:
        """Number of scalar gap constraints."""
        return len(self.links) * self.n_states

    @cached_property
    def n_samples(self) -> int:
        """Number of samples in the cost."""
        return sum(part.blocks.n_samples for part in self.parts)

    @cached_property
    def first_window(self) -> IntArray:
        """First window of each part, and the number of windows, shape (n_parts + 1,)."""
        return np.concatenate([[0], np.cumsum([part.blocks.n_windows for part in self.parts])]).astype(np.int64)

    def pack(self, theta: FloatArray, starts: FloatArray) -> FloatArray:
        """Return the scaled unknowns of parameters (n_p,) and window starts (n_windows, n)."""
        return np.concatenate([theta / self.theta_scale, (starts / self.state_scale).ravel()])

    def unpack(self, unknowns: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return parameters (n_p,) and window starts (n_windows, n) in physical units."""
        starts = unknowns[self.n_theta :].reshape(self.n_windows, self.n_states) * self.state_scale
        return unknowns[: self.n_theta] * self.theta_scale, starts

    def values(self, theta: FloatArray) -> list[Any]:
        """Return the predictors of all parts; equal ones are computed once, and the last ones are stored."""
        point = theta.tobytes()
        if point in self._met:
            return self._met[point]
        met, result = dict[tuple[int, bytes], Any](), []
        for part in self.parts:
            own = part.own(theta)
            key = (id(part.predictor), own.tobytes())
            if key not in met:
                met[key] = part.predictor.at(own)
            result.append(met[key])
        self._met.clear()
        self._met[point] = result
        return result

    def valid_values(self, theta: FloatArray) -> list[Any] | None:
        """Return the predictors of all parts; None beyond the bounds of tied parameters, or for an unstable one."""
        values = self.values(theta)
        return None if self._refused(theta, self._rate_alone(values)) else values

    def _rate_alone(self, values: list[Any]) -> float:
        """Return the growth of linear predictors; NaN for others, which grow only in a pass."""
        return self.growth(values, ()) if isinstance(values[0], PredictorValues) else np.nan

    def _refused(self, theta: FloatArray, rate: float) -> bool:
        return (self._watched and rate > 1) or not all(part.within_bounds(theta) for part in self.parts)

    def sweeps(self, values: list[Any], starts: FloatArray, weight: FloatArray) -> list[Sweep]:
        """Return the sums of one pass over every part, for window starts (n_windows, n)."""
        each = self._each(values, starts)
        return [tied(part.kernel.sweep(v, part.blocks, own, weight), part.tie) for v, part, own in each]

    def errors(self, values: list[Any], starts: FloatArray) -> list[FloatArray]:
        """Return the prediction errors of every part in blocks; zero for samples that are not in the cost."""
        return [part.kernel.predict(v, part.blocks, own).errors for v, part, own in self._each(values, starts)]

    def _each(self, values: list[Any], starts: FloatArray) -> Iterator[tuple[Any, RecordGroup, FloatArray]]:
        return zip(values, self.parts, np.split(starts, self.first_window[1:-1]), strict=True)

    def error_products(self, values: list[Any], starts: FloatArray) -> FloatArray:
        """Return ``sum e e'`` over all parts, (n_y, n_y)."""
        each = self._each(values, starts)
        return np.asarray(sum(part.kernel.products(v, part.blocks, own).sum(axis=0) for v, part, own in each))

    def weight(self, error_products: FloatArray) -> FloatArray:
        """Return the weight of the squared errors in gradient and Hessian of the cost, from ``sum e e'``."""
        if self.criterion == "trace":
            total = self.output_weights @ np.diag(error_products) + self._floor
            return np.asarray(np.diag(self.output_weights) / total)
        return np.asarray(np.linalg.inv(error_products + np.diag(self._floors)))

    def cost(self, error_products: FloatArray) -> float:
        """Return half the logarithm of the weighted trace or determinant of ``sum e e'`` over the outputs' power.

        The logarithm does not change the optimum. It makes the solver's tolerance relative to the remaining errors.
        """
        if self.criterion == "trace":
            return 0.5 * float(np.log((self.output_weights @ np.diag(error_products) + self._floor) / self._power))
        units = np.sqrt(self.output_weights / self._power)
        return 0.5 * float(np.linalg.slogdet((error_products + np.diag(self._floors)) * np.outer(units, units))[1])

    def at(self, unknowns: FloatArray) -> Iterate:
        """Return the values at a point."""
        return self.of(*self.unpack(unknowns))

    def of(self, theta: FloatArray, starts: FloatArray) -> Iterate:
        """Return the values at a point in physical units; those of the last two points are stored."""
        key = theta.tobytes() + starts.tobytes()
        if key not in self._last:
            self._last[key] = self._evaluate(theta, starts)
            if len(self._last) > 2:
                self._last.pop(next(iter(self._last)))
        return self._last[key]

    @cached_property
    def noise(self) -> tuple[int, ...]:
        """Indices of the parameters on which only disturbance gains depend."""
        return tuple(sorted({int(i) for part in self.parts for i in part.noise}))

    @property
    def _watched(self) -> bool:
        return bool(self.noise) and self.stable_only

    def parts_at_edge(self, theta: FloatArray) -> Iterator[bool]:
        """Yield for each part whether it is so close to instability that its disturbance gain is no valid estimate."""
        pairs = ((part.predictor, part.own(theta)) for part in self.parts)
        return (self._watched and isinstance(p, Predictor) and near_instability(p, own, EDGE) for p, own in pairs)

    def rate(self, theta: FloatArray, starts: FloatArray) -> float:
        """Return the growth of a small deviation in a sample at a point; for linear predictors without a pass."""
        alone = self._rate_alone(self.values(theta))
        return self.of(theta, starts).rate if np.isnan(alone) else alone

    def growth(self, values: list[Any], sweeps: Sequence[Sweep]) -> float:
        """Return the largest growth of a small deviation in a sample, over all parts; of some kernels from a pass."""
        each = zip(self.parts, values, sweeps or repeat(None), strict=False)
        return max(part.kernel.growth(v, part.blocks, own, self.state_scale) for part, v, own in each)

    @cached_property
    def limits(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Linear constraints: bounds of tied parameters, see `tied_limits`."""
        return tied_limits(self.parts, self.theta_scale)

    @cached_property
    def jacobian_pattern(self) -> Pattern:
        """Sparsity pattern of the Jacobian of the gaps: parameters of a window, its start, and the next start."""
        return jacobian_pattern(self.links, self._links_by_part, self.n_states, self.n_theta, self.n_unknowns)

    @cached_property
    def hessian_pattern(self) -> Pattern:
        """Sparsity pattern of the upper triangle of the Hessian: an arrow."""
        sizes, meet = (self.n_states, self.n_unknowns), None if self.placed is None else self.placed.places
        return hessian_pattern(self.parts, self.first_window, self._theta_pairs, *sizes, meet)

    @property
    def exact_cost(self) -> float:
        """Largest cost at which all errors are rounding, as for simulated data without noise."""
        return self.cost(np.diag(self._floors) * _WELL_BELOW * self.n_samples / self.likelihood_size)

    @property
    def _power(self) -> float:
        return self.n_samples * self.output_scale**2

    @property
    def _floor(self) -> float:
        """Power of rounding errors; added to the squares, it keeps the logarithm finite for data without noise."""
        return _ROUNDING * self._power

    @property
    def _floors(self) -> FloatArray:
        return self._floor / self.output_weights

    @property
    def likelihood_size(self) -> float:
        """Ratio of the negative log-likelihood to the cost."""
        return self.n_samples * (len(self.output_weights) if self.criterion == "trace" else 1)

    @cached_property
    def _links_by_part(self) -> LinksByPart:
        return links_by_part(self.links, self.parts, self.first_window)

    @cached_property
    def _theta_pairs(self) -> tuple[IntArray, IntArray]:
        return theta_pairs(self.parts, self.n_theta)

    @cached_property
    def placed(self) -> PlacedTerms | None:
        """Extra terms among the unknowns of this problem."""
        scales = self.theta_scale, self.state_scale, self.likelihood_size
        return None if self.extra is None else PlacedTerms.among(self.extra, *scales)

    def _evaluate(self, theta: FloatArray, starts: FloatArray) -> Iterate:
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):  # a bad trial point: the solver steps back
            values = self.values(theta)
            rate = self._rate_alone(values)
            if self._refused(theta, rate):
                return self._invalid(rate)
            if self.criterion == "trace":  # the weight is one factor, applied after the pass
                W = np.diag(self.output_weights)
                sweeps = self.sweeps(values, starts, W / self._power)
                products = np.asarray(sum(s.error_products for s in sweeps))
                factor = self._power / (float(np.trace(W @ products)) + self._floor)
            else:
                products = self.error_products(values, starts)
                if not np.isfinite(products).all():
                    return self._invalid(rate)
                sweeps, factor = self.sweeps(values, starts, self.weight(products)), 1.0
            rate = self.growth(values, sweeps) if np.isnan(rate) else rate
            if self._refused(theta, rate):
                return self._invalid(np.inf)
            return self._assembled(theta, starts, sweeps, products, factor)._replace(rate=rate)

    def _assembled(
        self, theta: FloatArray, starts: FloatArray, sweeps: list[Sweep], products: FloatArray, factor: float
    ) -> Iterate:
        """Return the iterate, with the sums of the parts in place and scaled."""
        t, x = self.theta_scale, self.state_scale
        gradient, hessian = np.zeros(self.n_theta), np.zeros((self.n_theta, self.n_theta))
        starts_gradient, mixed, own, jacobian = [], [], [], []
        ends = np.concatenate([s.end for s in sweeps])
        for s, part, (_, windows, _), first in zip(
            sweeps, self.parts, self._links_by_part, self.first_window[:-1], strict=True
        ):
            gradient[part.index] += s.gradient
            hessian[np.ix_(part.index, part.index)] += s.hessian
            starts_gradient.append(s.gradient_start * (factor * x))
            mixed.append(s.hessian_mixed * (factor * t[part.index, None] * x))
            own.append(s.hessian_start * (factor * np.outer(x, x)))
            local = windows - first
            jacobian += [
                (s.end_theta[local] / x[:, None] * t[part.index]).ravel(),
                (s.end_start[local] / x[:, None] * x).ravel(),
            ]
        away, known = theta - self.prior.mean, self.prior.information / self.likelihood_size
        gradient, hessian = factor * gradient + known * away, factor * hessian + np.diag(known)
        gaps = (ends[self.links[:, 0]] - starts[self.links[:, 1]]) / x
        jacobian_entries = np.concatenate([*jacobian, np.full(self.n_gaps, -1.0)])
        found = Iterate(
            self.cost(products) + 0.5 * float(known @ away**2),
            np.concatenate([gradient * t, np.concatenate(starts_gradient).ravel()]),
            gaps.ravel(),
            jacobian_entries[self.jacobian_pattern.order],
            self.hessian_entries(hessian * np.outer(t, t), mixed, own),
            tuple(sweeps),
            factor,
        )
        return found if self.placed is None else self.placed.added(found, theta, starts, self.hessian_pattern)

    def hessian_entries(
        self, theta: FloatArray, mixed: Sequence[FloatArray], starts: Sequence[FloatArray]
    ) -> FloatArray:
        """Return the entries in the order of `hessian_pattern`; zero for those of extra terms.

        `theta` (n_theta, n_theta) is the block of the parameters. For each part, `mixed` (n_windows, n_p, n) is the
        block of parameters and window starts, and `starts` (n_windows, n, n) that of the window starts.
        """
        rows, columns = np.triu_indices(self.n_states)
        each = zip(mixed, starts, strict=True)
        arrow = [entries for m, own in each for entries in (m.ravel(), own[:, rows, columns].ravel())]
        flat, order = np.concatenate([theta[self._theta_pairs], *arrow]), self.hessian_pattern.order
        return np.asarray(np.pad(flat, (0, len(order) - len(flat)))[order] if self.extra else flat[order])

    def _invalid(self, rate: float) -> Iterate:
        sizes = (self.n_unknowns, self.n_gaps, len(self.jacobian_pattern.rows), len(self.hessian_pattern.rows))
        gradient, gaps, jacobian, hessian = (np.full(size, np.nan) for size in sizes)
        found = Iterate(np.nan, gradient, gaps, jacobian, hessian, (), np.nan, rate=np.inf if np.isnan(rate) else rate)
        return found if self.placed is None else self.placed.without_value(found)
