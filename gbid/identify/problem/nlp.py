"""Multiple-shooting problem of a fit: cost, constraints and their derivatives as numbers, with sparsity patterns."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import repeat
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from gbid.core.arrays import FloatArray, IntArray
from gbid.identify.kernel.blocks import Blocks
from gbid.identify.kernel.response import LikelihoodSums, ResponseGroup
from gbid.identify.kernel.sums import Kernel, Lagrangian, Sweep, spectral_radius, tied
from gbid.identify.options import Criterion
from gbid.identify.predictor import GeneralPredictor, Predictor, PredictorValues


@dataclass(frozen=True, eq=False)
class RecordGroup:
    """Segments with one predictor and equal parameter values.

    Attributes
    ----------
    predictor : GeneralPredictor
        Predictor of all segments.
    blocks : Blocks
        The segments, cut into blocks.
    index : (n_p,) integer array
        Positions of the predictor's parameters in those of the problem.
    kernel : Kernel
        Kernel of the recursion over the blocks.
    tie : (n_own, n_p) array or None
        Matrix of parameters that are linear in those of the problem, ``own = tie @ theta[index]``; None when they are
        equal to those of `index`.
    """

    predictor: GeneralPredictor
    blocks: Blocks
    index: IntArray
    kernel: Kernel
    tie: FloatArray | None = None

    def own(self, theta: FloatArray) -> FloatArray:
        """Return the predictor's parameter values for given parameters of the problem."""
        return theta[self.index] if self.tie is None else np.asarray(self.tie @ theta[self.index])

    @property
    def noise(self) -> IntArray:
        """Parameters of the problem that affect only the disturbance gain."""
        rows = list(self.predictor.noise)
        if self.tie is None:
            return self.index[rows]
        return self.index[np.flatnonzero(self.tie[rows].any(axis=0))]

    def within_bounds(self, theta: FloatArray) -> bool:
        """Return whether tied parameters are within bounds, which bounds of the unknowns do not guarantee."""
        if self.tie is None:
            return True
        free = self.predictor.free
        return all(q.lower <= v <= q.upper for q, v in zip(free, self.own(theta).tolist(), strict=True))


Box = tuple[FloatArray, FloatArray]
"""Lower and upper bounds of the unknowns, (n_unknowns,), scaled."""


class Iterate(NamedTuple):
    """Values for the solver at one point, in scaled units.

    Attributes
    ----------
    cost : float
        Cost.
    gradient : (n_unknowns,) array
        Gradient of the cost.
    gaps : (n_gaps,) array
        Gaps between windows.
    jacobian : (n_nonzeros,) array
        Entries of the Jacobian of the gaps, in the order of its pattern.
    hessian : (n_nonzeros,) array
        Entries of the upper triangle of the Hessian, in the order of its pattern.
    sweeps : tuple of Sweep
        Results of the pass for each part, in physical units; empty where the problem has no value.
    factor : float
        Factor from the sums of a sweep to the scale of the cost.
    extra_rows, extra_slopes : (n_rows,) and (n_rows, n_used) array
        Constraints of the caller and their derivatives by the unknowns that they use.
    """

    cost: float
    gradient: FloatArray
    gaps: FloatArray
    jacobian: FloatArray
    hessian: FloatArray
    sweeps: tuple[Sweep, ...]
    factor: float
    extra_rows: FloatArray = np.zeros(0)
    extra_slopes: FloatArray = np.zeros((0, 0))


class Prior(NamedTuple):
    """Prior of parameters: independent normal distributions.

    Attributes
    ----------
    mean : (n_p,) array
        Means.
    information : (n_p,) array
        Inverse variances; zero without prior knowledge.
    """

    mean: FloatArray
    information: FloatArray


class Pattern(NamedTuple):
    """Sparsity pattern in column order, and the permutation of computed entries to it."""

    shape: tuple[int, int]
    rows: IntArray
    columns: IntArray
    order: IntArray

    @classmethod
    def of(cls, shape: tuple[int, int], rows: list[IntArray], columns: list[IntArray]) -> Pattern:
        """Return the pattern of entries, ordered by column, then row."""
        row = np.concatenate([np.ravel(part) for part in rows]).astype(np.int64)
        column = np.concatenate([np.ravel(part) for part in columns]).astype(np.int64)
        order = np.argsort(column * shape[0] + row, kind="stable")
        return cls(shape, row[order], column[order], order)


