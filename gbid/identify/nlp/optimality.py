"""First-order optimality of a point of the shooting problem, in standard deviations of the estimates.

The measure is the length of the Gauss-Newton step that would come next, with the linearised gaps closed and the active
bounds kept. It is zero at a stationary point, whatever the Hessian. It does not depend on units or scales.
"""

from __future__ import annotations

import warnings

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.linalg import MatrixRankWarning, splu

from gbid.arrays import FloatArray
from gbid.identify.nlp.record_group import Iterate
from gbid.identify.nlp.shooting import Shooting

_ROUNDING = 1e-12  # of a curvature: for unknowns that the data do not tell
_UNSEEN = 1e-10  # of the largest curvature
_AT_BOUND = 1e-4  # scaled


def distance_from_rest(problem: Shooting, unknowns: FloatArray, box: tuple[FloatArray, FloatArray]) -> float:
    """Return the length of the next Gauss-Newton step in standard deviations of the estimates.

    Parameters
    ----------
    problem : Shooting
        Problem of the fit.
    unknowns : (n_unknowns,) array
        Scaled unknowns.
    box : (n_unknowns,) array, (n_unknowns,) array
        Their bounds, scaled.

    Returns
    -------
    float
        Infinite where the problem has no value or the step cannot be computed; zero where all errors are rounding.
    """
    iterate = problem.at(unknowns)
    if not (np.isfinite(iterate.cost) and np.isfinite(iterate.gradient).all() and np.isfinite(iterate.hessian).all()):
        return np.inf
    if problem.extra is None and iterate.cost <= problem.exact_cost:
        return 0.0
    try:
        step = gauss_newton_step(problem, iterate, unknowns, box)
    except (RuntimeError, ValueError, MatrixRankWarning):  # singular
        return np.inf
    return in_standard_deviations(problem, iterate, step)


def in_standard_deviations(problem: Shooting, iterate: Iterate, moved: FloatArray) -> float:
    """Return the length of a step (n_unknowns,) in the metric of the information at a point."""
    pattern, entries = problem.hessian_pattern, iterate.hessian
    twice = np.where(pattern.rows == pattern.columns, 1.0, 2.0)
    square = float((twice * entries * moved[pattern.rows] * moved[pattern.columns]).sum())
    return float(np.sqrt(max(square, 0.0) * problem.likelihood_size)) if np.isfinite(square) else np.inf


def gauss_newton_step(
    problem: Shooting, iterate: Iterate, x: FloatArray, box: tuple[FloatArray, FloatArray]
) -> FloatArray:
    """Return the step (n_unknowns,) from the sparse system of the optimality conditions."""
    met, off = _active_rows(problem, iterate, x)
    active, of = np.nonzero(met)
    n, m = problem.n_unknowns, problem.n_gaps + len(met)
    upper, across = problem.hessian_pattern, problem.jacobian_pattern
    free = np.concatenate([(x > box[0] + _AT_BOUND) & (x < box[1] - _AT_BOUND), np.ones(m, dtype=bool)])
    # Each unknown in units of its own curvature, each constraint in units of its largest entry.
    beside = upper.rows != upper.columns
    size = np.zeros(n)
    size[upper.rows[~beside]] = iterate.hessian[~beside]
    seen = size > _UNSEEN * size.max()  # the state in a stretch that is left out has no curvature of its own
    size = np.where(seen, 1 / np.sqrt(np.where(seen, size, 1.0)), 1.0)
    bound = np.concatenate([across.rows, problem.n_gaps + active]), np.concatenate([across.columns, of])
    slopes = np.concatenate([iterate.jacobian, met[active, of]]) * size[bound[1]]
    largest = np.zeros(m)
    np.maximum.at(largest, bound[0], np.abs(slopes))
    largest = np.where(largest > 0, largest, 1.0)
    entries = iterate.hessian * size[upper.rows] * size[upper.columns]
    own = np.zeros(n)
    own[upper.rows[~beside]] = entries[~beside]
    every, scaled = np.arange(n + m), slopes / largest[bound[0]]
    parts = [
        (upper.rows[beside], upper.columns[beside], entries[beside]),
        (n + bound[0], bound[1], scaled),
    ]
    rows, columns, entries = (np.concatenate(each) for each in zip(*parts, strict=True))
    kept = free[rows] & free[columns]
    rows, columns, entries = rows[kept], columns[kept], entries[kept]
    diagonal = np.concatenate([np.where(free[:n], own + _ROUNDING, 1.0), np.full(m, -_ROUNDING)])
    matrix = coo_array(
        (
            np.concatenate([entries, entries, diagonal]),
            (np.concatenate([rows, columns, every]), np.concatenate([columns, rows, every])),
        ),
        shape=(n + m, n + m),
    )
    matrix.has_canonical_format = True  # each entry once: no search for others
    matrix = matrix.tocsc()
    matrix.has_canonical_format = matrix.has_sorted_indices = True  # the factorisation needs no order in a column
    slope = np.concatenate([iterate.gradient * size, np.concatenate([iterate.gaps, off]) / largest])
    with warnings.catch_warnings():
        warnings.simplefilter("error", MatrixRankWarning)
        factors = splu(matrix)
    return np.asarray(size * factors.solve(np.where(free, -slope, 0.0))[:n])


def _active_rows(problem: Shooting, iterate: Iterate, x: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return slopes of active constraints, (n_active, n_unknowns), and how far each is from its bound, (n_active,)."""
    limits, low, high = problem.limits
    values = limits @ x[: problem.n_theta]
    own = limits[(values < low + _AT_BOUND) | (values > high - _AT_BOUND)]
    rows = np.pad(own, ((0, 0), (0, problem.n_unknowns - problem.n_theta)))
    off = np.zeros(len(own))
    if problem.placed is None:
        return rows, off
    distance = problem.placed.terms.off_bound(iterate.extra_rows, _AT_BOUND)
    active = ~np.isnan(distance)
    further = np.zeros((int(active.sum()), problem.n_unknowns))
    further[:, problem.placed.places] = iterate.extra_slopes[active]
    return np.vstack([rows, further]), np.concatenate([off, distance[active]])
