"""Hessians for the solver (Gauss-Newton, with or without second-order term), and problems with joined windows.

Gauss-Newton omits the product of the errors and the second derivatives of the predictor. For white errors this part is
almost zero. For coloured errors (process noise, a nonlinear film, whirl) it is as large as the rest in some
directions, and Gauss-Newton converges slowly there.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from gbid.core.arrays import FloatArray, IntArray
from gbid.identify.kernel.blocks import cut
from gbid.identify.kernel.sums import Lagrangian, Moved
from gbid.identify.problem.nlp import Iterate, RecordGroup, Shooting

# ---- Problem with one window for each segment, which has fewer unknowns.

_LONG = 128  # samples of a block; a record of many shorter ones takes longer to link


def in_one_window(problem: Shooting) -> tuple[Shooting, IntArray]:
    """Return the problem with one window for each segment.

    Parameters
    ----------
    problem : Shooting

    Returns
    -------
    Shooting
        Windows of different segments stay linked. Blocks stay where they are not short.
    (n_unknowns of the joined problem,) integer array
        Where its unknowns are among those of the problem given.
    """
    parts, firsts = [], []
    for part, first in zip(problem.parts, problem.first_window[:-1], strict=True):
        blocks = part.blocks
        joined = blocks.by_whole_segments()
        if blocks.length < _LONG:
            joined = cut(blocks.segments, part.predictor, None)
            blocks.release()
        parts.append(replace(part, blocks=joined))
        firsts.append(first + blocks.segment_first)
    first_windows, extra = np.concatenate(firsts), problem.extra
    segment_of = np.searchsorted(first_windows, np.arange(problem.n_windows), side="right") - 1
    between = np.isin(problem.links[:, 1], first_windows)  # a segment is entered only at its first window
    links = segment_of[problem.links[between]].reshape(-1, 2)
    n, n_t = problem.n_states, problem.n_theta
    starts = (n_t + first_windows[:, None] * n + np.arange(n)).ravel()
    extra = extra and replace(extra, windows=segment_of[extra.windows])
    kept = np.concatenate([np.arange(n_t), starts])
    lower, upper = problem.box
    return replace(problem, parts=tuple(parts), links=links, extra=extra, box=(lower[kept], upper[kept])), kept


def in_windows(problem: Shooting, joined: Shooting, unknowns: FloatArray) -> FloatArray:
    """Unknowns of a problem in windows, from the unknowns of `in_one_window`'s problem: no gaps between windows."""
    theta, starts = joined.unpack(unknowns)
    each = zip(problem.values(theta), problem.parts, joined.by_part(starts), strict=True)
    passed = [
        part.kernel.begin(v, part.blocks.by_whole_segments(), begin)[:, part.blocks.window_first].T
        for v, part, begin in each
    ]
    return problem.pack(theta, np.concatenate(passed))


def starts_from(problem: Shooting, theta: FloatArray, starts: FloatArray, other: Shooting) -> FloatArray:
    """Return window starts of another problem with equal records, (n_windows, n), from predicted states at a point."""
    passed: dict[int, FloatArray] = {}
    for value, part, begin in problem.each(problem.values(theta), starts):
        states = part.blocks.by_segment(part.kernel.predict(value, part.blocks, begin).states)
        for segment, rows in zip(part.blocks.segments, states, strict=True):
            whole = passed.setdefault(id(segment.outputs), np.zeros((len(segment.outputs), problem.n_states)))
            whole[segment.start : segment.stop] = rows
    first = [each for part in other.parts for each in part.blocks.window_samples]
    return np.array([passed[id(segment.outputs)][sample] for segment, sample in first])


def simulated(problem: Shooting, unknowns: FloatArray) -> tuple[FloatArray, float]:
    """Return a point without gaps, simulated from the first window of each segment, and its cost.

    The cost is infinite where the model overflows on the way.
    """
    joined, kept = in_one_window(problem)
    cost = joined.at(unknowns[kept]).cost
    return (in_windows(problem, joined, unknowns[kept]), cost) if np.isfinite(cost) else (unknowns, np.inf)


