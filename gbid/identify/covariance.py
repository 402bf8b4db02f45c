"""Covariance of the estimates: for white residuals, and a robust one for coloured residuals."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from gbid.identify.blocks import cut
from gbid.identify.shooting import Part, Shooting
from gbid.identify.sweep import block_sums, joined, link, powers_of, start_hessians
from gbid.identify.whiteness import correlation_length

FloatArray = npt.NDArray[np.float64]
_UNDETERMINED = 1e-13  # eigenvalue of the scaled information below which a direction counts as not determined
_BLOCK = 64  # samples whose scores are summed before they are correlated


class Covariance(NamedTuple):
    """Uncertainty of the free parameters, initial states estimated along.

    Attributes
    ----------
    white : (n_p, n_p) array
        For white residuals.
    robust : (n_p, n_p) array
        For residuals of any colour.
    undetermined : (n_directions, n_p) array
        Unit directions, in parameters scaled by their curvature, that the data say nothing about; mostly empty.
    condition : float
        Condition of the scaled information.
    """

    white: FloatArray
    robust: FloatArray
    undetermined: FloatArray
    condition: float


class _Information(NamedTuple):
    hessian: FloatArray  # (n_all, n_all) over parameters and initial states
    scores: list[FloatArray]  # per record, (n_blocks, n_all): gradient of each block


def covariance(
    problem: Shooting,
    theta: FloatArray,
    starts: FloatArray,
    record_window: npt.NDArray[np.int64],
    error_products: FloatArray,
    errors: list[FloatArray],
    held: npt.NDArray[np.bool_],
    initial_known: bool,
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
    errors : list of (n_samples, n_y) array
        Residuals, for the length of their memory.
    held : (n_p,) boolean array
        Parameters on a bound: they count as known, and get zero rows.
    initial_known : bool
        Whether initial states were given instead of estimated.

    Returns
    -------
    Covariance

    Notes
    -----
    With ``H = sum psi' W psi`` over parameters and initial states, and J the covariance of the gradient
    ``sum psi' W e``, the estimates have the covariance ``H^-1 J H^-1`` (Ljung, System Identification,
    Secs. 9.2 to 9.4). For white residuals of covariance Lambda, ``J = sum psi' W Lambda W psi``. The robust J
    sums the products of the gradients of neighbouring blocks, with weights that fall to zero at a few times
    the residuals' memory (Newey and West, 1987).
    """
    n_p = problem.n_theta
    n_unknown = n_p + len(record_window) * problem.n_states
    weight = problem.weight(error_products)
    freedom = max(1.0, problem.n_samples - n_unknown / len(weight))
    pieces = _fine_parts(problem)
    windows = _piece_windows(problem)
    first = _information(problem, pieces, windows, theta, starts, record_window, weight)
    shaped = weight @ (error_products / freedom) @ weight
    second = _information(problem, pieces, windows, theta, starts, record_window, shaped)

    prior = np.zeros(len(first.hessian))
    prior[:n_p] = problem.prior.information * _precision(problem, error_products, weight)
    keep = np.concatenate([~held, np.full(len(first.hessian) - n_p, not initial_known)])
    H = (first.hessian + np.diag(prior))[np.ix_(keep, keep)]
    J_white = (second.hessian + np.diag(prior * prior / np.maximum(problem_prior(problem, len(prior)), 1e-300)))[
        np.ix_(keep, keep)
    ]
    lag = max(1, round(3 * correlation_length(errors) / _BLOCK))
    J_robust = _long_run([scores[:, keep] for scores in first.scores], lag)
    J_robust += np.diag(np.diag(J_white) - np.diag(second.hessian[np.ix_(keep, keep)]))

    scale = np.sqrt(np.maximum(np.diag(H), np.finfo(float).tiny))
    eigenvalues, vectors = np.linalg.eigh(H / np.outer(scale, scale))
    dark = eigenvalues < _UNDETERMINED * eigenvalues[-1]
    inverse = (vectors[:, ~dark] / eigenvalues[~dark]) @ vectors[:, ~dark].T / np.outer(scale, scale)
    n_kept = int((~held).sum())

    def over_parameters(J: FloatArray) -> FloatArray:
        result = np.zeros((n_p, n_p))
        result[np.ix_(~held, ~held)] = (inverse @ J @ inverse)[:n_kept, :n_kept]
        return result

    directions = np.zeros((int(dark.sum()), n_p))
    directions[:, ~held] = vectors[:n_kept, dark].T
    # A direction among initial states alone is no concern of the parameters.
    directions = directions[np.linalg.norm(directions, axis=1) > 1e-2]
    condition = float(eigenvalues[-1] / max(eigenvalues[0], np.finfo(float).tiny))
    return Covariance(over_parameters(J_white), over_parameters(J_robust), directions, condition)
