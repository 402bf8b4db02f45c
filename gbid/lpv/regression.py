r"""Regression of estimates on polynomial terms: mixed-effects model, outliers, order, surfaces (paper, Eqs. 16 to 18).

All k parameters are fitted at once, :math:`\theta_i = (I_k \otimes \varphi_i^T)\, c + b_i + e_i`. The terms
:math:`\varphi` are made orthogonal over the operating points. Afterwards the coefficients are converted back to the
units of the scheduling variables.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Literal, NamedTuple

import numpy as np
import scipy

from gbid.core.arrays import BoolArray, FloatArray
from gbid.core.brief import Brief
from gbid.core.errors import DataError, UsageError
from gbid.core.hdf5 import Stored
from gbid.core.notes import SurfaceNote
from gbid.lpv.estimates import (
    HIGHEST_ORDER,
    Estimates,
    Order,
    Orthonormal,
    as_estimates,
    check_points,
    chosen_exponents,
    orthonormal,
    varying_exponents,
)
from gbid.structure import KEY_PARAMETERS
from gbid.structure.scheduling import EXPONENTS, SCHEDULING, Exponents

# Mixed-effects model: linear regression of vectors with known covariances and an unknown scatter between them.
#
# .. math:: y_i = X_i c + b_i + e_i, \quad b_i \sim (0, S), \quad e_i \sim (0, C_i)
#
# The parameters of the machine differ from one recording to the next, by far more than the covariance C_i of each
# estimate. S is the covariance of this scatter. It is estimated by restricted maximum likelihood (Patterson and
# Thompson, 1971). For known C_i the EM algorithm maximises the likelihood and keeps S positive semidefinite (Laird and
# Ware, 1982).

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
    """Return coefficients and scatter, by restricted maximum likelihood.

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
    same_point, distinct = group.ravel()[:, None] == np.arange(len(first)), X[first]
    change, step = np.inf, 0
    while change >= _TOLERANCE and step < _MOST:
        step += 1
        inverse = np.linalg.inv(C + S)
        coefficients, covariance = _by_point(y, distinct, same_point, inverse)
        residuals = y - X @ coefficients
        gain = S @ inverse
        b = np.einsum("ikl,il->ik", gain, residuals)
        surface = (distinct @ covariance @ distinct.transpose(0, 2, 1))[group.ravel()]
        rest = S - gain @ S + gain @ surface @ gain.transpose(0, 2, 1)
        following = (b.T @ b + rest.sum(axis=0)) / n
        change = float(np.abs(following - S).max())
        S = 0.5 * (following + following.T)
    coefficients, covariance = _by_point(y, distinct, same_point, np.linalg.inv(C + S))
    return MixedFit(coefficients, covariance, S * outer, step, change < _TOLERANCE)


def _by_point(
    y: FloatArray, distinct: FloatArray, same_point: BoolArray, inverse: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return generalised least-squares coefficients (m,) and their covariance, from sums over operating points."""
    weights = np.einsum("ip,ikl->pkl", same_point, inverse, optimize=True)
    targets = np.einsum("ip,ikl,il->pk", same_point, inverse, y, optimize=True)
    transposed = distinct.transpose(0, 2, 1)
    covariance = _inverse((transposed @ (weights @ distinct)).sum(axis=0))
    return covariance @ np.einsum("pmk,pk->m", transposed, targets), covariance


def rms_or_one(values: FloatArray) -> FloatArray:
    """Return the scale of each column of (n, k) values: the rms, or 1 where the rms is zero."""
    size = np.sqrt(np.mean(values**2, axis=0))
    return np.where(size > 0, size, 1.0)


def covariance_root(covariance: FloatArray) -> FloatArray:
    """Return a matrix R with R R' equal to a covariance, which may be singular and badly scaled."""
    size = np.sqrt(np.diag(covariance))
    scale = np.where(size > 0, size, 1.0)
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)) * scale[:, None])


def _positive(matrix: FloatArray) -> FloatArray:
    """Replace non-positive eigenvalues by small ones: EM cannot leave a singular start value."""
    values, vectors = np.linalg.eigh(matrix)
    return np.asarray((vectors * np.maximum(values, _LEAST)) @ vectors.T)


def _inverse(information: FloatArray) -> FloatArray:
    """Return the inverse of a positive definite matrix, scaled by its diagonal."""
    scale = 1 / np.sqrt(np.diag(information))
    return np.asarray(np.linalg.inv(information * np.outer(scale, scale)) * np.outer(scale, scale))


