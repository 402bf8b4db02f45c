"""The Hessian that the solver is handed: Gauss-Newton, or that and what it leaves out, learned on the way.

Gauss-Newton leaves out the errors times the predictor's second derivatives. With white errors that is next to
nothing; where they are coloured (process noise, a film that is not linear, whirl) it is as large as the rest in some
direction, and Gauss-Newton creeps along it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from gbid.arrays import FloatArray, IntArray
from gbid.identify.nlp.adjoint import on_ends
from gbid.identify.nlp.exact_columns import PartHessian, exact_columns
from gbid.identify.nlp.shooting import Iterate, Shooting

_REFRESH = 2  # iterations for which exact columns serve
_LEARNING = 6  # iterations, after which all columns are exact
_MOST_DIFFERENCES = 8  # passes; with more they cost more than they save
_LEAST = 0.01  # of Gauss-Newton's curvature
_FLAT = 1e-12  # of the largest: parameters that a part does not tell apart
_WORTHLESS = 1e-8  # cosine below which a step says nothing about the curvature along it


class Curvature(Protocol):
    """Entries of the Lagrangian's Hessian where `Shooting.hessian_pattern` has them."""

    def __call__(self, unknowns: FloatArray, lam_f: float, lam_gaps: FloatArray) -> FloatArray:
        """Evaluate at a point, for multipliers of cost and gaps."""
        ...


class GaussNewton:
    """Products of first derivatives, which come with each pass."""

    def __init__(self, problem: Shooting) -> None:
        self._problem = problem

    def __call__(self, unknowns: FloatArray, lam_f: float, lam_gaps: FloatArray) -> FloatArray:  # noqa: ARG002
        """Evaluate at a point."""
        return np.asarray(lam_f * self._problem.at(unknowns).hessian)


class StructuredSecant:
    """Gauss-Newton, columns for the disturbance gain made anew every few iterations, and secant updates of the rest.

    The updates are of rank one (SR1), of the parameters' block: they follow negative curvature, too, on which the
    solver shifts the Hessian itself. Each recording with parameters of its own learns for itself, as it depends on few
    of the unknowns, and among several is made convex by itself (`held_up`): else the solver would shift the whole
    Hessian for the sake of one. Where that is not the end within a few iterations, the valley is bent and there is
    more to learn than it lasts: from then on all columns are exact, made anew every few iterations with a pass for
    each parameter. Recordings with gains of their own keep what is learned.

    Notes
    -----
    With the step s and the change y of the Lagrangian's gradient over it, both at the last multipliers, and B the
    Hessian so far at the new point, ``r = y - B s`` is what it does not explain; ``B + r r' / (r' s)`` does
    (Nocedal and Wright, Numerical Optimization, Sec. 6.2; structured, after Dennis, Gay and Welsch, 1981; by parts,
    after Griewank and Toint, 1982).
    """

    def __init__(self, problem: Shooting) -> None:
        self._problem = problem
        self._several = len(gains_apart(problem)) > 1
        self._columns: list[PartHessian] = []
        self._calls = 0
        self._learned = [np.zeros((len(part.index),) * 2) for part in problem.parts]
        self._before: tuple[FloatArray, Iterate] | None = None

    def __call__(self, unknowns: FloatArray, lam_f: float, lam_gaps: FloatArray) -> FloatArray:
        """Evaluate at the solver's next point, and learn from the step to it."""
        problem, calls = self._problem, self._calls
        self._calls += 1
        here = problem.at(unknowns)
        if not here.sweeps:
            return np.asarray(lam_f * here.hessian)
        kept = gauss_newton_of(problem, here)
        exact = calls >= _LEARNING and not self._several
        if exact:
            if (calls - _LEARNING) % _REFRESH == 0:
                self._columns = all_columns(problem, unknowns, lam_gaps)
            left_out = self._columns
        else:
            if calls % _REFRESH == 0:
                self._columns = noise_columns(problem, unknowns, lam_gaps)
            if self._before is not None:
                self._learn(unknowns, here, kept, lam_gaps)
            self._before = unknowns.copy(), here
            left_out = [
                PartHessian(columns.theta + learned, columns.mixed)
                for columns, learned in zip(self._columns, self._learned, strict=True)
            ]
        if exact or len(left_out) > 1:
            left_out = [
                PartHessian(held_up(own.theta, gn.theta), own.mixed) for own, gn in zip(left_out, kept, strict=True)
            ]
        return np.asarray(lam_f * (here.hessian + entries_of(problem, left_out)))

    def _learn(self, unknowns: FloatArray, here: Iterate, kept: Sequence[PartHessian], lam_gaps: FloatArray) -> None:
        """Take in what the last step says of each part, beside what Gauss-Newton and the columns have."""
        problem = self._problem
        assert self._before is not None
        origin, there = self._before
        step = unknowns - origin
        starts = step[problem.n_theta :].reshape(-1, problem.n_states)
        new, old = (problem.gradients_by_part(point, lam_gaps) for point in (here, there))
        for i, (part, gn, columns) in enumerate(zip(problem.parts, kept, self._columns, strict=True)):
            own, first = step[part.index], problem.first_window[i]
            explained = (gn.theta + columns.theta + self._learned[i]) @ own
            explained += np.einsum("wpn,wn->p", gn.mixed + columns.mixed, starts[first : first + part.blocks.n_windows])
            left = new[i].theta - old[i].theta - explained
            along = float(left @ own)
            if abs(along) > _WORTHLESS * float(np.linalg.norm(left) * np.linalg.norm(own)):
                self._learned[i] += np.outer(left, left) / along


