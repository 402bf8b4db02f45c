r"""Regression of the estimates of many recordings on terms over the scheduling variables (paper, Eqs. 16 to 18).

All k parameters are fitted at once, :math:`\theta_i = (I_k \otimes \varphi_i^T)\, c + b_i + e_i`. The terms
:math:`\varphi` are made orthogonal over the operating points. Afterwards the coefficients are converted back to the
units of the scheduling variables.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Literal

import numpy as np
from scipy.special import fdtrc

from gbid.core.arrays import BoolArray, FloatArray, one_blas_thread
from gbid.core.brief import Brief
from gbid.core.errors import DataError, UsageError
from gbid.core.hdf5 import Stored
from gbid.core.notes import SurfaceNote
from gbid.lpv.estimates import (
    CLIPPING_SLOPE,
    HIGHEST_ORDER,
    HUBER,
    Estimates,
    Order,
    Orthonormal,
    Outlier,
    as_estimates,
    check_points,
    chosen_exponents,
    generalised,
    huber_estimate,
    orthonormal,
    outliers,
    sandwich,
    standardised,
    tempered_sandwich,
    varying_exponents,
    with_scatter,
)
from gbid.structure.scheduled import EXPONENTS, SCHEDULING, Exponents, term_name

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


def best_order(scores: tuple[OrderScore, ...], highest: int = 2) -> int:
    """Return the order with the best score, up to `highest`; 0 where no order can be compared, as with one point."""
    possible = [s for s in scores if s.order <= highest and np.isfinite(s.score)]
    return min(possible, key=lambda s: s.score).order if possible else 0


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
    return np.asarray(fdtrc(n_points - len(exponents), n - n_points, ratio))


def _left_out(points: FloatArray, values: FloatArray, exponents: Exponents, scheduling: Sequence[str]) -> FloatArray:
    distinct, group = np.unique(points, axis=0, return_inverse=True)
    group = group.ravel()
    check_points(points, exponents, scheduling)
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
class SurfaceRegression(Brief):
    """Surfaces through the estimates, k parameters with m terms each.

    Attributes
    ----------
    estimates : Estimates
        Estimates to which the surfaces were fitted.
    exponents : tuple of tuple of int, m
        Powers of the scheduling variables in each term; over pressure and speed the six terms of Eq. 16.
    coefficients : (k, m) array
        Coefficients in the units of the scheduling variables; zero for terms that were not used.
    covariance : (k m, k m) array
        Covariance of the coefficients.
    scatter : (k, k) array
        Covariance of the deviations of recordings from the surfaces.
    outliers, orders, lack_of_fit, options, notes
        As in `gbid.lpv.LPVFit`.
    """

    estimates: Estimates
    exponents: Exponents
    coefficients: FloatArray
    covariance: FloatArray
    scatter: FloatArray
    outliers: tuple[Outlier, ...]
    orders: tuple[OrderScore, ...]
    lack_of_fit: FloatArray
    options: dict[str, str]
    notes: tuple[str, ...]


def regression(estimates: Estimates, weighting: Weighting, order: Order, robust: bool) -> SurfaceRegression:
    """Return the surfaces through estimates; the options are those of `gbid.fit_lpv`.

    Raises
    ------
    UsageError
        When an option is unknown.
    DataError
        When the operating points do not determine the terms, or when no fit with a covariance remains.
    """
    if weighting not in ("scatter", "fits", "ordinary"):
        raise UsageError(f"weighting = {weighting!r}; choose 'scatter', 'fits' or 'ordinary'")
    if weighting != "ordinary":
        estimates = _with_covariance(estimates)
    scheduling = estimates.scheduling
    compared = compare_orders(estimates.points, estimates.values, scheduling)
    by_score = isinstance(order, str) and order == "auto"
    if by_score:
        exponents = varying_exponents(estimates.points, best_order(compared))
    else:
        exponents = chosen_exponents(order, scheduling)
    design = orthonormal(estimates.points, exponents, scheduling)
    with one_blas_thread():  # threads do not speed up small matrices
        solved = _solve(estimates, design, weighting, robust)
    missed = lack_of_fit(estimates.points, estimates.values, exponents, scheduling)
    terms = EXPONENTS if scheduling == SCHEDULING else exponents
    back = in_terms(design.back, exponents, terms)
    return SurfaceRegression(
        estimates,
        terms,
        solved.coefficients @ back.T,
        in_units_of_terms(solved.covariance, back),
        solved.scatter,
        outliers(estimates.recordings, solved.residuals, solved.z, estimates.parameters),
        compared,
        missed,
        {
            "method": "two-step",
            "weighting": weighting,
            "order": ", ".join(term_name(e, scheduling) for e in exponents),
            "chosen": "by cross-validation" if by_score else "given",
            "robust": f"Huber, {HUBER:g} standard deviations" if robust else "no",
        },
        (*solved.notes, *_notes(estimates, missed)),
    )


@dataclass(frozen=True, eq=False)
class _SurfaceEstimate:
    """Surfaces in orthogonal terms."""

    coefficients: FloatArray  # (k, m)
    covariance: FloatArray  # (k m, k m)
    scatter: FloatArray  # (k, k)
    residuals: FloatArray  # (n, k)
    z: FloatArray  # (n, k)
    notes: tuple[str, ...]


def _solve(estimates: Estimates, design: Orthonormal, weighting: Weighting, robust: bool) -> _SurfaceEstimate:
    """Fit all parameters, each scaled by its rms value."""
    n, k = estimates.values.shape
    scale = np.sqrt(np.mean(estimates.values**2, axis=0))
    scale = np.where(scale > 0, scale, 1.0)
    y = estimates.values / scale
    X = kron_designs(design.columns, k)
    C = estimates.covariance / np.outer(scale, scale)
    notes: tuple[str, ...] = ()
    S, cost = np.zeros((k, k)), 1.0
    V = np.broadcast_to(np.eye(k), (n, k, k)) if weighting == "ordinary" else C
    if robust:
        if weighting == "fits":
            raise UsageError("robust = True needs weighting = 'scatter' or 'ordinary'")
        huber = huber_estimate(y, X, C if weighting == "scatter" else None)
        coefficients, S, clipped, cost = huber.coefficients, huber.scatter, huber.clipped, huber.cost
        V = C + S if weighting == "scatter" else V
    elif weighting == "scatter":
        mixed = with_scatter(y, X, C)
        coefficients, S, clipped, V = mixed.coefficients, mixed.scatter, y, C + mixed.scatter
        if not mixed.settled:
            notes = (SurfaceNote.NOT_SETTLED(f"the scatter had not settled after {mixed.steps} steps"),)
    else:
        coefficients, clipped = generalised(y, X, V).coefficients, y
    if weighting == "scatter":
        factors = (1 / CLIPPING_SLOPE**2, cost) if robust else (1.0, 1.0)
        covariance, alone = tempered_sandwich(clipped, X, V, coefficients, factors)
        notes = (*notes, *_unchecked(estimates, alone))
    else:
        covariance = sandwich(clipped, X, V, coefficients) / (CLIPPING_SLOPE**2 if robust else 1.0)
    residuals = y - X @ coefficients
    wide = np.repeat(scale, design.columns.shape[1])
    return _SurfaceEstimate(
        coefficients.reshape(k, -1) * scale[:, None],
        covariance * np.outer(wide, wide),
        S * np.outer(scale, scale),
        residuals * scale,
        standardised(residuals, V),
        notes,
    )


def kron_designs(columns: FloatArray, k: int) -> FloatArray:
    """Return the regressors of k parameters with the same terms: (n, n_terms) to (n, k, k n_terms)."""
    n, m = columns.shape
    X = np.zeros((n, k, k, m))
    X[:, np.arange(k), np.arange(k)] = columns[:, None]
    return X.reshape(n, k, k * m)


def in_terms(back: FloatArray, exponents: Exponents, terms: Exponents = EXPONENTS) -> FloatArray:
    """Return a matrix with a row for each of `exponents` as one with a row for each of `terms`, zero where not used."""
    rows = np.zeros((len(terms), back.shape[1]))
    rows[[terms.index(exponent) for exponent in exponents]] = back
    return rows


def in_units_of_terms(covariance: FloatArray, back: FloatArray) -> FloatArray:
    """Return a covariance of coefficients (k m, k m), converted from m columns to the terms ``back @ columns``."""
    n, m = back.shape
    k = len(covariance) // m
    blocks = np.einsum("im,ambn,jn->aibj", back, covariance.reshape(k, m, k, m), back, optimize=True)
    return np.asarray(blocks.reshape(k * n, k * n))


def _with_covariance(estimates: Estimates) -> Estimates:
    """Return the estimates without fits that have no covariance; list these by name."""
    known = [bool(np.isfinite(covariance).all()) for covariance in estimates.covariance]
    if all(known):
        return estimates
    why = "no covariance for the weights (weighting = 'ordinary' needs none)"
    gone = tuple(f"{name}: {why}" for name, ok in zip(estimates.recordings, known, strict=True) if not ok)
    kept = estimates.rows([i for i, ok in enumerate(known) if ok])
    return as_estimates(replace(kept, left_out=(*estimates.left_out, *gone)))


def _unchecked(estimates: Estimates, alone: BoolArray) -> tuple[str, ...]:
    """Return a note on the recordings that alone determine the surfaces at their operating point."""
    names = [name for name, one in zip(estimates.recordings, alone, strict=True) if one]
    if not names:
        return ()
    named = ", ".join(names[:_NAMED]) + (f" and {len(names) - _NAMED} more" if len(names) > _NAMED else "")
    return (
        SurfaceNote.SCATTER_UNSEEN(
            f"recordings that alone determine the surfaces at their operating point: {named}; "
            "no residual shows how they scatter, and the standard deviations take the scatter of the others"
        ),
    )


def _notes(estimates: Estimates, missed: FloatArray) -> tuple[str, ...]:
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
