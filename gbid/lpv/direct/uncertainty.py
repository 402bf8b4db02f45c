r"""Uncertainty of directly estimated surfaces.

At the estimate, record i alone would change its parameters by about one Gauss-Newton step,
:math:`\delta_i = H_i^{-1} g_i` with its score :math:`g_i` and information :math:`H_i` (its disturbance gain and initial
state eliminated). So :math:`\theta_i + \delta_i` is its own estimate, with covariance
:math:`C_i = H_i^{-1} J_i H_i^{-1}`, without a separate fit. The scatter S between recordings follows from these as it
does from fits of single recordings. The coefficients are the mean of these estimates with the weights :math:`H_i`,
so that their covariance is

.. math::
    A^{-1} \Bigl[\sum_i X_i^T (J_i + H_i S H_i) X_i\Bigr] A^{-1}, \qquad A = \sum_i X_i^T H_i X_i .
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gbid.arrays import FloatArray
from gbid.identify.uncertainty.information import RecordInformation
from gbid.lpv.surface_fit.mixed import with_scatter

_WEAK = 1e-9  # largest scaled eigenvalue of a record's information in a direction that it does not determine


class CoefficientUncertainty(NamedTuple):
    """Uncertainty of directly estimated coefficients, in the units of the parameters.

    Attributes
    ----------
    covariance : (m, m) array
        Covariance of the coefficients.
    scatter : (k, k) array
        Covariance of the deviations between recordings.
    own : (n, k) array
        Parameters that each recording alone would give.
    own_covariance : (n, k, k) array
        Covariance of these parameters.
    refined : (m,) array
        Coefficients with weights from scatter and own covariance.
    refined_covariance : (m, m) array
        Covariance of the refined coefficients.
    settled : bool
        Whether the scatter converged.
    """

    covariance: FloatArray
    scatter: FloatArray
    own: FloatArray
    own_covariance: FloatArray
    refined: FloatArray
    refined_covariance: FloatArray
    settled: bool


def uncertainty(X: FloatArray, values: FloatArray, information: list[RecordInformation]) -> CoefficientUncertainty:
    """Return the scatter and the covariance of the coefficients.

    Parameters
    ----------
    X : (n, k, m) array
        Matrix from coefficients to parameters of each record.
    values : (n, k) array
        Parameters of each record at the estimate.
    information : list of RecordInformation, n
        Information on the k parameters, all other unknowns eliminated.

    Returns
    -------
    CoefficientUncertainty
        Scatter and covariances.
    """
    scale = np.sqrt(np.mean(values**2, axis=0))
    scale = np.where(scale > 0, scale, 1.0)
    H = np.array([i.hessian for i in information]) * np.outer(scale, scale)
    g = np.array([i.scores.sum(axis=0) for i in information]) * scale
    J = np.array([_long_run(i.scores, _lag(len(i.scores))) for i in information]) * np.outer(scale, scale)
    inverse = np.array([_inverse(h) for h in H])
    step = np.einsum("ikl,il->ik", inverse, g)
    C = inverse @ _smoothed(H, J) @ inverse
    scaled = X / scale[:, None]
    y = values / scale + step
    mixed = with_scatter(y, scaled, C)
    A = np.einsum("ikm,ikl,iln->mn", scaled, H, scaled, optimize=True)
    middle = np.einsum("ikm,ikl,iln->mn", scaled, J + H @ mixed.scatter @ H, scaled, optimize=True)
    onto = _inverse(A)
    outer = np.outer(scale, scale)
    return CoefficientUncertainty(
        onto @ middle @ onto,
        mixed.scatter * outer,
        y * scale,
        C * outer,
        mixed.coefficients,
        mixed.covariance,
        mixed.settled,
    )


def _smoothed(H: FloatArray, J: FloatArray) -> FloatArray:
    """Return covariances of scores, smoothed over the records.

    One record alone determines the k x k entries of its J poorly, and weights that depend on its errors bias a mean. In
    coordinates in which its H is one, J is the power of the residuals times a matrix of their colour, which all records
    share.
    """
    size = np.sqrt(np.einsum("ikk->ik", H))
    k = size.shape[1]
    factors = []
    for h, s in zip(H, size, strict=True):
        values, vectors = np.linalg.eigh(h / np.outer(s, s))
        factors.append((vectors * np.sqrt(np.maximum(values, _WEAK * values[-1]))) @ vectors.T * s[:, None])
    L = np.array(factors)  # the symmetric root, scaled: near for records that are alike
    white = np.linalg.solve(L, np.linalg.solve(L, J).transpose(0, 2, 1))
    power = np.einsum("ikk->i", white) / k
    shape = np.mean(white / np.maximum(power, 1e-300)[:, None, None], axis=0)
    return np.asarray(power[:, None, None] * (L @ shape @ L.transpose(0, 2, 1)))


def _long_run(scores: FloatArray, lag: int) -> FloatArray:
    """Return the covariance of the sum of scores (Newey and West, 1987), (n_blocks, k)."""
    total = scores.T @ scores
    for shift in range(1, min(lag, len(scores) - 1) + 1):
        product = scores[shift:].T @ scores[:-shift]
        total += (1 - shift / (lag + 1)) * (product + product.T)
    return np.asarray(total)


def _lag(n_blocks: int) -> int:
    """Return the correlation length of residuals in blocks: a few, because blocks are long; fewer in short records."""
    return min(2, n_blocks - 1)


def _inverse(matrix: FloatArray) -> FloatArray:
    """Return the inverse of an information matrix; directions with almost no information get almost zero."""
    size = 1 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    values, vectors = np.linalg.eigh(matrix * np.outer(size, size))
    values = np.maximum(values, _WEAK * values[-1])
    return np.asarray((vectors / values) @ vectors.T * np.outer(size, size))
