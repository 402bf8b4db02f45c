r"""Linear regression of vectors with known covariances and an unknown scatter between them.

.. math:: y_i = X_i c + b_i + e_i, \quad b_i \sim (0, S), \quad e_i \sim (0, C_i)

The estimates of a recording's parameters scatter from one recording to the next by far more than their own
covariance C_i says, because the machine is not the same twice. S is estimated by restricted maximum likelihood
(Patterson and Thompson, 1971), which for known C_i the EM algorithm climbs without leaving the positive
semidefinite matrices (Laird and Ware, 1982).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gbid.arrays import BoolArray, FloatArray

_TOLERANCE = 1e-4  # change of S in one step, relative to the residuals' variance
_LEAST = 1e-3  # the smallest eigenvalue of S to start from, in the same units
_MOST = 500  # steps


class MixedFit(NamedTuple):
    """Coefficients and scatter.

    Attributes
    ----------
    coefficients : (m,) array
    covariance : (m, m) array
        Of the coefficients, ``(sum X_i' V_i^-1 X_i)^-1`` with ``V_i = C_i + S``.
    scatter : (k, k) array
        S.
    steps : int
        EM steps taken.
    settled : bool
        Whether S had settled after them.
    """

    coefficients: FloatArray
    covariance: FloatArray
    scatter: FloatArray
    steps: int
    settled: bool


class Weighted(NamedTuple):
    """Generalised least squares for given V: coefficients (m,), covariance (m, m), residuals (n, k)."""

    coefficients: FloatArray
    covariance: FloatArray
    residuals: FloatArray


def generalised(y: FloatArray, X: FloatArray, V: FloatArray) -> Weighted:
    """Generalised least squares.

    Parameters
    ----------
    y : (n, k) array
    X : (n, k, m) array
    V : (n, k, k) array
        Covariance of each row of y; rows are independent.
    """
    weighted = np.linalg.solve(V, X)  # V^-1 X
    information = np.einsum("ikm,ikl->ml", X, weighted, optimize=True)
    covariance = _inverse(information)
    coefficients = covariance @ np.einsum("ikm,ik->m", weighted, y, optimize=True)
    return Weighted(coefficients, covariance, y - X @ coefficients)


def with_scatter(y: FloatArray, X: FloatArray, C: FloatArray, start: FloatArray | None = None) -> MixedFit:
    """Estimate coefficients and scatter.

    Parameters
    ----------
    y : (n, k) array
        Of the order of one.
    X : (n, k, m) array
    C : (n, k, k) array
        Covariance of each row's own error.
    start : (k, k) array, optional
        Scatter to start from; by moments when not given.

    Returns
    -------
    MixedFit
    """
    n, k = y.shape
    residuals = generalised(y, X, np.broadcast_to(np.eye(k), C.shape)).residuals
    freedom = max(1.0, n - X.shape[2] / k)
    size = np.sqrt(np.mean(residuals**2, axis=0) * n / freedom)
    size = np.where(size > 0, size, 1.0)  # EM runs in units in which every parameter's residuals are one
    outer = np.outer(size, size)
    y, X, C = y / size, X / size[:, None], C / outer
    spread = residuals.T @ residuals / freedom / outer
    S = _positive(spread - C.mean(axis=0)) if start is None else start / outer
    # Recordings of one operating point share their row of X: sums over points are cheaper than over recordings.
    _, first, group = np.unique(X.reshape(n, -1), axis=0, return_index=True, return_inverse=True)
    alike, distinct = group.ravel()[:, None] == np.arange(len(first)), X[first]
    change, step = np.inf, 0
    while change >= _TOLERANCE and step < _MOST:
        step += 1
        inverse = np.linalg.inv(C + S)
        coefficients, covariance = _by_point(y, distinct, alike, inverse)
        residuals = y - X @ coefficients
        gain = S @ inverse
        b = np.einsum("ikl,il->ik", gain, residuals)
        surface = (distinct @ covariance @ distinct.transpose(0, 2, 1))[group.ravel()]
        rest = S - gain @ S + gain @ surface @ gain.transpose(0, 2, 1)
        following = (b.T @ b + rest.sum(axis=0)) / n
        change = float(np.abs(following - S).max())
        S = 0.5 * (following + following.T)
    coefficients, covariance = _by_point(y, distinct, alike, np.linalg.inv(C + S))
    return MixedFit(coefficients, covariance, S * outer, step, change < _TOLERANCE)


def _by_point(
    y: FloatArray, distinct: FloatArray, alike: BoolArray, inverse: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Generalised least squares from sums over operating points: coefficients (m,) and their covariance."""
    weights = np.einsum("ip,ikl->pkl", alike, inverse, optimize=True)
    targets = np.einsum("ip,ikl,il->pk", alike, inverse, y, optimize=True)
    transposed = distinct.transpose(0, 2, 1)
    covariance = _inverse((transposed @ (weights @ distinct)).sum(axis=0))
    return covariance @ np.einsum("pmk,pk->m", transposed, targets), covariance


def _positive(matrix: FloatArray) -> FloatArray:
    """Replace eigenvalues that are not positive by small ones: EM cannot leave a singular start."""
    values, vectors = np.linalg.eigh(matrix)
    return np.asarray((vectors * np.maximum(values, _LEAST)) @ vectors.T)


def _inverse(information: FloatArray) -> FloatArray:
    """Inverse of a positive definite matrix, scaled first."""
    scale = 1 / np.sqrt(np.diag(information))
    return np.asarray(np.linalg.inv(information * np.outer(scale, scale)) * np.outer(scale, scale))


def sandwich(y: FloatArray, X: FloatArray, V: FloatArray, coefficients: FloatArray) -> FloatArray:
    """Covariance of generalised least-squares coefficients that does not believe V, (m, m).

    Residuals take the place of the errors, made larger where a row pulls the fit to itself (HC3: MacKinnon and
    White, 1985).
    """
    weighted = np.linalg.solve(V, X)
    inverse = _inverse(np.einsum("ikm,ikl->ml", X, weighted, optimize=True))
    pull = X @ inverse @ weighted.transpose(0, 2, 1)
    own = np.eye(y.shape[1]) - pull
    residuals = np.linalg.solve(own, (y - X @ coefficients)[:, :, None])
    scores = (weighted.transpose(0, 2, 1) @ residuals)[:, :, 0] @ inverse
    return np.asarray(scores.T @ scores)