def gauss_newton_of(problem: Shooting, iterate: Iterate) -> list[PartHessian]:
    """Gauss-Newton's Hessian of each part at an evaluated point."""
    found = []
    for part, s in zip(problem.parts, iterate.sweeps, strict=True):
        t = problem.theta_scale[part.index]
        mixed = s.hessian_mixed * (iterate.factor * t[:, None] * problem.state_scale)
        found.append(PartHessian(iterate.factor * s.hessian * np.outer(t, t), mixed))
    return found


def held_up(left_out: FloatArray, gauss_newton: FloatArray) -> FloatArray:
    """Turn over what is left out where it takes more than all of Gauss-Newton's curvature, and keep some of that.

    Parameters
    ----------
    left_out, gauss_newton : (n, n) array
        Symmetric; `gauss_newton` has no negative curvature, and where it has none, nothing is left out.

    Returns
    -------
    (n, n) array
        What makes of each curvature its size, at least `_LEAST` of Gauss-Newton's.
    """
    size, axes = np.linalg.eigh(gauss_newton)
    there = size > _FLAT * size[-1]
    root = np.sqrt(size[there])
    inward, outward = axes[:, there] / root, axes[:, there] * root
    ratio, along = np.linalg.eigh(inward.T @ left_out @ inward)
    outward = outward @ along
    return np.asarray((outward * (np.maximum(np.abs(1 + ratio), _LEAST) - 1)) @ outward.T)


def gains_apart(problem: Shooting) -> set[tuple[int, ...]]:
    """Return the sets of disturbance gains that recordings have for themselves."""
    return {tuple(part.noise.tolist()) for part in problem.parts} - {()}


def noise_columns(problem: Shooting, unknowns: FloatArray, lam_gaps: FloatArray) -> list[PartHessian]:
    """Return what Gauss-Newton lacks of exact columns for the disturbance gain, part by part.

    What the disturbance gain does to the predictions is made of the errors themselves, so the second derivatives
    that Gauss-Newton leaves out are as large as what it keeps. Nothing where there are too many gains for that.

    Parameters
    ----------
    problem : Shooting
    unknowns : (n_unknowns,) array
        Scaled.
    lam_gaps : (n_gaps,) array
    """
    rows = [part.predictor.noise for part in problem.parts]
    if max(map(len, rows)) > _MOST_DIFFERENCES:
        rows = [()] * len(rows)
    places = [
        np.flatnonzero(np.isin(part.index, part.noise)) if wanted else np.zeros(0, int)
        for part, wanted in zip(problem.parts, rows, strict=True)
    ]
    return _left_out(problem, unknowns, lam_gaps, rows, places)