EDGE = 0.02
"""Of the model's own margin: a gain that leaves no more is no estimate."""
CLEAR = 0.2
"""Of the same: a gain that leaves more can be started from."""


def near_instability(predictor: Predictor, own: FloatArray, v: PredictorValues, share: float) -> bool:
    """Return whether the disturbance gain leaves at most a given share of the model's stability margin.

    Parameters
    ----------
    predictor : Predictor
        The predictor.
    own : (n_own,) array
        Values of its parameters.
    v : PredictorValues
        The predictor there.
    share : float
        The share.
    """
    still = np.array(own, float)
    still[[i for i in predictor.noise if i not in predictor.walks]] = 0.0  # a slow random walk is a valid estimate
    margin = 1 - spectral_radius(predictor.at(still))
    return (margin > 0 or not predictor.walks) and 1 - spectral_radius(v) <= share * margin


# ---- Extra cost and constraints of the caller, on parameters and initial states.

_NEAR = 1e-4  # of the size of a constraint


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
    """Extra cost and constraints of the caller.

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

    def at(self, theta: FloatArray, starts: FloatArray) -> ExtraValues:
        """Return the values of the extra terms for parameters (n_p,) and window starts (n_windows, n)."""
        v = self._point(theta, starts)
        value, gradient, hessian = (np.asarray(m, float) for m in self.cost(v))
        rows, slopes = (np.asarray(m, float) for m in self.rows(v))
        slopes = slopes.reshape(len(self.size), len(self.used)) / self.size[:, None]
        return ExtraValues(float(value.item()), gradient.ravel(), hessian, rows.ravel() / self.size, slopes)

    def bent(self, theta: FloatArray, starts: FloatArray, multipliers: FloatArray) -> FloatArray:
        """Return the Hessian of the constraints' sum, weighted by multipliers, (n_used, n_used)."""
        return np.asarray(self.curvature(self._point(theta, starts), multipliers / self.size), float)

    def violation(self, rows: FloatArray) -> float:
        """Return the largest violation of the constraints (n_rows,)."""
        return float(np.maximum(self.lower - rows, rows - self.upper).max(initial=0.0))

    def off_bound(self, rows: FloatArray, near: float) -> FloatArray:
        """Return the distance of each active constraint from its bound, (n_rows,); NaN if inactive."""
        below, above = rows - self.lower, rows - self.upper
        return np.where(below < near, below, np.where(above > -near, above, np.nan))

    def _point(self, theta: FloatArray, starts: FloatArray) -> FloatArray:
        return np.concatenate([theta, starts[self.windows].ravel()])[self.used]


def extra_notes(problem: Shooting, unknowns: FloatArray) -> tuple[str, ...]:
    """Return notes on the caller's constraints that are active or violated."""
    extra, notes = problem.extra, []
    if extra is None or not np.isfinite(unknowns).all():
        return ()
    rows = extra.at(*problem.unpack(unknowns)).rows
    each = zip(extra.names, rows, extra.off_bound(rows, _NEAR), extra.lower, extra.upper, extra.size, strict=True)
    for name, row, distance, low, high, size in each:
        if row < low - _NEAR or row > high + _NEAR:
            notes.append(
                f"the constraint {name} is not met: it is {row * size:.6g}, and must lie in "
                f"[{low * size:.6g}, {high * size:.6g}]"
            )
        elif not np.isnan(distance) and low < high:
            notes.append(f"the constraint {name} is active: standard deviations take it as an exact equation")
    return tuple(notes)


# ---- Multiple-shooting problem: cost, constraints and their derivatives.
#
# Unknowns are the free parameters and the state at the start of each window. The cost is the prediction error of
# Eq. 15, or the log-determinant of its covariance. Constraints require that each window ends at the start state of the
# next one. Unknowns and constraints are scaled to the order of one. One pass over the samples gives all values of an
# iterate.

_ROUNDING = 1e-13  # floor of the cost, as a part of the outputs' power
_WELL_BELOW = 0.01  # part of that floor that a fit without errors reaches with its next step


