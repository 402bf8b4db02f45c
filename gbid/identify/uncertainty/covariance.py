"""Covariance of the estimates: for white residuals, and a robust one for coloured residuals."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gbid.arrays import BoolArray, FloatArray, IntArray
from gbid.identify.kernel.blocks import LONGEST_BLOCK
from gbid.identify.nlp.shooting import Shooting
from gbid.identify.uncertainty.by_windows import grows, information_by_windows
from gbid.identify.uncertainty.information import information_over_records

_UNDETERMINED = 1e-13  # largest eigenvalue of the scaled information for which a direction is not determined
FLATTEST = 1e-4
"""Smallest curvature of a minimum, as a part of the Gauss-Newton curvature."""
_BLOCKS = 64  # smallest number of blocks, in which scores are summed before they are correlated
_SHORTEST, _LONGEST = 8, 64  # samples in such a block
_MOST_BLOCKS = 200  # largest number of blocks; in long records blocks become longer


class Covariance(NamedTuple):
    """Uncertainty of the free parameters, when initial states are estimated, too.

    Attributes
    ----------
    white : (n_p, n_p) array
        Covariance for white residuals.
    robust : (n_p, n_p) array
        Covariance for coloured residuals.
    flatness : float
        Smallest ratio of the curvature of the cost to the Gauss-Newton curvature, over all directions. It is about one
        for white residuals, and NaN when it was not computed. Below `FLATTEST` the point is not a minimum, and the
        robust covariance uses the Gauss-Newton curvature.
    undetermined : (n_directions, n_p) array
        Unit directions, in parameters scaled by their curvature, that the data do not determine; usually empty.
    condition : float
        Condition number of the scaled information matrix.
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
    """Return the covariance of the parameters at an estimate.

    Parameters
    ----------
    problem : Shooting
        Shooting problem of the fit.
    theta : (n_p,) array
        Free parameters.
    starts : (n_windows, n) array
        Initial states of the windows.
    record_window : (n_records,) integer array
        First window of each record.
    error_products : (n_y, n_y) array
        Sum of the products of errors, ``sum e e'``.
    memory : int
        Number of samples over which residuals are correlated.
    held : (n_p,) boolean array
        Parameters on a bound; they count as known, and their rows are zero.
    initial_known : bool
        Whether initial states were given instead of estimated.
    coloured : bool
        Whether the robust covariance uses the exact Hessian of the cost, which needs a pass for each parameter.

    Returns
    -------
    Covariance
        Both covariances.

    Notes
    -----
    With the Hessian H of ``sum e' W e / 2`` by parameters and initial states, and the covariance J of its gradient
    ``sum psi' W e``, the estimates have the covariance ``H^-1 J H^-1`` (Ljung, System Identification,
    Secs. 9.2 to 9.4). White residuals do not depend on the past. Then the Gauss-Newton approximation
    ``H = sum psi' W psi`` is sufficient, and with the covariance Lambda of the residuals
    ``J = sum psi' W Lambda W psi``. For coloured
    residuals H also contains ``-sum psi_i' W d psi_j``, which is its largest part along the disturbance gain. The
    robust J sums the products of the gradients of neighbouring blocks, with weights that decrease to zero at a few
    times the correlation length of the residuals (Newey and West, 1987), and is corrected for the degrees of freedom
    of the fit. A prior adds its information to H, and to J as a measurement with its variance does.
    """
    n_p = problem.n_theta
    n_all = n_p + len(record_window) * problem.n_states
    weight = problem.weight(error_products)
    freedom = max(1.0, problem.n_samples - n_all / len(weight))
    block = min(max(problem.n_samples // _BLOCKS, _SHORTEST), _LONGEST)
    block = max(block, min(problem.n_samples // _MOST_BLOCKS, LONGEST_BLOCK))
    shaped = weight @ (error_products / freedom) @ weight
    if grows(problem, theta):
        found = information_by_windows(
            problem, block, theta, starts, record_window, weight, shaped, initial_known=initial_known
        )
    else:
        found = information_over_records(
            problem, block, theta, starts, record_window, weight, shaped=shaped, observed=coloured
        )

    # The weight is one over the total error, that of the likelihood one over its variance: they differ by this.
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
    # A direction of initial states alone does not concern the parameters.
    directions = directions[np.linalg.norm(directions, axis=1) > 1e-2]
    condition = float(eigenvalues[-1] / max(eigenvalues[0], np.finfo(float).tiny))
    return Covariance(white, over_parameters(J_robust, inverse), flatness, directions, condition)


def long_run(scores: list[FloatArray], lag: int) -> FloatArray:
    """Return the covariance of the sum of scores; products of blocks up to `lag` apart have decreasing weights."""
    n = scores[0].shape[1]
    total = np.zeros((n, n))
    for s in scores:
        total += s.T @ s
        for shift in range(1, min(lag, len(s) - 1) + 1):
            product = s[shift:].T @ s[:-shift]
            total += (1 - shift / (lag + 1)) * (product + product.T)
    return total


def share_left(lengths: list[int], lag: int) -> float:
    """Return the mean share of `long_run` that remains for scores whose sum is zero, as at an estimate.

    The lost share is that of the weights in all pairs of blocks (Kiefer and Vogelsang, 2005). The result is at least
    1/3.
    """
    counted = float(sum(lengths))
    for length in lengths:
        shifts = np.arange(1, min(lag, length - 1) + 1)
        counted += 2 * float(((1 - shifts / (lag + 1)) * (length - shifts)).sum())
    return max(1 - counted / sum(lengths) ** 2, 1 / 3)
