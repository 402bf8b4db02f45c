r"""Surfaces fitted to the estimates of a campaign (paper, Eqs. 16 to 18).

All fourteen parameters are fitted at once, :math:`\theta_i = (I_{14} \otimes \varphi(P_i, \Omega_i)^T)\, c + b_i +
e_i`. The terms :math:`\varphi` are made orthogonal over the operating points. Afterwards the coefficients are
converted back to terms in bar and rpm.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from gbid.arrays import FloatArray
from gbid.errors import UsageError
from gbid.identify.result import FitResult
from gbid.identify.table.fit_table import FitTable
from gbid.lpv.basis import EXPONENTS, TERMS
from gbid.lpv.domain import Domain
from gbid.lpv.model import LPVModel
from gbid.lpv.surface_fit.estimates import Estimates, as_estimates
from gbid.lpv.surface_fit.lpv_fit import LPVFit
from gbid.lpv.surface_fit.mixed import generalised, sandwich, with_scatter
from gbid.lpv.surface_fit.order import best_order, compare_orders, lack_of_fit
from gbid.lpv.surface_fit.outliers import CLIPPING_SLOPE, HUBER, huber_estimate, outliers, standardised
from gbid.lpv.surface_fit.terms import Exponents, Orthonormal, chosen_exponents, distinct_points, orthonormal, term_name
from gbid.operating_point import point_label
from gbid.structure import KEY_PARAMETERS
from gbid.threads import one_blas_thread

Weighting = Literal["scatter", "fits", "ordinary"]
Order = int | Literal["auto"] | Sequence[str]
_MISSED = 0.01  # significance level of the lack-of-fit test, divided by the number of parameters


def fit_lpv(
    fits: FitTable | Sequence[FitResult] | Estimates,
    points: Sequence[tuple[float, float]] | None = None,
    *,
    weighting: Weighting = "scatter",
    order: Order = 2,
    robust: bool = False,
    actuators: Mapping[str, float] | None = None,
    pade_order: int = 1,
    name: str = "lpv",
    title: str = "",
    source: str = "",
) -> LPVFit:
    """Return surfaces over pressure and speed, fitted to the key parameters of many fits.

    Parameters
    ----------
    fits : FitTable or sequence of FitResult
        One row or result for each recording, with all fourteen key parameters. Fits that did not converge or are not
        finite are left out and listed.
    points : sequence of (pressure_bar, speed_rpm), optional
        Operating points of fit results; a table contains them.
    weighting : {"scatter", "fits", "ordinary"}
        ``"scatter"``: generalised least squares of all parameters together. The weights come from the covariance of
        each fit plus the scatter between recordings, which is estimated by restricted maximum likelihood. ``"fits"``:
        the same with the covariance of each fit alone. ``"ordinary"``: ordinary least squares. The covariance of the
        coefficients is model-based for the first and a robust estimate from the residuals (HC3) for the others.
    order : 0, 1, 2, "auto" or sequence of str
        Order of the polynomials. ``"auto"`` chooses it by cross-validation over operating points. A sequence names
        terms of `gbid.lpv.TERMS`.
    robust : bool
        Whether estimates far from a surface get less weight (Huber).
    actuators : dict of str to float, optional
        Actuator parameters to store in the model.
    pade_order : int
        Order of the delays of the model, equal to that of the fitted structure.
    name, title, source : str
        Texts for the model.

    Returns
    -------
    LPVFit
        Its model is valid in the rectangle that contains the operating points.

    Raises
    ------
    UsageError
        When an option is unknown, or when parameters or operating points are missing.
    DataError
        When there are too few operating points for the order, when they do not determine its terms, when no fit
        remains, or when a fit has no covariance for the weights.
    """
    if weighting not in ("scatter", "fits", "ordinary"):
        raise UsageError(f"weighting = {weighting!r}; choose 'scatter', 'fits' or 'ordinary'")
    estimates = as_estimates(fits, points)
    if weighting != "ordinary":
        estimates = _with_covariance(estimates)
    compared = compare_orders(estimates.points, estimates.values)
    exponents = chosen_exponents(best_order(compared) if isinstance(order, str) and order == "auto" else order)
    design = orthonormal(estimates.points, exponents)
    with one_blas_thread():  # threads do not speed up small matrices
        solved = _solve(estimates, design, weighting, robust)
    coefficients = np.zeros((len(KEY_PARAMETERS), len(TERMS)))
    coefficients[:, _places(exponents)] = solved.coefficients @ design.back.T
    missed = lack_of_fit(estimates.points, estimates.values, exponents)
    model = LPVModel(
        name,
        {key: tuple(row) for key, row in zip(KEY_PARAMETERS, coefficients.tolist(), strict=True)},
        rectangle(estimates.points),
        actuators=actuators or {},
        pade_order=pade_order,
        operating_points=tuple((float(p), float(w)) for p, w in distinct_points(estimates.points)),
        title=title,
        source=source,
    )
    return LPVFit(
        model,
        in_own_units(solved.covariance, design.back, exponents),
        solved.scatter,
        estimates,
        outliers(estimates.recordings, solved.residuals, solved.z),
        compared,
        missed,
        {
            "method": "two-step",
            "weighting": weighting,
            "order": ", ".join(term_name(e) for e in exponents),
            "chosen": "by cross-validation" if isinstance(order, str) and order == "auto" else "given",
            "robust": f"Huber, {HUBER:g} standard deviations" if robust else "no",
        },
        notes=(*solved.notes, *_notes(estimates, missed), *_impossible(model)),
    )


@dataclass(frozen=True, eq=False)
class _SurfaceEstimate:
    """Surfaces in orthogonal terms."""

    coefficients: FloatArray  # (14, n_terms)
    covariance: FloatArray  # (14 n_terms, 14 n_terms)
    scatter: FloatArray  # (14, 14)
    residuals: FloatArray  # (n, 14)
    z: FloatArray  # (n, 14)
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
        notes = () if mixed.settled else (f"the scatter had not settled after {mixed.steps} steps",)
    else:
        coefficients, clipped = generalised(y, X, V).coefficients, y
    if weighting == "scatter":
        covariance = generalised(clipped, X, V).covariance * cost
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


def in_own_units(covariance: FloatArray, back: FloatArray, exponents: Exponents) -> FloatArray:
    """Return a covariance of coefficients, converted from orthogonal terms to terms in bar and rpm: (84, 84)."""
    k, m = len(KEY_PARAMETERS), len(exponents)
    blocks = np.einsum("im,ambn,jn->aibj", back, covariance.reshape(k, m, k, m), back, optimize=True)
    full = np.zeros((k, len(TERMS), k, len(TERMS)))
    places, every = np.array(_places(exponents)), np.arange(k)
    full[np.ix_(every, places, every, places)] = blocks
    return full.reshape(k * len(TERMS), -1)


def _places(exponents: Exponents) -> list[int]:
    return [EXPONENTS.index(e) for e in exponents]


def rectangle(points: FloatArray) -> Domain:
    """Return the smallest domain that contains operating points (n, 2)."""
    (p_low, w_low), (p_high, w_high) = points.min(axis=0), points.max(axis=0)
    return Domain((float(p_low), float(p_high)), (float(w_low), float(w_high)))


def _with_covariance(estimates: Estimates) -> Estimates:
    """Return the estimates without fits that have no covariance; list these by name."""
    known = [bool(np.isfinite(own).all()) for own in estimates.covariance]
    if all(known):
        return estimates
    keep = np.flatnonzero(known)
    why = "no covariance for the weights (weighting = 'ordinary' needs none)"
    gone = tuple(f"{name}: {why}" for name, ok in zip(estimates.recordings, known, strict=True) if not ok)
    return as_estimates(
        Estimates(
            tuple(estimates.recordings[i] for i in keep),
            estimates.points[keep],
            estimates.values[keep],
            estimates.covariance[keep],
            (*estimates.left_out, *gone),
        )
    )


def _notes(estimates: Estimates, missed: FloatArray) -> tuple[str, ...]:
    notes = [f"left out: {entry}" for entry in estimates.left_out]
    off = [key for key, p in zip(KEY_PARAMETERS, missed, strict=True) if p < _MISSED / len(KEY_PARAMETERS)]
    if off:
        notes.append(
            f"the surfaces miss the means of operating points by more than recordings scatter: {', '.join(off)}; "
            "the standard deviations do not contain this lack of fit"
        )
    return tuple(notes)


def _impossible(model: LPVModel) -> tuple[str, ...]:
    """Return notes about operating points of the domain at which a delay is negative."""
    (p_low, p_high), (n_low, n_high) = model.domain.pressure_bar, model.domain.speed_rpm
    grid = np.meshgrid(np.linspace(p_low, p_high, 41), np.linspace(n_low, n_high, 41))
    pressure, speed = (side.ravel() for side in grid)
    found = model.key_parameters(pressure, speed)
    return tuple(
        f"{key} is negative in part of the domain, {1e3 * found[key][at]:.3g} ms at "
        f"{point_label(pressure[at], speed[at])}; the model cannot be used there"
        for key in ("tau_x", "tau_y")
        if found[key][at := int(np.argmin(found[key]))] < 0
    )