def passed_on(problem: Shooting, theta: FloatArray, starts: FloatArray) -> tuple[float, float]:
    """Return the growth of small deviations, and the effect of gaps, over windows (linearised, scaled).

    The first is the largest growth of a deviation at the start of a segment; the second is what the gaps amount to.
    Both are infinite where the problem has no value.
    """
    iterate, n = problem.at_physical(theta, starts), problem.n_states
    if not iterate.sweeps:
        return np.inf, np.inf
    gaps = np.zeros((problem.n_windows, n))
    gaps[problem.links[:, 0]] = iterate.gaps.reshape(-1, n)
    growth = amount = 0.0
    for sweep, part, gaps_of_part in zip(iterate.sweeps, problem.parts, problem.by_part(gaps), strict=True):
        steps = sweep.end_start / problem.state_scale[:, None] * problem.state_scale
        edges = part.blocks.segment_first[1:]
        for transitions, opened in zip(np.split(steps, edges), np.split(gaps_of_part, edges), strict=True):
            passed = np.eye(n, n + 1)
            for step, gap in zip(transitions[:-1], opened[:-1], strict=True):
                passed = step @ passed
                passed[:, n] += gap
                growth = max(growth, float(np.abs(passed[:, :n]).max()))
                amount = max(amount, float(np.abs(passed[:, n]).max()))
    return growth, amount


# ---- Second-order term of the Hessian (what Gauss-Newton neglects).

# Step of a difference, in units in which the cost has curvature one. It is small, because states with little influence
# on the outputs amplify errors in their columns. Second: largest step relative to a parameter without influence.
_DIFFERENCE, _MOST = 3e-8, 1e-4


def on_ends(problem: Shooting, lam_gaps: FloatArray) -> FloatArray:
    """Return the multipliers at window ends, (n_windows, n), in physical units; zero without a following window."""
    ends = np.zeros((problem.n_windows, problem.n_states))
    ends[problem.links[:, 0]] = lam_gaps.reshape(-1, problem.n_states) / problem.state_scale
    return ends


class PartHessian(NamedTuple):
    """Hessian of a part without the block of window starts.

    Attributes
    ----------
    theta : (n_p, n_p) array
        Derivatives by two parameters.
    mixed : (n_windows, n_p, n) array
        Derivatives by a parameter and a window start.
    """

    theta: FloatArray
    mixed: FloatArray


def omitted_part(
    problem: Shooting,
    theta: FloatArray,
    at: Lagrangian,
    curvatures: Sequence[FloatArray],
    wanted: Sequence[Sequence[int]] | None = None,
) -> list[PartHessian]:
    """Return the second-order term of cost and weighted window ends (neglected by Gauss-Newton), by part.

    They are by the own parameters of each predictor and by the starts of its windows.

    Parameters
    ----------
    problem : Shooting
        Problem of the fit.
    theta : (n_p,) array
        Parameters.
    at : Lagrangian
        Starts of all windows, multipliers at their ends, and weight of the errors.
    curvatures : sequence of (n_p,) array
        For each part, its approximate share in the second derivatives of the cost by the parameters at its `index`. The
        sum of the shares sets the steps of differences.
    wanted : sequence of sequence of int, optional
        For each part, the indices of its own parameters with a column; all when left out. Other columns are zero.

    Returns
    -------
    list of PartHessian
        Columns of each part in physical units; not finite when the errors overflow.
    """
    curvature = np.zeros(problem.n_theta)
    for part, share in zip(problem.parts, curvatures, strict=True):
        curvature[part.index] += share
    units, values = 1 / np.sqrt(np.maximum(curvature, np.finfo(float).tiny)), problem.values(theta)
    every = wanted or [range(len(part.predictor.free)) for part in problem.parts]
    omitted, finite = [], bool(np.isfinite(curvature).all())  # no steps can be chosen where the errors overflow
    for (v, part, begin), last, columns in zip(
        problem.each(values, at.starts), problem.by_part(at.ends), every, strict=True
    ):
        if finite and len(columns):
            moved = _moved(problem, part, theta, columns, units)
            omitted.append(
                PartHessian(*part.kernel.left_out(v, part.blocks, Lagrangian(begin, last, at.weight), moved))
            )
        else:
            n_own, fill = len(part.predictor.free), 0.0 if finite else np.nan
            mixed = np.full((part.blocks.n_windows, n_own, problem.n_states), fill)
            omitted.append(PartHessian(np.full((n_own, n_own), fill), mixed))
    return omitted


