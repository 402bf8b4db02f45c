r"""Linear regression of vectors with known covariances and an unknown scatter between them (mixed-effects model).

.. math:: y_i = X_i c + b_i + e_i, \quad b_i \sim (0, S), \quad e_i \sim (0, C_i)

The parameters of the machine differ from one recording to the next, by far more than the covariance C_i of each
estimate. S is the covariance of this scatter. It is estimated by restricted maximum likelihood (Patterson and Thompson,
1971). For known C_i the EM algorithm maximises the likelihood and keeps S positive semidefinite (Laird and Ware, 1982).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gbid.arrays import BoolArray, FloatArray

_TOLERANCE = 1e-4  # change of S in one step, relative to the variance of the residuals
_LEAST = 1e-3  # smallest eigenvalue of the start value of S, in the same units
_MOST = 500  # largest number of steps
_ALONE = 0.99  # leverage from which a row is fitted by its own: less than a tenth of its error is in its residual


class MixedFit(NamedTuple):
    """Coefficients and scatter of a mixed-effects model.

    Attributes
    ----------
    coefficients : (m,) array
        Coefficients c.
    covariance : (m, m) array
        Covariance of the coefficients, ``(sum X_i' V_i^-1 X_i)^-1`` with ``V_i = C_i + S``.
    scatter : (k, k) array
        S.
    steps : int
        Number of EM steps.
    settled : bool
        Whether S has converged.
    """

    coefficients: FloatArray
    covariance: FloatArray
    scatter: FloatArray
    steps: int
    settled: bool


class Weighted(NamedTuple):
    """Generalised least-squares solution for given V: coefficients (m,), covariance (m, m), residuals (n, k)."""

    coefficients: FloatArray
    covariance: FloatArray
    residuals: FloatArray


def generalised(y: FloatArray, X: FloatArray, V: FloatArray) -> Weighted:
    """Return the generalised least-squares solution.

    Parameters
    ----------
    y : (n, k) array
        Observations.
    X : (n, k, m) array
        Regressors of each row.
    V : (n, k, k) array
        Covariance of each row of y; rows are independent.
    """
    weighted = np.linalg.solve(V, X)  # V^-1 X
    information = np.einsum("ikm,ikl->ml", X, weighted, optimize=True)
    covariance = _inverse(information)
    coefficients = covariance @ np.einsum("ikm,ik->m", weighted, y, optimize=True)
    return Weighted(coefficients, covariance, y - X @ coefficients)


def with_scatter(y: FloatArray, X: FloatArray, C: FloatArray, start: FloatArray | None = None) -> MixedFit:
    """Return the coefficients and the scatter by restricted maximum likelihood.

    Parameters
    ----------
    y : (n, k) array
        Observations, scaled to the order of one.
    X : (n, k, m) array
        Regressors of each row.
    C : (n, k, k) array
        Covariance of the error of each row.
    start : (k, k) array, optional
        Start value of the scatter; by default from moments.

    Returns
    -------
    MixedFit
    """
    n, k = y.shape
    residuals = generalised(y, X, np.broadcast_to(np.eye(k), C.shape)).residuals
    freedom = max(1.0, n - X.shape[2] / k)
    size = np.sqrt(np.mean(residuals**2, axis=0) * n / freedom)
    size = np.where(size > 0, size, 1.0)  # EM works on scaled data with residuals of size one
    outer = np.outer(size, size)
    y, X, C = y / size, X / size[:, None], C / outer
    spread = residuals.T @ residuals / freedom / outer
    S = _positive(spread - C.mean(axis=0)) if start is None else start / outer
    # Recordings of one operating point have equal rows of X, so sums over points need fewer operations.
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
    """Return coefficients (m,) and their covariance by generalised least squares, with sums over operating points."""
    weights = np.einsum("ip,ikl->pkl", alike, inverse, optimize=True)
    targets = np.einsum("ip,ikl,il->pk", alike, inverse, y, optimize=True)
    transposed = distinct.transpose(0, 2, 1)
    covariance = _inverse((transposed @ (weights @ distinct)).sum(axis=0))
    return covariance @ np.einsum("pmk,pk->m", transposed, targets), covariance


def _positive(matrix: FloatArray) -> FloatArray:
    """Replace eigenvalues that are not positive by small ones, because EM cannot leave a singular start value."""
    values, vectors = np.linalg.eigh(matrix)
    return np.asarray((vectors * np.maximum(values, _LEAST)) @ vectors.T)


def _inverse(information: FloatArray) -> FloatArray:
    """Return the inverse of a positive definite matrix, computed with scaling."""
    scale = 1 / np.sqrt(np.diag(information))
    return np.asarray(np.linalg.inv(information * np.outer(scale, scale)) * np.outer(scale, scale))


def sandwich(y: FloatArray, X: FloatArray, V: FloatArray, coefficients: FloatArray) -> FloatArray:
    """Return the covariance of generalised least-squares coefficients without the assumption that V is right, (m, m).

    The residuals replace the errors. They are enlarged for rows with large leverage (HC3: MacKinnon and White, 1985).
    """
    inverse, weighted, pull = _leverage(X, V)
    scores = _scores(y - X @ coefficients, pull, weighted) @ inverse
    return np.asarray(scores.T @ scores)


class LocalCovariance(NamedTuple):
    """Covariance of coefficients (m, m), and rows whose residual says nothing, because they alone are fitted (n,)."""

    covariance: FloatArray
    alone: BoolArray


def tempered_sandwich(
    y: FloatArray, X: FloatArray, V: FloatArray, coefficients: FloatArray, factors: tuple[float, float] = (1.0, 1.0)
) -> LocalCovariance:
    """Return the covariance of generalised least-squares coefficients, where rows may scatter unequally.

    The sandwich of `sandwich` takes the covariance of each row from its own residual. Where few rows determine a value
    of the surface, that is a mean over few squares. So the covariance of row i is a weighted mean of the two,
    ``(e_i e_i' + h_i V_i) / (1 + h_i)``, with the residual e_i of HC3 and the leverage h_i of the row, which is one
    over the number of rows that determine its value. V_i counts as one more row beside these. A row that is fitted
    exactly has no residual; there V_i alone is taken.

    Parameters
    ----------
    y, X, V : arrays
        As in `generalised`.
    coefficients : (m,) array
        Its solution.
    factors : (float, float)
        Factors on the covariance from residuals and on that from V, for data that are clipped.
    """
    inverse, weighted, pull = _leverage(X, V)
    leverage = np.einsum("ikk->i", pull) / y.shape[1]
    alone = np.linalg.eigvals(pull).real.max(axis=1) > _ALONE
    share = np.where(alone, 0.0, 1 / (1 + leverage))
    scores = _scores(y - X @ coefficients, np.where(alone[:, None, None], 0.0, pull), weighted) @ inverse
    from_residuals = (scores * share[:, None]).T @ scores
    from_model = inverse @ np.einsum("i,ikm,ikl->ml", 1 - share, X, weighted, optimize=True) @ inverse
    covariance = factors[0] * from_residuals + factors[1] * from_model
    return LocalCovariance(0.5 * (covariance + covariance.T), alone)


def _leverage(X: FloatArray, V: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the inverse of the information (m, m), V^-1 X (n, k, m), and the leverages (n, k, k)."""
    weighted = np.asarray(np.linalg.solve(V, X), float)
    inverse = _inverse(np.einsum("ikm,ikl->ml", X, weighted, optimize=True))
    return inverse, weighted, X @ inverse @ weighted.transpose(0, 2, 1)


def _scores(residuals: FloatArray, pull: FloatArray, weighted: FloatArray) -> FloatArray:
    """Return the gradient of each row at its residual as if the row had not been fitted, (n, m)."""
    without = np.linalg.solve(np.eye(pull.shape[1]) - pull, residuals[:, :, None])
    return np.asarray((weighted.transpose(0, 2, 1) @ without)[:, :, 0])
