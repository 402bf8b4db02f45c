r"""Regression of the estimates of many recordings on terms over the scheduling variables (paper, Eqs. 16 to 18).

All k parameters are fitted at once, :math:`\theta_i = (I_k \otimes \varphi_i^T)\, c + b_i + e_i`. The terms
:math:`\varphi` are made orthogonal over the operating points. Afterwards the coefficients are converted back to the
units of the scheduling variables.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from gbid.arrays import BoolArray, FloatArray
from gbid.brief import Brief
from gbid.errors import UsageError
from gbid.lpv.surface_fit.estimates import Estimates, as_estimates
from gbid.lpv.surface_fit.mixed import generalised, sandwich, tempered_sandwich, with_scatter
from gbid.lpv.surface_fit.order import OrderScore, best_order, compare_orders, lack_of_fit
from gbid.lpv.surface_fit.outliers import CLIPPING_SLOPE, HUBER, Outlier, huber_estimate, outliers, standardised
from gbid.lpv.surface_fit.terms import (
    Order,
    Orthonormal,
    chosen_exponents,
    orthonormal,
    varying_exponents,
)
from gbid.notes.model_notes import SurfaceNote
from gbid.structure.scheduling.monomials import Exponents, term_name
from gbid.threads import one_blas_thread

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
        Powers of the scheduling variables in each term.
    coefficients : (k, m) array
        Coefficients in the units of the scheduling variables.
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
    return SurfaceRegression(
        estimates,
        exponents,
        solved.coefficients @ design.back.T,
        in_own_units(solved.covariance, design.back),
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
        own = C if weighting == "scatter" else None
        if weighting == "fits":
            raise UsageError("robust = True needs weighting = 'scatter' or 'ordinary'")
        found = huber_estimate(y, X, own)
        coefficients, S, clipped, cost = found.coefficients, found.scatter, found.clipped, found.cost
        V = V if own is None else C + S
    elif weighting == "scatter":
        mixed = with_scatter(y, X, C)
        coefficients, S, clipped, V = mixed.coefficients, mixed.scatter, y, C + mixed.scatter
        notes = (
            ()
            if mixed.settled
            else (SurfaceNote.NOT_SETTLED(f"the scatter had not settled after {mixed.steps} steps"),)
        )
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


def in_own_units(covariance: FloatArray, back: FloatArray) -> FloatArray:
    """Return a covariance of coefficients, converted from orthogonal terms to those in the units of the variables."""
    m = len(back)
    k = len(covariance) // m
    blocks = np.einsum("im,ambn,jn->aibj", back, covariance.reshape(k, m, k, m), back, optimize=True)
    return np.asarray(blocks.reshape(k * m, k * m))


def _with_covariance(estimates: Estimates) -> Estimates:
    """Return the estimates without fits that have no covariance; list these by name."""
    known = [bool(np.isfinite(own).all()) for own in estimates.covariance]
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
