"""Covariance of the estimates: for white residuals, and a robust one for coloured residuals."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gbid.arrays import BoolArray, FloatArray, IntArray
from gbid.identify.kernel.blocks import LONGEST_BLOCK
from gbid.identify.nlp.shooting import Shooting
from gbid.identify.uncertainty.information import information_over_records

_UNDETERMINED = 1e-13  # eigenvalue of the scaled information below which a direction counts as not determined
FLATTEST = 1e-4
"""Curvature, as a part of Gauss-Newton's, below which a point is no minimum."""
_BLOCKS = 64  # the least number of blocks, within which scores are summed before they are correlated
_SHORTEST, _LONGEST = 8, 64  # samples in such a block
_MOST_BLOCKS = 200  # in long records the blocks grow instead


class Covariance(NamedTuple):
    """Uncertainty of the free parameters, initial states estimated along.

    Attributes
    ----------
    white : (n_p, n_p) array
        For white residuals.
    robust : (n_p, n_p) array
        For residuals of any colour.
    flatness : float
        Least curvature of the cost over Gauss-Newton's, of all directions: about one with white residuals; NaN where
        it was not asked for. Below `FLATTEST` the point is no minimum, and the robust covariance Gauss-Newton's.
    undetermined : (n_directions, n_p) array
        Unit directions, in parameters scaled by their curvature, that the data say nothing about; mostly empty.
    condition : float
        Condition of the scaled information.
    """

    white: FloatArray
    robust: FloatArray
    flatness: float
    undetermined: FloatArray
    condition: float


def covariance(
    problem: Shooting,
    theta: FloatArray,
    starts: FloatArray,
    record_window: IntArray,
    error_products: FloatArray,
    memory: int,
    held: BoolArray,
    *,
    initial_known: bool = False,
    coloured: bool = False,
) -> Covariance:
    """Covariance of the parameters at an estimate.

    Parameters
    ----------
    problem : Shooting
    theta : (n_p,) array
    starts : (n_windows, n) array
    record_window : (n_records,) integer array
        First window of each record.
    error_products : (n_y, n_y) array
        ``sum e e'``.
    memory : int
        Samples over which residuals are correlated.
    held : (n_p,) boolean array
        Parameters on a bound: they count as known, and get zero rows.
    initial_known : bool
        Whether initial states were given instead of estimated.
    coloured : bool
        Whether the robust covariance is to have the cost's own Hessian; it costs a pass for each parameter.

    Returns
    -------
    Covariance

    Notes
    -----
    With the Hessian H of ``sum e' W e / 2`` over parameters and initial states, and J the covariance of its gradient
    ``sum psi' W e``, the estimates have the covariance ``H^-1 J H^-1`` (Ljung, System Identification,
    Secs. 9.2 to 9.4). White residuals owe nothing to the past, so that Gauss-Newton's ``H = sum psi' W psi`` will do;
    and with their covariance Lambda, ``J = sum psi' W Lambda W psi``. With coloured ones H has what Gauss-Newton
    leaves out, ``-sum psi_i' W d psi_j``, which along the disturbance gain is most of it. The robust J
    sums the products of the gradients of neighbouring blocks, with weights that fall to zero at a few times
    the residuals' memory (Newey and West, 1987), and makes up for what the fit takes of it. A prior adds its
    information to H and, as what a datum of its variance would do, to J.
    """
    n_p = problem.n_theta
    n_all = n_p + len(record_window) * problem.n_states
    weight = problem.weight(error_products)
    freedom = max(1.0, problem.n_samples - n_all / len(weight))
    block = min(max(problem.n_samples // _BLOCKS, _SHORTEST), _LONGEST)
    block = max(block, min(problem.n_samples // _MOST_BLOCKS, LONGEST_BLOCK))
    shaped = weight @ (error_products / freedom) @ weight
    found = information_over_records(
        problem, block, theta, starts, record_window, weight, shaped=shaped, observed=coloured
    )

    # The weight is one over the total error, the likelihood's one over its variance: they differ by this factor.
    unit = float(np.trace(weight @ error_products)) / (problem.n_samples * len(weight))
    known = np.concatenate([problem.prior.information * unit, np.zeros(n_all - n_p)])
    keep = np.concatenate([~held, np.full(n_all - n_p, not initial_known)])
    kept = np.ix_(keep, keep)
    H = (found.hessian + np.diag(known))[kept]
    J_white = (found.shaped + np.diag(known * unit))[kept]
    lag = max(1, round(3 * memory / block))
    J_robust = long_run([scores[:, keep] for scores in found.scores], lag) / share_left(
        list(map(len, found.scores)), lag
    )
    J_robust += np.diag(known * unit)[kept]

    scale = np.sqrt(np.maximum(np.diag(H), np.finfo(float).tiny))
    eigenvalues, vectors = np.linalg.eigh(H / np.outer(scale, scale))
    dark = eigenvalues < _UNDETERMINED * eigenvalues[-1]
    root = vectors[:, ~dark] / np.sqrt(eigenvalues[~dark]) / scale[:, None]  # root root' is the inverse
    inverse, flatness = root @ root.T, np.nan
    n_kept = int((~held).sum())

    def over_parameters(J: FloatArray, inverse: FloatArray) -> FloatArray:
        result = np.zeros((n_p, n_p))
        result[np.ix_(~held, ~held)] = (inverse @ J @ inverse)[:n_kept, :n_kept]
        return result

    white = over_parameters(J_white, inverse)
    if found.observed is not None:
        own, axes = np.linalg.eigh(root.T @ (found.observed + np.diag(known))[kept] @ root)
        flatness = float(own[0])
        if flatness >= FLATTEST:
            axes = root @ axes
            inverse = (axes / own) @ axes.T

    directions = np.zeros((int(dark.sum()), n_p))
    directions[:, ~held] = vectors[:n_kept, dark].T
    # A direction among initial states alone is no concern of the parameters.
    directions = directions[np.linalg.norm(directions, axis=1) > 1e-2]
    condition = float(eigenvalues[-1] / max(eigenvalues[0], np.finfo(float).tiny))
    return Covariance(white, over_parameters(J_robust, inverse), flatness, directions, condition)


def long_run(scores: list[FloatArray], lag: int) -> FloatArray:
    """Covariance of the sum of scores, neighbours up to `lag` blocks counted with falling weights."""
    n = scores[0].shape[1]
    total = np.zeros((n, n))
    for s in scores:
        total += s.T @ s
        for shift in range(1, min(lag, len(s) - 1) + 1):
            product = s[shift:].T @ s[:-shift]
            total += (1 - shift / (lag + 1)) * (product + product.T)
    return total


def share_left(lengths: list[int], lag: int) -> float:
    """Share of `long_run` that is left, in the mean, of scores that add up to zero as they do at an estimate.

    What is lost are the weights' share of all pairs of blocks (Kiefer and Vogelsang, 2005); at least a third is left.
    """
    counted = float(sum(lengths))
    for length in lengths:
        shifts = np.arange(1, min(lag, length - 1) + 1)
        counted += 2 * float(((1 - shifts / (lag + 1)) * (length - shifts)).sum())
    return max(1 - counted / sum(lengths) ** 2, 1 / 3)
