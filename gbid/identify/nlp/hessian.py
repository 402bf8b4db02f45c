"""Hessians for the solver: Gauss-Newton, or Gauss-Newton with the part that it omits.

Gauss-Newton omits the product of the errors and the second derivatives of the predictor. For white errors this part is
almost zero. For coloured errors (process noise, a nonlinear film, whirl) it is as large as the rest in some
directions, and Gauss-Newton converges slowly there.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from gbid.arrays import FloatArray
from gbid.identify.nlp.adjoint import on_ends
from gbid.identify.nlp.omitted_part import PartHessian, omitted_part
from gbid.identify.nlp.record_group import Iterate
from gbid.identify.nlp.shooting import Shooting

_REFRESH = 2  # number of iterations that use the same exact columns
_COLOURED = 0.1  # correlation of neighbouring errors above which they do not count as white
_LEAST = 0.01  # smallest curvature, as a part of that of Gauss-Newton
_FLAT = 1e-12  # largest curvature of an undetermined direction, as a part of the largest


class Curvature(Protocol):
    """Function for the entries of the Lagrangian's Hessian in the order of `Shooting.hessian_pattern`."""

    def __call__(self, unknowns: FloatArray, lam_f: float, lam_gaps: FloatArray) -> FloatArray:
        """Return the entries at a point, for multipliers of cost and gaps."""
        ...


class GaussNewton:
    """Gauss-Newton Hessian: products of first derivatives, which each pass computes."""

    def __init__(self, problem: Shooting) -> None:
        self._problem = problem

    def __call__(self, unknowns: FloatArray, lam_f: float, lam_gaps: FloatArray) -> FloatArray:  # noqa: ARG002
        """Return the entries at a point."""
        return np.asarray(lam_f * self._problem.at(unknowns).hessian)


class ExactHessian:
    """Gauss-Newton Hessian with the omitted part of the parameters' columns, computed every few iterations.

    For white errors these are only the columns of the disturbance gain, because the gain multiplies the errors
    themselves. For coloured errors they are all columns.

    The Hessian of each part is made convex by itself (`held_up`). Otherwise the solver would shift the Hessian of all
    parts for one of them.
    """

    def __init__(self, problem: Shooting) -> None:
        self._problem = problem
        self._calls = 0
        self._coloured = False
        self._left_out: list[PartHessian] = []

    def __call__(self, unknowns: FloatArray, lam_f: float, lam_gaps: FloatArray) -> FloatArray:
        """Return the entries at the solver's next point."""
        problem, here = self._problem, self._problem.at(unknowns)
        if not here.sweeps:
            return np.asarray(lam_f * here.hessian)
        if self._calls % _REFRESH == 0:
            self._coloured = self._coloured or neighbours(problem, unknowns) > _COLOURED
            self._left_out = left_out_columns(problem, unknowns, lam_gaps, everything=self._coloured)
        self._calls += 1
        convex = [
            PartHessian(held_up(own.theta, kept.theta), own.mixed) if own.theta.any() else own
            for own, kept in zip(self._left_out, gauss_newton_of(problem, here), strict=True)
        ]
        return np.asarray(lam_f * (here.hessian + entries_of(problem, convex)))


def gauss_newton_of(problem: Shooting, iterate: Iterate) -> list[PartHessian]:
    """Return the Gauss-Newton Hessian of each part at an evaluated point."""
    found = []
    for part, s in zip(problem.parts, iterate.sweeps, strict=True):
        t = problem.theta_scale[part.index]
        mixed = s.hessian_mixed * (iterate.factor * t[:, None] * problem.state_scale)
        found.append(PartHessian(iterate.factor * s.hessian * np.outer(t, t), mixed))
    return found


def held_up(left_out: FloatArray, gauss_newton: FloatArray) -> FloatArray:
    """Return a correction that keeps the Gauss-Newton Hessian convex: negative curvatures change their sign.

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
    there = size > _FLAT * size[-1]
    root = np.sqrt(size[there])
    inward, outward = axes[:, there] / root, axes[:, there] * root
    ratio, along = np.linalg.eigh(inward.T @ left_out @ inward)
    outward = outward @ along
    return np.asarray((outward * (np.maximum(np.abs(1 + ratio), _LEAST) - 1)) @ outward.T)


def neighbours(problem: Shooting, unknowns: FloatArray) -> float:
    """Return the correlation of neighbouring errors, for the output with the largest one."""
    theta, starts = problem.unpack(unknowns)
    errors = problem.errors(problem.values(theta), starts)
    products = sum(np.einsum("gkyw,gkyw->y", e[:, 1:], e[:, :-1]) for e in errors)
    squares = sum(np.einsum("gkyw,gkyw->y", e, e) for e in errors)
    return float(np.max(np.abs(products) / np.maximum(squares, np.finfo(float).tiny)))


def left_out_columns(
    problem: Shooting, unknowns: FloatArray, lam_gaps: FloatArray, *, everything: bool = True
) -> list[PartHessian]:
    """Return the part of the Hessian of the weighted squares that Gauss-Newton omits, for the parameters of each part.

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
        if (part.predictor.noise and (everything or part.tie is not None)) or (everything and part.tie is None)
        else part.predictor.noise
        for part in problem.parts
    ]
    weight = problem.weight(np.asarray(sum(s.error_products for s in iterate.sweeps)))
    curvatures = [
        np.diag(gn.theta) / problem.theta_scale[part.index] ** 2 for part, gn in zip(problem.parts, kept, strict=True)
    ]
    omitted = omitted_part(problem, *problem.unpack(unknowns), on_ends(problem, lam_gaps), curvatures, weight, wanted)
    found = []
    for part, own, (theta, mixed), gn in zip(problem.parts, wanted, omitted, kept, strict=True):
        scale = problem.theta_scale[part.index]
        left = PartHessian(np.zeros_like(gn.theta), np.zeros_like(gn.mixed))
        if part.tie is not None:
            theta, mixed = part.tie.T @ theta @ part.tie, np.einsum("wjn,jp->wpn", mixed, part.tie)
        theta = theta * np.outer(scale, scale)
        mixed = mixed * (scale[:, None] * problem.state_scale)
        at = list(own) if part.tie is None else list(range(len(part.index)))
        if np.isfinite(theta).all() and np.isfinite(mixed).all():
            theta[np.ix_(at, at)] = (theta[np.ix_(at, at)] + theta[np.ix_(at, at)].T) / 2
            left.theta[:, at], left.mixed[:, at] = theta[:, at], mixed[:, at]
            left.theta[at] = theta[:, at].T
        found.append(left)
    return found


def entries_of(problem: Shooting, left_out: Sequence[PartHessian]) -> FloatArray:
    """Return the entries in the order of `Shooting.hessian_pattern`, summed over all parts."""
    theta = np.zeros((problem.n_theta, problem.n_theta))
    for part, own in zip(problem.parts, left_out, strict=True):
        theta[np.ix_(part.index, part.index)] += own.theta
    nothing = [np.zeros((len(own.mixed), problem.n_states, problem.n_states)) for own in left_out]
    return problem.hessian_entries(theta, [own.mixed for own in left_out], nothing)
