"""The Hessian that the solver is handed: Gauss-Newton, or that and what it leaves out, learned on the way.

Gauss-Newton leaves out the errors times the predictor's second derivatives. With white errors that is next to
nothing; where they are coloured (process noise, a film that is not linear, whirl) it is as large as the rest in some
direction, and Gauss-Newton creeps along it.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
import numpy.typing as npt

from gbid.identify.adjoint import lagrangian_gradient
from gbid.identify.shooting import Iterate, Shooting

FloatArray = npt.NDArray[np.float64]
_REFRESH = 2  # iterations for which the columns of the disturbance gain serve
_DIFFERENCE = 1e-4  # step of a difference, in units in which the cost has curvature one
_MOST_DIFFERENCES = 8  # columns; with more, as for gains local to many recordings, they cost more than they save
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
    solver shifts the Hessian itself.

    Notes
    -----
    With the step s and the change y of the Lagrangian's gradient over it, both at the last multipliers, and B the
    Hessian so far at the new point, ``r = y - B s`` is what it does not explain; ``B + r r' / (r' s)`` does
    (Nocedal and Wright, Numerical Optimization, Sec. 6.2; structured, after Dennis, Gay and Welsch, 1981).
    """

    def __init__(self, problem: Shooting) -> None:
        self._problem = problem
        self._base: FloatArray = np.zeros(0)
        self._calls = 0
        self._learned = np.zeros((problem.n_theta, problem.n_theta))
        self._before: tuple[FloatArray, Iterate] | None = None

    def __call__(self, unknowns: FloatArray, lam_f: float, lam_gaps: FloatArray) -> FloatArray:
        """Evaluate at the solver's next point, and learn from the step to it."""
        problem, pattern = self._problem, self._problem.hessian_pattern
        if self._calls % _REFRESH == 0:
            self._base = noise_columns(problem, unknowns, lam_gaps)
        self._calls += 1
        here = problem.at(unknowns)
        entries = here.hessian + self._base
        if self._before is not None:
            self._learn(unknowns, here, entries, lam_gaps)
        self._before = unknowns.copy(), here
        block = np.flatnonzero(pattern.columns < problem.n_theta)
        entries[block] += self._learned[pattern.rows[block], pattern.columns[block]]
        return np.asarray(lam_f * entries)

    def _learn(self, unknowns: FloatArray, here: Iterate, entries: FloatArray, lam_gaps: FloatArray) -> None:
        """Take in what the last step says; `entries` are those without what was learned before."""
        problem, pattern = self._problem, self._problem.hessian_pattern
        assert self._before is not None
        origin, there = self._before
        step = unknowns - origin
        change = problem.lagrangian_gradient(here, 1.0, lam_gaps) - problem.lagrangian_gradient(there, 1.0, lam_gaps)
        n, rows, columns = problem.n_theta, pattern.rows, pattern.columns
        explained = np.bincount(rows, entries * step[columns], minlength=len(step))
        beside = rows != columns
        explained += np.bincount(columns[beside], (entries * step[rows])[beside], minlength=len(step))
        own = step[:n]
        left = (change - explained)[:n] - self._learned @ own
        along = float(left @ own)
        if abs(along) > _WORTHLESS * float(np.linalg.norm(left) * np.linalg.norm(own)):
            self._learned += np.outer(left, left) / along


def noise_columns(problem: Shooting, unknowns: FloatArray, lam_gaps: FloatArray) -> FloatArray:
    """Add this to the Gauss-Newton Hessian of the Lagrangian to have exact columns for the disturbance gain.

    What the disturbance gain does to the predictions is made of the errors themselves, so the second derivatives
    that Gauss-Newton leaves out are as large as what it keeps. The columns come from differences of the Lagrangian's
    gradient.

    Returns
    -------
    (n_nonzeros,) array
        Entries where `Shooting.hessian_pattern` has them.
    """
    iterate = problem.at(unknowns)
    entries = iterate.hessian.copy()
    if not problem.noise or len(problem.noise) > _MOST_DIFFERENCES:
        return np.zeros_like(entries)
    here = problem.lagrangian_gradient(iterate, 1.0, lam_gaps)
    rows, columns = problem.hessian_pattern.rows, problem.hessian_pattern.columns
    for j in problem.noise:
        there = unknowns.copy()
        there[j] += _DIFFERENCE
        slope = (lagrangian_gradient(problem, there, lam_gaps) - here) / _DIFFERENCE
        if not np.isfinite(slope).all():
            continue
        in_column, in_row = columns == j, rows == j
        entries[in_column] = slope[rows[in_column]]
        entries[in_row] = slope[columns[in_row]]
    return entries - iterate.hessian