def sandwich(y: FloatArray, X: FloatArray, V: FloatArray, coefficients: FloatArray) -> FloatArray:
    """Return the robust covariance (m, m) of generalised least-squares coefficients, valid for a wrong V.

    The residuals replace the errors. They are enlarged for rows with large leverage (HC3: MacKinnon and White, 1985).
    """
    inverse, weighted, pull = _leverage(X, V)
    scores = _scores(y - X @ coefficients, pull, weighted) @ inverse
    return np.asarray(scores.T @ scores)


def tempered_sandwich(
    y: FloatArray, X: FloatArray, V: FloatArray, coefficients: FloatArray, factors: tuple[float, float] = (1.0, 1.0)
) -> tuple[FloatArray, BoolArray]:
    """Return the robust covariance of generalised least-squares coefficients for unequal scatter of rows.

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

    Returns
    -------
    covariance : (m, m) array
        Covariance of the coefficients.
    alone : (n,) boolean array
        Rows whose residual says nothing, because they alone are fitted.
    """
    inverse, weighted, pull = _leverage(X, V)
    leverage = np.einsum("ikk->i", pull) / y.shape[1]
    alone = np.linalg.eigvals(pull).real.max(axis=1) > _ALONE
    share = np.where(alone, 0.0, 1 / (1 + leverage))
    scores = _scores(y - X @ coefficients, np.where(alone[:, None, None], 0.0, pull), weighted) @ inverse
    from_residuals = (scores * share[:, None]).T @ scores
    from_model = inverse @ np.einsum("i,ikm,ikl->ml", 1 - share, X, weighted, optimize=True) @ inverse
    covariance = factors[0] * from_residuals + factors[1] * from_model
    return np.asarray(0.5 * (covariance + covariance.T)), np.asarray(alone)