def _moved(
    problem: Shooting, part: RecordGroup, theta: FloatArray, columns: Sequence[int], units: FloatArray
) -> list[Moved]:
    """Return predictors of a part with a finite-difference step in each of some parameters, within the bounds."""
    local_theta = np.array(part.own(theta), float)
    points = np.tile(local_theta, (len(columns) + 1, 1))  # the point itself is the first
    steps = []
    for row, j in zip(points[1:], columns, strict=True):
        direction = np.eye(len(local_theta))[j] if part.tie is None else np.abs(part.tie[j])
        step = _DIFFERENCE * float((direction * units[part.index]).max())
        step = min(
            step, _MOST * max(abs(float(local_theta[j])), float((direction * problem.theta_scale[part.index]).max()))
        )
        steps.append(-step if local_theta[j] + step > part.predictor.free[j].upper else step)
        row[j] += steps[-1]
    values = part.predictor.at_each(points)[1:]
    return [Moved(j, step, v) for j, step, v in zip(columns, steps, values, strict=True)]


_REFRESH = 2  # number of iterations that use the same exact columns
_COLOURED = 0.1  # correlation of neighbouring errors above which they do not count as white
_SLOW = 8  # iterations that the columns of the gain alone may need
_LEAST = 0.01  # smallest curvature, as a part of that of Gauss-Newton
_FLAT = 1e-12  # largest curvature of an undetermined direction, as a part of the largest


Curvature = Callable[[FloatArray, float, FloatArray], FloatArray]
"""Entries of the Lagrangian's Hessian in the order of `Shooting.hessian_pattern`, for unknowns and multipliers."""


def gauss_newton(problem: Shooting) -> Curvature:
    """Return the Gauss-Newton Hessian: products of first derivatives."""
    return lambda unknowns, lam_f, lam_gaps: np.asarray(lam_f * problem.at(unknowns).hessian)  # noqa: ARG005


class ExactHessian:
    """Gauss-Newton Hessian plus second-order term for parameter columns, updated every few iterations.

    For white errors these are only the columns of the disturbance gain, because the gain multiplies the errors
    themselves. For coloured errors, and in a flat valley where these do not suffice, they are all columns.

    The Hessian of each part is made convex by itself (`held_up`). Otherwise the solver would shift the Hessian of all
    parts for one of them.
    """

    def __init__(self, problem: Shooting) -> None:
        self._problem = problem
        self._calls = 0
        self._everything = False
        self._left_out: list[PartHessian] = []

    def __call__(self, unknowns: FloatArray, lam_f: float, lam_gaps: FloatArray) -> FloatArray:
        """Return the Hessian entries at the solver's next point."""
        problem, iterate = self._problem, self._problem.at(unknowns)
        if not iterate.sweeps:
            return np.asarray(lam_f * iterate.hessian)
        if self._calls % _REFRESH == 0:
            everything = self._calls >= _SLOW or neighbours(problem, unknowns) > _COLOURED
            self._everything = self._everything or everything
            self._left_out = left_out_columns(problem, unknowns, lam_gaps, everything=self._everything)
        self._calls += 1
        convex = [
            left._replace(theta=held_up(left.theta, kept.theta)) if left.theta.any() else left
            for left, kept in zip(self._left_out, gauss_newton_of(problem, iterate), strict=True)
        ]
        return np.asarray(lam_f * (iterate.hessian + entries_of(problem, convex)))


def gauss_newton_of(problem: Shooting, iterate: Iterate) -> list[PartHessian]:
    """Return the Gauss-Newton Hessian of each part at a computed iterate."""
    scales, factor = (problem.theta_scale[part.index] for part in problem.parts), iterate.factor
    return [
        PartHessian(factor * s.hessian * np.outer(t, t), s.hessian_mixed * (factor * t[:, None] * problem.state_scale))
        for t, s in zip(scales, iterate.sweeps, strict=True)
    ]


