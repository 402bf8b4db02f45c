"""The Hessian that the solver is handed: Gauss-Newton, or that and what it leaves out, learned on the way.

Gauss-Newton leaves out the errors times the predictor's second derivatives. With white errors that is next to
nothing; where they are coloured (process noise, a film that is not linear, whirl) it is as large as the rest in some
direction, and Gauss-Newton creeps along it.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
import numpy.typing as npt

from gbid.identify.adjoint import PartGradients, part_gradients
from gbid.identify.shooting import Iterate, Shooting

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
_REFRESH = 2  # iterations for which the columns of the disturbance gain serve
_DIFFERENCE = 1e-5  # step of a difference, in units in which the cost has curvature one
_MOST_DIFFERENCES = 8  # passes; with more they cost more than they save
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
    gradient; gains of different recordings share one, since each recording feels its own alone.

    Returns
    -------
    (n_nonzeros,) array
        Entries where `Shooting.hessian_pattern` has them.
    """
    iterate = problem.at(unknowns)
    groups = apart(problem)
    here = part_gradients(problem, unknowns, lam_gaps) if 0 < len(groups) <= _MOST_DIFFERENCES else None
    if here is None:
        return np.zeros_like(iterate.hessian)
    noise = np.array(problem.noise)
    slopes = np.full((problem.n_unknowns, len(noise)), np.nan)
    for group in groups:
        there = unknowns.copy()
        there[noise[group]] += _DIFFERENCE
        # With several gains at once, the weight must not tell one recording of the others.
        found = part_gradients(problem, there, lam_gaps, here.weight if len(group) > 1 else None)
        if found is not None:
            slopes[:, group] = _slopes(problem, noise[group], here, found)
    prior = problem.prior.information / problem.likelihood_size * problem.theta_scale**2
    slopes[noise, np.arange(len(noise))] += prior[noise]
    entries = iterate.hessian.copy()
    column_of = np.full(problem.n_unknowns, -1)
    column_of[noise] = np.arange(len(noise))
    pattern = problem.hessian_pattern
    for across, along in ((pattern.columns, pattern.rows), (pattern.rows, pattern.columns)):
        places = np.flatnonzero(column_of[across] >= 0)
        slope = slopes[along[places], column_of[across[places]]]
        known = np.isfinite(slope)
        entries[places[known]] = slope[known]
    return np.asarray(entries - iterate.hessian)


def apart(problem: Shooting) -> list[list[int]]:
    """Group the disturbance gains of `Shooting.noise`, by their places there: of a group, each part has one at most."""
    groups: list[tuple[set[int], list[int]]] = []
    for place, j in enumerate(problem.noise):
        felt = {i for i, part in enumerate(problem.parts) if j in part.noise}
        for taken, group in groups:
            if taken.isdisjoint(felt):
                taken |= felt
                group.append(place)
                break
        else:
            groups.append((felt, [place]))
    return [group for _, group in groups]


def _slopes(problem: Shooting, group: IntArray, here: PartGradients, there: PartGradients) -> FloatArray:
    """Columns of the Hessian for a group of gains, (n_unknowns, n_group), from gradients before and after a step."""
    theta = np.zeros((problem.n_theta, len(group)))
    starts = np.zeros((problem.n_windows, problem.n_states, len(group)))
    for i, (part, first) in enumerate(zip(problem.parts, problem.first_window[:-1], strict=True)):
        for column in np.flatnonzero(np.isin(group, part.noise)) if len(group) > 1 else (0,):
            theta[part.index, column] += (there.by_theta[i] - here.by_theta[i]) / _DIFFERENCE
            own = slice(first, first + part.blocks.n_windows)
            starts[own, :, column] = (there.by_start[i] - here.by_start[i]) / _DIFFERENCE
    return np.concatenate([theta, starts.reshape(-1, len(group))])