def _leverage(X: FloatArray, V: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the inverse of the information (m, m), V^-1 X (n, k, m), and the leverages (n, k, k)."""
    weighted = np.asarray(np.linalg.solve(V, X), float)
    inverse = _inverse(np.einsum("ikm,ikl->ml", X, weighted, optimize=True))
    return inverse, weighted, X @ inverse @ weighted.transpose(0, 2, 1)


def _scores(residuals: FloatArray, pull: FloatArray, weighted: FloatArray) -> FloatArray:
    """Return the gradient of each row at its leave-one-out residual, (n, m)."""
    without = np.linalg.solve(np.eye(pull.shape[1]) - pull, residuals[:, :, None])
    return np.asarray((weighted.transpose(0, 2, 1) @ without)[:, :, 0])


# ---- Outliers from the surfaces: detection, and Huber's estimate, which gives them less weight.

_MAD = 1.4826  # standard deviation of a normal variable over its median absolute deviation
_LEAST_OUTLIERS = 3.5  # Iglewicz and Hoaglin, How to Detect and Handle Outliers (1993)
_FALSE_ALARM = 0.05  # probability of at least one outlier when all entries are normal
HUBER = 1.345  # standard deviations; 95 % efficient for normal errors (Huber, Robust Statistics, 1981)
CLIPPING_SLOPE = math.erf(HUBER / math.sqrt(2))  # mean slope of the clipping function
_DENSITY = math.exp(-(HUBER**2) / 2) / math.sqrt(2 * math.pi)  # density of a standard normal variable at HUBER
_VARIANCE = CLIPPING_SLOPE - 2 * HUBER * _DENSITY + HUBER**2 * (1 - CLIPPING_SLOPE)  # variance of a clipped one
_HUBER_ROUNDS, _HUBER_SETTLED = 30, 1e-2  # largest number of rounds; change that ends them, in standard deviations


@dataclass(frozen=True)
class Outlier:
    """Recording whose estimate of one parameter is far from the surface.

    Attributes
    ----------
    recording, parameter : str
        Names of the recording and of the parameter.
    deviation : float
        Estimate minus surface, SI per kg.
    standardised : float
        Deviation in robust standard deviations.
    """

    recording: str
    parameter: str
    deviation: Annotated[float, Stored("SI per kg", "estimate minus surface")]
    standardised: Annotated[float, Stored("1", "the same in robust standard deviations")]


def standardised(residuals: FloatArray, V: FloatArray) -> FloatArray:
    """Return residuals (n, k) divided by their standard deviations.

    `V` (n, k, k) gives the ratio of the standard deviations of the rows. The scale of each column comes from the
    median, so that an outlier that has enlarged `V` is still found.
    """
    z = residuals / np.sqrt(np.einsum("ikk->ik", V))
    return np.asarray(z / _scale(z))


def _scale(z: FloatArray) -> FloatArray:
    return np.maximum(_MAD * np.median(np.abs(z), axis=0), 1e-12)


def threshold(count: int) -> float:
    """Return the largest standardised residual that does not count as an outlier.

    It is 3.5, and larger for many entries, because some normal values then exceed 3.5 by chance.
    """
    return max(_LEAST_OUTLIERS, float(-scipy.special.ndtri(_FALSE_ALARM / (2 * count))))


def outliers(
    recordings: tuple[str, ...], residuals: FloatArray, z: FloatArray, parameters: tuple[str, ...] = KEY_PARAMETERS
) -> tuple[Outlier, ...]:
    """Return the entries of (n, k) arrays beyond the threshold, largest first."""
    limit = threshold(z.size)
    beyond = [
        Outlier(recordings[i], parameters[j], float(residuals[i, j]), float(z[i, j]))
        for i, j in zip(*np.nonzero(np.abs(z) > limit), strict=True)
    ]
    return tuple(sorted(beyond, key=lambda o: -abs(o.standardised)))


def huber_estimate(y: FloatArray, X: FloatArray, C: FloatArray | None) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return Huber's estimate, from residuals clipped at 1.345 standard deviations.

    Parameters
    ----------
    y : (n, k) array
        Observations.
    X : (n, k, m) array
        Regressors of each row.
    C : (n, k, k) array or None
        Covariance of the error of each row, to which scatter is added; None for rows of equal weight.

    Returns
    -------
    coefficients : (m,) array
        Coefficients.
    scatter : (k, k) array
        Scatter, corrected for the clipping.
    clipped : (n, k) array
        Data with clipped residuals.
    """
    n, k = y.shape
    S = np.zeros((k, k)) if C is None else with_scatter(y, X, C).scatter
    V = np.broadcast_to(np.eye(k), (n, k, k)) if C is None else C + S
    coefficients, clipped = generalised(y, X, V).coefficients, y
    for _ in range(_HUBER_ROUNDS):
        surface = X @ coefficients
        sigma = np.sqrt(np.einsum("ikk->ik", V))
        size = HUBER * sigma * _scale((y - surface) / sigma)
        inside = np.clip(y - surface, -size, size)
        clipped = surface + inside
        if C is not None:
            S = with_scatter(surface + inside / np.sqrt(_VARIANCE), X, C, start=S).scatter
            V = C + S
        fit = generalised(clipped, X, V)
        change = np.abs(fit.coefficients - coefficients) / np.sqrt(np.diag(fit.covariance))
        coefficients = fit.coefficients
        if change.max() < _HUBER_SETTLED:
            break
    return coefficients, S, clipped


# ---- Order of the surfaces: cross-validation over operating points, and lack-of-fit test.


@dataclass(frozen=True, eq=False)
class OrderScore(Brief):
    """Cross-validation score of polynomials of one order.

    Attributes
    ----------
    order : int
        Order of the polynomials.
    rms : (14,) array
        Root mean square of estimate minus prediction over all recordings, each predicted from the other operating
        points, SI per kg. nan when the operating points do not determine polynomials of this order.
    score : float
        Geometric mean of the rms over the parameters, relative to the lowest order; below one is better.
    why_not : str
        Reason why the order is not possible; otherwise empty.
    """

    order: Annotated[int, Stored("1", "orders compared")]
    rms: Annotated[FloatArray, Stored("SI per kg", "rms error of that prediction, orders by parameters", "k")]
    score: Annotated[float, Stored("1", "prediction of points left out, relative")]
    why_not: str = ""


def compare_orders(
    points: FloatArray, values: FloatArray, scheduling: Sequence[str] = SCHEDULING
) -> tuple[OrderScore, ...]:
    """Return the scores of the orders 0 to 3, by leave-one-operating-point-out cross-validation.

    Terms in a variable that is the same at all points are left out of each order.

    Parameters
    ----------
    points : (n, n_variables) array
        Operating points.
    values : (n, k) array
        Estimates.
    scheduling : sequence of str
        Names of the scheduling variables, for messages.

    Returns
    -------
    tuple of OrderScore
    """
    scores: list[OrderScore] = []
    lowest = np.nan
    for order in range(HIGHEST_ORDER + 1):
        try:
            rms = _left_out(points, values, varying_exponents(points, order), scheduling)
        except DataError as error:
            scores.append(OrderScore(order, np.full(values.shape[1], np.nan), np.nan, str(error)))
            continue
        level = float(np.mean(np.log(np.maximum(rms, 1e-300))))
        lowest = level if np.isnan(lowest) else lowest
        scores.append(OrderScore(order, rms, float(np.exp(level - lowest))))
    return tuple(scores)


def best_order(scores: tuple[OrderScore, ...]) -> int:
    """Return the order up to 2 with the best score; 0 where orders cannot be compared, as with one point."""
    possible = [s for s in scores if s.order <= 2 and np.isfinite(s.score)]
    return min(possible, key=lambda s: s.score).order if possible else 0


def choose_terms(estimates: Estimates, order: Order) -> tuple[Exponents, tuple[OrderScore, ...]]:
    """Return the terms of an order (for ``"auto"`` the order of the best score), and the scores of all orders."""
    scores = compare_orders(estimates.points, estimates.values, estimates.scheduling)
    if isinstance(order, str) and order == "auto":
        return varying_exponents(estimates.points, best_order(scores)), scores
    return chosen_exponents(order, estimates.scheduling), scores


def lack_of_fit(
    points: FloatArray, values: FloatArray, exponents: Exponents, scheduling: Sequence[str] = SCHEDULING
) -> FloatArray:
    """Return the p-value of the lack-of-fit test of the surfaces, (k,).

    This is the classical F test: the deviation of the means of the operating points from the surface is compared with
    the scatter of recordings at one point. It is nan without repeated recordings, or without more points than terms.
    """
    _, group = np.unique(points, axis=0, return_inverse=True)
    group = group.ravel()
    n_points, n = int(group.max()) + 1, len(points)
    if n == n_points or n_points == len(exponents):
        return np.full(values.shape[1], np.nan)
    counts = np.bincount(group)[:, None]
    means = np.stack([np.bincount(group, column) for column in values.T], axis=-1) / counts
    Q = orthonormal(points, exponents, scheduling).columns
    surface = Q @ np.linalg.lstsq(Q, values, rcond=None)[0]
    pure = ((values - means[group]) ** 2).sum(axis=0) / (n - n_points)
    missed = ((means[group] - surface) ** 2).sum(axis=0) / (n_points - len(exponents))
    ratio = np.divide(missed, pure, out=np.full(len(pure), np.inf), where=pure > 0)
    return np.asarray(scipy.special.fdtrc(n_points - len(exponents), n - n_points, ratio))


def _left_out(points: FloatArray, values: FloatArray, exponents: Exponents, scheduling: Sequence[str]) -> FloatArray:
    distinct, group = np.unique(points, axis=0, return_inverse=True)
    group = group.ravel()
    columns = orthonormal(points, exponents, scheduling).columns
    errors = np.empty_like(values)
    for i in range(len(distinct)):
        out = group == i
        check_points(points[~out], exponents, scheduling)
        coefficients = np.linalg.lstsq(columns[~out], values[~out], rcond=None)[0]
        errors[out] = values[out] - columns[out] @ coefficients
    return np.asarray(np.sqrt(np.mean(errors**2, axis=0)))


Weighting = Literal["scatter", "fits", "ordinary"]
_NAMED = 3  # recordings named in a note
_MISSED = 0.01  # significance level of the lack-of-fit test, divided by the number of parameters


@dataclass(frozen=True, eq=False)
class SurfaceEstimate:
    """Surfaces in orthogonal terms, with covariance, scatter and residuals."""

    coefficients: FloatArray  # (k, m)
    covariance: FloatArray  # (k m, k m)
    scatter: FloatArray  # (k, k)
    residuals: FloatArray  # (n, k)
    z: FloatArray  # (n, k)
    notes: tuple[str, ...]


def solve_surfaces(estimates: Estimates, design: Orthonormal, weighting: Weighting, robust: bool) -> SurfaceEstimate:
    """Return the surfaces of all parameters (each scaled by its rms) in orthogonal terms."""
    n, k = estimates.values.shape
    scale = rms_or_one(estimates.values)
    y = estimates.values / scale
    X = kron_designs(design.columns, k)
    C = estimates.covariance / np.outer(scale, scale)
    notes: tuple[str, ...] = ()
    S, clipped = np.zeros((k, k)), y
    V = np.broadcast_to(np.eye(k), (n, k, k)) if weighting == "ordinary" else C
    if robust:
        if weighting == "fits":
            raise UsageError("robust = True needs weighting = 'scatter' or 'ordinary'")
        coefficients, S, clipped = huber_estimate(y, X, C if weighting == "scatter" else None)
    elif weighting == "scatter":
        mixed = with_scatter(y, X, C)
        coefficients, S = mixed.coefficients, mixed.scatter
        if not mixed.settled:
            notes = (
                SurfaceNote.NOT_SETTLED(f"the estimate of the scatter did not converge within {mixed.steps} steps"),
            )
    else:
        coefficients = generalised(y, X, V).coefficients
    V, slope, variance = V + S, *((CLIPPING_SLOPE, _VARIANCE) if robust else (1.0, 1.0))
    if weighting == "scatter":
        covariance, alone = tempered_sandwich(clipped, X, V, coefficients, (1 / slope**2, variance / slope**2))
        notes = (*notes, *_unchecked(estimates, alone))
    else:
        covariance = sandwich(clipped, X, V, coefficients) / slope**2
    residuals = y - X @ coefficients
    wide = np.repeat(scale, design.columns.shape[1])
    return SurfaceEstimate(
        coefficients.reshape(k, -1) * scale[:, None],
        covariance * np.outer(wide, wide),
        S * np.outer(scale, scale),
        residuals * scale,
        standardised(residuals, V),
        notes,
    )


def kron_designs(columns: FloatArray, k: int) -> FloatArray:
    """Regressors ``I_k kron columns`` for k parameters, (n, k, k n_terms), from columns (n, n_terms)."""
    n, m = columns.shape
    X = np.zeros((n, k, k, m))
    X[:, np.arange(k), np.arange(k)] = columns[:, None]
    return X.reshape(n, k, k * m)


def in_terms(back: FloatArray, exponents: Exponents, terms: Exponents = EXPONENTS) -> FloatArray:
    """Return a matrix with rows for `exponents` rearranged to rows for `terms`; zero for unused terms."""
    rows = np.zeros((len(terms), back.shape[1]))
    rows[[terms.index(exponent) for exponent in exponents]] = back
    return rows


def in_units_of_terms(covariance: FloatArray, back: FloatArray) -> FloatArray:
    """Return the covariance of coefficients (k m, k m) after the change of terms ``back @ columns``."""
    n, m = back.shape
    k = len(covariance) // m
    blocks = np.einsum("im,ambn,jn->aibj", back, covariance.reshape(k, m, k, m), back, optimize=True)
    return np.asarray(blocks.reshape(k * n, k * n))


def with_covariance(estimates: Estimates) -> Estimates:
    """Return the estimates that have a covariance; the other fits are listed by name."""
    known = [bool(np.isfinite(covariance).all()) for covariance in estimates.covariance]
    if all(known):
        return estimates
    why = "no covariance for the weights (weighting = 'ordinary' needs none)"
    gone = tuple(f"{name}: {why}" for name, ok in zip(estimates.recordings, known, strict=True) if not ok)
    kept = estimates.rows([i for i, ok in enumerate(known) if ok])
    return as_estimates(replace(kept, left_out=(*estimates.left_out, *gone)))


def _unchecked(estimates: Estimates, alone: BoolArray) -> tuple[str, ...]:
    """Return a note on recordings that alone determine the surfaces at their operating points."""
    names = [name for name, is_alone in zip(estimates.recordings, alone, strict=True) if is_alone]
    if not names:
        return ()
    named = ", ".join(names[:_NAMED]) + (f" and {len(names) - _NAMED} more" if len(names) > _NAMED else "")
    return (
        SurfaceNote.SCATTER_UNSEEN(
            f"recordings that alone determine the surfaces at their operating point: {named}; "
            "no residual shows their scatter, so the standard deviations use the scatter of the other recordings"
        ),
    )


def surface_notes(estimates: Estimates, missed: FloatArray) -> tuple[str, ...]:
    """Return notes on left-out estimates, and on parameters with a lack of fit by p-values (k,)."""
    notes = [SurfaceNote.LEFT_OUT(f"left out: {entry}") for entry in estimates.left_out]
    names = estimates.parameters
    off = [key for key, p in zip(names, missed, strict=True) if p < _MISSED / len(names)]
    if off:
        notes.append(
            SurfaceNote.LACK_OF_FIT(
                f"the surfaces miss the means of operating points by more than recordings scatter: {', '.join(off)}; "
                "the standard deviations do not contain this lack of fit"
            )
        )
    return tuple(notes)