def all_columns(problem: Shooting, unknowns: FloatArray, lam_gaps: FloatArray) -> list[PartHessian]:
    """Return all that Gauss-Newton leaves out of the weighted squares, part by part.

    Parameters as for `noise_columns`. Off the minimum the logarithm of the squares curves less, and where they nearly
    vanish, downwards; that part is left aside.
    """
    rows = [range(len(part.predictor.free)) for part in problem.parts]
    places = [np.arange(len(part.index)) for part in problem.parts]
    return _left_out(problem, unknowns, lam_gaps, rows, places, weight_held=True)


def _left_out(
    problem: Shooting,
    unknowns: FloatArray,
    lam_gaps: FloatArray,
    rows: Sequence[Sequence[int]],
    places: Sequence[IntArray],
    *,
    weight_held: bool = False,
) -> list[PartHessian]:
    """Return what Gauss-Newton lacks of some columns.

    `rows` are those of the predictors' own parameters, `places` those at the parts' `index`, that depend on no others.
    The weight is that of the errors, and changes with them unless it is held.
    """
    shapes = [(part.blocks.n_windows, len(part.index), problem.n_states) for part in problem.parts]
    found = [PartHessian(np.zeros((n_p, n_p)), np.zeros((n_w, n_p, n))) for n_w, n_p, n in shapes]
    iterate = problem.at(unknowns)
    if not (iterate.sweeps and any(map(len, rows))):
        return found
    weight = None
    meant = {tuple(part.index[at].tolist()) for part, at in zip(problem.parts, places, strict=True)} - {()}
    if (
        weight_held or len(meant) > 1
    ):  # parameters of several recordings move at once: the weight must not tell one of the others
        weight = problem.weight(np.asarray(sum(s.error_products for s in iterate.sweeps)))
    kept = gauss_newton_of(problem, iterate)
    curvatures = [
        np.diag(gn.theta) / problem.theta_scale[part.index] ** 2 for part, gn in zip(problem.parts, kept, strict=True)
    ]
    ends = on_ends(problem, lam_gaps)
    exact = exact_columns(problem, *problem.unpack(unknowns), ends, rows, curvatures, weight)
    parts = zip(problem.parts, rows, places, found, exact, kept, strict=True)
    for part, wanted, at, own, columns, gn in parts:
        scale = problem.theta_scale[part.index]
        theta, mixed = columns
        if part.tie is not None:
            onto = part.tie[list(wanted)][:, at]
            theta, mixed = part.tie.T @ theta @ onto, np.einsum("wjn,jp->wpn", mixed, onto)
        theta = theta * np.outer(scale, scale[at]) - gn.theta[:, at]
        mixed = mixed * (scale[at, None] * problem.state_scale) - gn.mixed[:, at]
        if np.isfinite(theta).all() and np.isfinite(mixed).all():
            theta[at] = (theta[at] + theta[at].T) / 2
            own.theta[:, at] = theta
            own.theta[at] = theta.T
            own.mixed[:, at] = mixed
    return found


def entries_of(problem: Shooting, left_out: Sequence[PartHessian]) -> FloatArray:
    """Entries where `Shooting.hessian_pattern` has them, the sum of all parts."""
    theta = np.zeros((problem.n_theta, problem.n_theta))
    for part, own in zip(problem.parts, left_out, strict=True):
        theta[np.ix_(part.index, part.index)] += own.theta
    nothing = [np.zeros((len(own.mixed), problem.n_states, problem.n_states)) for own in left_out]
    return problem.hessian_entries(theta, [own.mixed for own in left_out], nothing)