@dataclass(frozen=True, eq=False)
class Shooting:
    """Multiple-shooting problem of a fit, as a nonlinear programme.

    Attributes
    ----------
    parts : tuple of RecordGroup
        Groups of records.
    responses : tuple of ResponseGroup
        Frequency responses.
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
    box : Box
        Bounds of the unknowns; given initial states are fixed by equal ones.
    stable_only : bool
        Whether unstable predictors are invalid: over a finite record they can have smaller errors than the stable one.
    """

    parts: tuple[RecordGroup, ...]
    responses: tuple[ResponseGroup, ...]
    links: IntArray
    criterion: Criterion
    output_weights: FloatArray
    output_scale: float
    theta_scale: FloatArray
    state_scale: FloatArray
    prior: Prior
    extra: ExtraTerms | None = None
    box: Box = (np.zeros(0), np.zeros(0))
    stable_only: bool = False
    _last: dict[bytes, Iterate] = field(init=False, default_factory=dict)
    _met: dict[bytes, list[Any]] = field(init=False, default_factory=dict)

    @property
    def groups(self) -> tuple[RecordGroup | ResponseGroup, ...]:
        """Parts of the problem: groups of records, then frequency responses."""
        return *self.parts, *self.responses

    @property
    def n_theta(self) -> int:
        """Number of free parameters."""
        return len(self.theta_scale)

    @property
    def n_states(self) -> int:
        """Number of states."""
        return len(self.state_scale)

    @property
    def n_windows(self) -> int:
        """Number of shooting windows."""
        return int(self.first_window[-1])

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
        """First window of each part, then the total number of windows, shape (n_parts + 1,)."""
        return np.concatenate([[0], np.cumsum([part.blocks.n_windows for part in self.parts])]).astype(np.int64)

    def windows_from(self, first: int) -> list[int]:
        """Return a window and all windows linked after it in its record, in the order of time."""
        following = dict(self.links.tolist())
        windows = [int(first)]
        while windows[-1] in following:
            windows.append(following[windows[-1]])
        return windows

    def pack(self, theta: FloatArray, starts: FloatArray) -> FloatArray:
        """Return scaled unknowns from parameters (n_p,) and window starts (n_windows, n)."""
        return np.concatenate([theta / self.theta_scale, (starts / self.state_scale).ravel()])

    def unpack(self, unknowns: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return parameters (n_p,) and window starts (n_windows, n) in physical units."""
        starts = unknowns[self.n_theta :].reshape(self.n_windows, self.n_states) * self.state_scale
        return unknowns[: self.n_theta] * self.theta_scale, starts

    def values(self, theta: FloatArray) -> list[Any]:
        """Return the predictors of all parts; equal ones are computed once, the latest are cached."""
        point = theta.tobytes()
        if point in self._met:
            return self._met[point]
        met, result = dict[tuple[int, bytes], Any](), []
        for part in self.parts:
            values = part.own(theta)
            key = (id(part.predictor), values.tobytes())
            if key not in met:
                met[key] = part.predictor.at(values)
            result.append(met[key])
        self._met.clear()
        self._met[point] = result
        return result

    def valid_values(self, theta: FloatArray) -> list[Any] | None:
        """Return the predictors of all parts; None if tied parameters violate bounds or a predictor is unstable."""
        values = self.values(theta)
        return None if self._refused(theta, self.growth(values)) else values

    def _refused(self, theta: FloatArray, rate: float) -> bool:
        return (self._watched and rate > 1) or not all(part.within_bounds(theta) for part in self.parts)

    def sweeps(self, values: list[Any], starts: FloatArray, weight: FloatArray) -> list[Sweep]:
        """Return the sums of a pass over each part, for window starts (n_windows, n)."""
        each = self.each(values, starts)
        return [tied(part.kernel.sweep(v, part.blocks, begin, weight), part.tie) for v, part, begin in each]

    def gradients(self, values: list[Any], at: Lagrangian) -> list[tuple[FloatArray, FloatArray]]:
        """Return the gradients of cost and weighted window ends for each part; see `Kernel.gradient`.

        They are by the parameters of its predictor, and by the starts of its windows, (n_windows, n), in physical units
        and without the prior; not finite when the errors overflow.
        """
        each = zip(self.each(values, at.starts), self.by_part(at.ends), strict=True)
        return [
            part.kernel.gradient(v, part.blocks, Lagrangian(begin, ends, at.weight)) for (v, part, begin), ends in each
        ]

    def errors(self, values: list[Any], starts: FloatArray) -> list[FloatArray]:
        """Return the prediction errors of each part in blocks; zero outside the cost."""
        return [part.kernel.errors(v, part.blocks, begin) for v, part, begin in self.each(values, starts)]

    def by_record(self, errors: list[FloatArray], first_windows: IntArray) -> list[FloatArray]:
        """Return errors of all parts by record and sample, (n_samples, n_y); zero if left out."""
        by_window: dict[int, FloatArray] = {}
        for e, part, first in zip(errors, self.parts, self.first_window[:-1], strict=True):
            by_window |= zip((first + part.blocks.segment_first).tolist(), part.blocks.by_segment(e), strict=True)
        chains = [self.windows_from(first) for first in first_windows]
        records = [[by_window[window] for window in chain if window in by_window] for chain in chains]
        return [np.concatenate(pieces) if len(pieces) > 1 else pieces[0] for pieces in records]

    def release(self) -> None:
        """Free the memory of the regressors; see `Blocks.release`."""
        for part in self.parts:
            part.blocks.release()

    def each(self, values: list[Any], starts: FloatArray) -> Iterator[tuple[Any, RecordGroup, FloatArray]]:
        """Return for each part its predictor, the part, and the starts of its windows."""
        return zip(values, self.parts, self.by_part(starts), strict=True)

    def by_part(self, windows: FloatArray) -> list[FloatArray]:
        """Return values of all windows, (n_windows, ...), split by part."""
        return [windows] if len(self.parts) == 1 else np.split(windows, self.first_window[1:])[:-1]

    def error_products(self, values: list[Any], starts: FloatArray) -> FloatArray:
        """Return ``sum e e'`` over all parts, (n_y, n_y)."""
        products = np.zeros((len(self.output_weights),) * 2)
        for v, part, begin in self.each(values, starts):
            products += part.kernel.products(v, part.blocks, begin).sum(axis=0)
        return np.asarray(products + self.absent)

    @cached_property
    def absent(self) -> FloatArray | float:
        """Expected products of missing outputs' errors, (n_y, n_y), for the EM algorithm; 0 without any."""
        return sum((gains.absent for part in self.parts for gains in part.blocks.gains), 0.0)

    def weight(self, error_products: FloatArray) -> FloatArray:
        """Return the weight of the squared errors in gradient and Hessian, from ``sum e e'``."""
        if self.criterion == "trace":
            total = self.output_weights @ np.diag(error_products) + self._floor
            return np.asarray(np.diag(self.output_weights) / total)
        products = error_products + np.diag(self.floors)
        size = np.sqrt(np.diag(products))
        values, axes = np.linalg.eigh(products / np.outer(size, size))  # positive also for errors of no full rank
        return np.asarray(axes / np.maximum(values, _ROUNDING * values[-1]) @ axes.T / np.outer(size, size))

    def cost(self, error_products: FloatArray) -> float:
        """Return half the logarithm of the weighted trace or determinant of ``sum e e'`` over the outputs' power.

        The logarithm does not change the optimum. It makes the solver's tolerance relative to the remaining errors.
        Without samples it is zero.
        """
        if not self.parts:
            return 0.0
        if self.criterion == "trace":
            return 0.5 * float(np.log((self.output_weights @ np.diag(error_products) + self._floor) / self._power))
        units = np.sqrt(self.output_weights / self._power)
        return 0.5 * float(np.linalg.slogdet((error_products + np.diag(self.floors)) * np.outer(units, units))[1])

    def cost_alone(self, theta: FloatArray, starts: FloatArray) -> float:
        """Return the cost at a point (physical units), without sensitivities; NaN for an invalid predictor."""
        values = self.valid_values(theta)
        if values is None:
            return np.nan
        more = self.known(theta).cost + (self.extra.at(theta, starts).cost if self.extra is not None else 0.0)
        return self.cost(self.error_products(values, starts)) + more / self.likelihood_size

    def known(self, theta: FloatArray) -> LikelihoodSums:
        """Return the negative log-likelihood of prior and frequency responses, with gradient and Hessian."""
        away, information = theta - self.prior.mean, self.prior.information
        cost, gradient, hessian = 0.5 * float(information @ away**2), information * away, np.diag(information)
        for group in self.responses:
            sums = group.sums(theta)
            cost += sums.cost
            gradient[group.index] += sums.gradient
            hessian[np.ix_(group.index, group.index)] += sums.hessian
        return LikelihoodSums(cost, gradient, hessian)

    def at(self, unknowns: FloatArray) -> Iterate:
        """Return the values at a point; see `at_physical`."""
        return self.at_physical(*self.unpack(unknowns))

    def at_physical(self, theta: FloatArray, starts: FloatArray) -> Iterate:
        """Return the values at a point in physical units; the last two points are cached."""
        key = theta.tobytes() + starts.tobytes()
        if key not in self._last:
            self._last[key] = self._evaluate(theta, starts)
            if len(self._last) > 2:
                self._last.pop(next(iter(self._last)))
        return self._last[key]

    @cached_property
    def noise(self) -> tuple[int, ...]:
        """Indices of the parameters that affect only disturbance gains."""
        return tuple(sorted({int(i) for part in self.parts for i in part.noise}))

    @property
    def _watched(self) -> bool:
        return bool(self.noise) and self.stable_only

    def parts_at_edge(self, theta: FloatArray) -> Iterator[bool]:
        """Yield for each part whether its disturbance gain is invalid because the predictor is nearly unstable."""
        each = ((part.predictor, part.own(theta), v) for part, v in zip(self.parts, self.values(theta), strict=True))
        return (self._watched and isinstance(p, Predictor) and near_instability(p, own, v, EDGE) for p, own, v in each)

    def rate(self, theta: FloatArray, starts: FloatArray) -> float:
        """Return the growth of a small deviation per sample at a point; infinite without a valid predictor."""
        values = self.values(theta)
        alone = self.growth(values)
        rate = self.growth(values, self.at_physical(theta, starts).sweeps) if np.isnan(alone) else alone
        return np.inf if np.isnan(rate) else rate

    def growth(self, values: list[Any], sweeps: Sequence[Sweep] = ()) -> float:
        """Return the largest growth of a small deviation per sample, over all parts; NaN if a pass is needed."""
        each = zip(self.parts, values, sweeps or repeat(None), strict=False)
        rates = (part.kernel.growth(v, part.blocks, sweep, self.state_scale) for part, v, sweep in each)
        return max(rates, default=0.0)

    @cached_property
    def limits(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Linear constraints for the bounds of tied parameters, which are sums of several unknowns.

        They are a matrix (n_limits, n_theta) from the scaled unknowns to the parameters in units of their own scales,
        and their lower and upper bounds, (n_limits,).
        """
        rows, lower, upper = [], [], []
        for part in self.parts:
            if part.tie is None:
                continue
            for q, tie in zip(part.predictor.free, part.tie, strict=True):
                row = np.zeros(self.n_theta)
                row[part.index] = tie * self.theta_scale[part.index]
                size = float(np.abs(row).max())
                if size > 0 and np.isfinite([q.lower, q.upper]).any():
                    rows.append(row / size)
                    lower.append(q.lower / size)
                    upper.append(q.upper / size)
        return np.array(rows).reshape(-1, self.n_theta), np.array(lower), np.array(upper)

    @cached_property
    def jacobian_pattern(self) -> Pattern:
        """Sparsity pattern of the Jacobian of the gaps: parameters of a window, its start, and the next start."""
        rows, columns, n = [], [], self.n_states
        for part, (links, windows) in zip(self.parts, self._links_by_part, strict=True):
            gaps = (links[:, None] * n + np.arange(n))[:, :, None]
            rows += [gaps.repeat(len(part.index), 2), gaps.repeat(n, 2)]
            columns += [
                np.broadcast_to(part.index, rows[-2].shape),
                np.broadcast_to((self.n_theta + windows[:, None] * n + np.arange(n))[:, None, :], rows[-1].shape),
            ]
        rows.append(np.arange(self.n_gaps))
        columns.append((self.n_theta + self.links[:, 1:] * n + np.arange(n)).ravel())
        return Pattern.of((self.n_gaps, self.n_unknowns), rows, columns)

    @cached_property
    def hessian_pattern(self) -> Pattern:
        """Sparsity pattern of the Hessian's upper triangle: an arrow, and the pairs in extra terms."""
        n, size, pairs, upper = self.n_states, self.n_unknowns, self._theta_pairs, self._upper
        rows, columns = [pairs[0]], [pairs[1]]
        for part, first, last in zip(self.parts, self.first_window[:-1], self.first_window[1:], strict=True):
            base = self.n_theta + np.arange(first, last) * n
            shape = (last - first, len(part.index), n)
            rows += [np.broadcast_to(part.index[None, :, None], shape), base[:, None] + upper[0]]
            columns += [np.broadcast_to((base[:, None] + np.arange(n))[:, None, :], shape), base[:, None] + upper[1]]
        if self.extra is not None:
            have = np.concatenate([np.ravel(r) + size * np.ravel(c) for r, c in zip(rows, columns, strict=True)])
            low, high = self._extra_pairs
            new = ~np.isin(low + size * high, have)
            rows.append(low[new])
            columns.append(high[new])
        return Pattern.of((size, size), rows, columns)

    @property
    def exact_cost(self) -> float:
        """Largest cost that counts as rounding errors only, as for simulated data without noise."""
        return self.cost(np.diag(self.floors) * _WELL_BELOW * self.n_samples / self.likelihood_size)

    @property
    def _power(self) -> float:
        return self.n_samples * self.output_scale**2

    @property
    def _floor(self) -> float:
        """Power of rounding errors, added to the squares so that the logarithm is finite without noise."""
        return _ROUNDING * self._power

    @property
    def floors(self) -> FloatArray:
        """Sums of squared errors that count as rounding, for each output, (n_y,)."""
        return self._floor / self.output_weights

    @property
    def likelihood_size(self) -> float:
        """Ratio of the negative log-likelihood to the cost."""
        if not self.parts:
            return sum(group.n_numbers for group in self.responses)
        return self.n_samples * (len(self.output_weights) if self.criterion == "trace" else 1)

    @cached_property
    def _links_by_part(self) -> list[tuple[IntArray, IntArray]]:
        """Links that start in each part: row numbers and first windows."""
        edges = zip(self.first_window[:-1], self.first_window[1:], strict=True)
        rows = [np.flatnonzero((self.links[:, 0] >= first) & (self.links[:, 0] < last)) for first, last in edges]
        return [(links, self.links[links, 0]) for links in rows]

    @cached_property
    def _upper(self) -> tuple[IntArray, IntArray]:
        """Rows and columns of the upper triangle of a block with the size of the state."""
        return np.triu_indices(self.n_states)

    @cached_property
    def _theta_pairs(self) -> tuple[IntArray, IntArray]:
        """Pairs of parameters that occur in one part, upper triangle."""
        coupled = np.eye(self.n_theta, dtype=bool)
        for part in self.groups:
            coupled[np.ix_(part.index, part.index)] = True
        rows, columns = np.nonzero(np.triu(coupled))
        return rows, columns

    @cached_property
    def extra_places(self) -> tuple[IntArray, FloatArray]:
        """Indices of the unknowns in extra terms, and their scales; both empty without extra terms."""
        if self.extra is None:
            return np.zeros(0, np.int64), np.zeros(0)
        windows, n = self.extra.windows, self.n_states
        starts = self.n_theta + windows[:, None] * n + np.arange(n)
        places = np.concatenate([np.arange(self.n_theta), starts.ravel()])[self.extra.used]
        return places, np.concatenate([self.theta_scale, np.tile(self.state_scale, len(windows))])[self.extra.used]

    @property
    def _extra_pairs(self) -> tuple[IntArray, IntArray]:
        """Rows and columns in the upper triangle of all pairs of unknowns in extra terms."""
        places, _ = self.extra_places
        i, j = np.triu_indices(len(places))
        return np.minimum(places[i], places[j]), np.maximum(places[i], places[j])

    def extra_entries(self, block: FloatArray) -> FloatArray:
        """Return the Hessian of extra terms, (n_used, n_used), in the order of `hessian_pattern`."""
        (low, high), pattern, (_, scale) = self._extra_pairs, self.hessian_pattern, self.extra_places
        entries = np.zeros(len(pattern.rows))
        where = np.searchsorted(pattern.rows + self.n_unknowns * pattern.columns, low + self.n_unknowns * high)
        entries[where] = (block * np.outer(scale, scale))[np.triu_indices(len(block))]
        return entries

    def _evaluate(self, theta: FloatArray, starts: FloatArray) -> Iterate:
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):  # a bad trial point: the solver steps back
            values = self.values(theta)
            rate = self.growth(values) if self._watched else 0.0
            if self._refused(theta, rate):
                return self._invalid()
            if not self.parts:
                sweeps, products, factor = list[Sweep](), np.zeros((0, 0)), 1.0
            elif self.criterion == "trace":  # the weight is one factor, applied after the pass
                W = np.diag(self.output_weights)
                sweeps = self.sweeps(values, starts, W / self._power)
                products = np.asarray(sum(s.error_products for s in sweeps) + self.absent)
                factor = self._power / (float(np.trace(W @ products)) + self._floor)
            else:
                products = self.error_products(values, starts)
                if not np.isfinite(products).all():
                    return self._invalid()
                sweeps, factor = self.sweeps(values, starts, self.weight(products)), 1.0
            rate = self.growth(values, sweeps) if np.isnan(rate) else rate
            if self._refused(theta, rate):
                return self._invalid()
            return self._assembled(theta, starts, sweeps, products, factor)

    def _assembled(
        self, theta: FloatArray, starts: FloatArray, sweeps: list[Sweep], products: FloatArray, factor: float
    ) -> Iterate:
        """Return the iterate assembled from the scaled sums of the parts."""
        t, x = self.theta_scale, self.state_scale
        gradient, hessian = np.zeros(self.n_theta), np.zeros((self.n_theta, self.n_theta))
        starts_gradient, mixed, by_start, jacobian = [np.zeros((0, self.n_states))], [], [], []
        ends = np.concatenate([starts[:0], *(s.end for s in sweeps)])
        for s, part, (_, windows), first in zip(
            sweeps, self.parts, self._links_by_part, self.first_window[:-1], strict=True
        ):
            gradient[part.index] += s.gradient
            hessian[np.ix_(part.index, part.index)] += s.hessian
            starts_gradient.append(s.gradient_start * (factor * x))
            mixed.append(s.hessian_mixed * (factor * t[part.index, None] * x))
            by_start.append(s.hessian_start * (factor * np.outer(x, x)))
            local = windows - first
            jacobian += [
                (s.end_theta[local] / x[:, None] * t[part.index]).ravel(),
                (s.end_start[local] / x[:, None] * x).ravel(),
            ]
        known, unit = self.known(theta), 1 / self.likelihood_size
        gradient, hessian = factor * gradient + unit * known.gradient, factor * hessian + unit * known.hessian
        gaps = (ends[self.links[:, 0]] - starts[self.links[:, 1]]) / x
        jacobian_entries = np.concatenate([*jacobian, np.full(self.n_gaps, -1.0)])
        iterate = Iterate(
            self.cost(products) + unit * known.cost,
            np.concatenate([gradient * t, np.concatenate(starts_gradient).ravel()]),
            gaps.ravel(),
            jacobian_entries[self.jacobian_pattern.order],
            self.hessian_entries(hessian * np.outer(t, t), mixed, by_start),
            tuple(sweeps),
            factor,
        )
        if self.extra is None:
            return iterate
        (places, scale), values = self.extra_places, self.extra.at(theta, starts)
        iterate.gradient[places] += unit * values.gradient * scale
        return iterate._replace(
            cost=iterate.cost + unit * values.cost,
            hessian=iterate.hessian + self.extra_entries(unit * values.hessian),
            extra_rows=values.rows,
            extra_slopes=values.slopes * scale,
        )

    def hessian_entries(
        self, theta: FloatArray, mixed: Sequence[FloatArray], starts: Sequence[FloatArray]
    ) -> FloatArray:
        """Return Hessian entries in the order of `hessian_pattern`; zero for extra terms.

        `theta` (n_theta, n_theta) is the block of the parameters. For each part, `mixed` (n_windows, n_p, n) is the
        block of parameters and window starts, and `starts` (n_windows, n, n) that of the window starts.
        """
        (rows, columns), each = self._upper, zip(mixed, starts, strict=True)
        arrow = [entries for m, own in each for entries in (m.ravel(), own[:, rows, columns].ravel())]
        flat, order = np.concatenate([theta[self._theta_pairs], *arrow]), self.hessian_pattern.order
        return np.asarray(np.pad(flat, (0, len(order) - len(flat)))[order] if self.extra else flat[order])

    def _invalid(self) -> Iterate:
        n_extra = 0 if self.extra is None else len(self.extra.size)
        sizes = (self.n_unknowns, self.n_gaps, len(self.jacobian_pattern.rows), len(self.hessian_pattern.rows), n_extra)
        gradient, gaps, jacobian, hessian, rows = (np.full(size, np.nan) for size in sizes)
        slopes = np.full((n_extra, len(self.extra_places[0])), np.nan)
        return Iterate(np.nan, gradient, gaps, jacobian, hessian, (), np.nan, rows, slopes)