def held_up(left_out: FloatArray, gauss_newton: FloatArray) -> FloatArray:
    """Return a correction that keeps the Hessian convex: negative curvatures change sign.

    Parameters
    ----------
    left_out, gauss_newton : (n, n) array
        Omitted part and Gauss-Newton Hessian, symmetric. `gauss_newton` has no negative curvature. Directions without
        curvature get no correction.

    Returns
    -------
    (n, n) array
        Correction. With it, each curvature has its absolute value, but at least `_LEAST` of Gauss-Newton's.
    """
    size, axes = np.linalg.eigh(gauss_newton)
    curved = size > _FLAT * size[-1]
    root = np.sqrt(size[curved])
    inward, outward = axes[:, curved] / root, axes[:, curved] * root
    ratio, along = np.linalg.eigh(inward.T @ left_out @ inward)
    outward = outward @ along
    return np.asarray((outward * (np.maximum(np.abs(1 + ratio), _LEAST) - 1)) @ outward.T)


def neighbours(problem: Shooting, unknowns: FloatArray) -> float:
    """Return the correlation of neighbouring errors: the largest of all outputs."""
    theta, starts = problem.unpack(unknowns)
    errors = problem.errors(problem.values(theta), starts)
    products = sum(np.einsum("gkyw,gkyw->y", e[:, 1:], e[:, :-1]) for e in errors)
    squares = sum(np.einsum("gkyw,gkyw->y", e, e) for e in errors)
    return float(np.max(np.abs(products) / np.maximum(squares, np.finfo(float).tiny)))


def left_out_columns(
    problem: Shooting, unknowns: FloatArray, lam_gaps: FloatArray, *, everything: bool = True
) -> list[PartHessian]:
    """Return the second-order term of the Hessian of the weighted squares, for the parameters of each part.

    The weight of the errors is constant. The cost is the logarithm of the squares. Away from the minimum, the logarithm
    has less curvature, and for very small squares even negative curvature. This share is omitted.

    Parameters
    ----------
    problem : Shooting
        Problem of the fit.
    unknowns : (n_unknowns,) array
        Scaled unknowns.
    lam_gaps : (n_gaps,) array
        Multipliers of the gaps.
    everything : bool
        Whether to compute all columns. If not, parts without ties get the columns of the disturbance gain only, and
        parts without a gain none.

    Returns
    -------
    list of PartHessian
        Scaled columns of each part; zero when they overflow.
    """
    iterate = problem.at(unknowns)
    kept = gauss_newton_of(problem, iterate)
    wanted = [
        range(len(part.predictor.free))
        if (everything if part.tie is None else part.predictor.noise)
        else part.predictor.noise
        for part in problem.parts
    ]
    weight = problem.weight(np.asarray(sum(s.error_products for s in iterate.sweeps)))
    curvatures = [
        np.diag(gn.theta) / problem.theta_scale[part.index] ** 2 for part, gn in zip(problem.parts, kept, strict=True)
    ]
    theta, starts = problem.unpack(unknowns)
    omitted = omitted_part(problem, theta, Lagrangian(starts, on_ends(problem, lam_gaps), weight), curvatures, wanted)
    exact = []
    for part, columns, (theta, mixed), gn in zip(problem.parts, wanted, omitted, kept, strict=True):
        scale = problem.theta_scale[part.index]
        left = PartHessian(np.zeros_like(gn.theta), np.zeros_like(gn.mixed))
        places = list(columns)
        if part.tie is not None:
            theta, mixed = part.tie.T @ theta @ part.tie, np.einsum("wjn,jp->wpn", mixed, part.tie)
            places = list(range(len(part.index)))
        theta, mixed = theta * np.outer(scale, scale), mixed * (scale[:, None] * problem.state_scale)
        if np.isfinite(theta).all() and np.isfinite(mixed).all():
            block = np.ix_(places, places)
            theta[block] = (theta[block] + theta[block].T) / 2
            left.theta[:, places], left.mixed[:, places] = theta[:, places], mixed[:, places]
            left.theta[places] = theta[:, places].T
        exact.append(left)
    return exact


def entries_of(problem: Shooting, left_out: Sequence[PartHessian]) -> FloatArray:
    """Return Hessian entries in the order of `Shooting.hessian_pattern`, summed over all parts."""
    theta = np.zeros((problem.n_theta, problem.n_theta))
    for part, omitted in zip(problem.parts, left_out, strict=True):
        theta[np.ix_(part.index, part.index)] += omitted.theta
    nothing = [np.zeros((len(omitted.mixed), problem.n_states, problem.n_states)) for omitted in left_out]
    return problem.hessian_entries(theta, [omitted.mixed for omitted in left_out], nothing)
