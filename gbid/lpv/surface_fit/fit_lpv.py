"""Surfaces over the scheduling variables, fitted to the estimates of a campaign (paper, Eqs. 16 to 18)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import overload

import numpy as np

from gbid.arrays import FloatArray
from gbid.errors import UsageError
from gbid.identify.result import FitResult
from gbid.identify.table.fit_table import FitTable
from gbid.lpv.basis import EXPONENTS, SCHEDULING, TERMS
from gbid.lpv.domain import Domain
from gbid.lpv.model import LPVModel
from gbid.lpv.surface_fit.estimates import Estimates, as_estimates
from gbid.lpv.surface_fit.lpv_fit import LPVFit
from gbid.lpv.surface_fit.regression import Weighting, regression
from gbid.lpv.surface_fit.scheduled_fit import ScheduledFit, fit_scheduled
from gbid.lpv.surface_fit.terms import Order, distinct_points
from gbid.notes.model_notes import SurfaceNote
from gbid.operating_point import point_label
from gbid.structure import KEY_PARAMETERS
from gbid.structure.linear import Structure, as_names
from gbid.structure.scheduling.monomials import Exponents


@overload
def fit_lpv(
    fits: FitTable | Sequence[FitResult] | Estimates,
    points: Sequence[Sequence[float]] | None = None,
    *,
    structure: None = None,
    scheduling: Sequence[str] = SCHEDULING,
    parameters: Sequence[str] | None = None,
    weighting: Weighting = "scatter",
    order: Order = 2,
    robust: bool = False,
    actuators: Mapping[str, float] | None = None,
    pade_order: int = 1,
    name: str = "lpv",
    title: str = "",
    source: str = "",
) -> LPVFit: ...


@overload
def fit_lpv(
    fits: Sequence[FitResult],
    points: Sequence[Sequence[float]] | Sequence[float],
    *,
    structure: Structure,
    scheduling: str | Sequence[str],
    parameters: Sequence[str] | None = None,
    weighting: Weighting = "scatter",
    order: Order = 2,
    robust: bool = False,
    name: str = "lpv",
) -> ScheduledFit: ...


def fit_lpv(
    fits: FitTable | Sequence[FitResult] | Estimates,
    points: Sequence[Sequence[float]] | Sequence[float] | None = None,
    *,
    structure: Structure | None = None,
    scheduling: str | Sequence[str] = SCHEDULING,
    parameters: Sequence[str] | None = None,
    weighting: Weighting = "scatter",
    order: Order = 2,
    robust: bool = False,
    actuators: Mapping[str, float] | None = None,
    pade_order: int = 1,
    name: str = "lpv",
    title: str = "",
    source: str = "",
) -> LPVFit | ScheduledFit:
    """Return surfaces over the scheduling variables, fitted to the parameters of many fits.

    Without `structure` the machine is a rotor on a gas bearing: the surfaces of the fourteen key parameters over
    pressure and speed. With it, any parameters of any structure over any scheduling variables.

    Parameters
    ----------
    fits : FitTable or sequence of FitResult
        One row or result for each recording, with all parameters of the surfaces. Fits that did not converge or are
        not finite are left out and listed.
    points : sequence of points, optional
        Operating point of each fit result, in the order of `scheduling`; (pressure_bar, speed_rpm) for a gas bearing.
        A table contains them. With one scheduling variable a sequence of numbers.
    structure : Structure, optional
        Structure of the fits, for a machine other than the gas bearing.
    scheduling : str or sequence of str
        Names of the scheduling variables; only with `structure`.
    parameters : sequence of str, optional
        Parameters that become surfaces; by default all that the fits estimate. The others are held at their mean over
        the fits. Only with `structure`.
    weighting : {"scatter", "fits", "ordinary"}
        ``"scatter"``: generalised least squares of all parameters together. The weights come from the covariance of
        each fit plus the scatter between recordings, which is estimated by restricted maximum likelihood. ``"fits"``:
        the same with the covariance of each fit alone. ``"ordinary"``: ordinary least squares. The covariance of the
        coefficients comes from the residuals (HC3), so that machines may scatter more at some operating points than at
        others; for the first it is tempered with the model, which counts as one recording more at each value.
    order : int, "auto" or sequence of str
        Order of the polynomials: 0 to 2 for a gas bearing, 0 to 3 with `structure`. ``"auto"`` chooses it up to 2 by
        cross-validation over operating points, without terms in a variable that does not vary. A sequence names terms:
        those of `gbid.lpv.TERMS`, or with `structure` names such as ``"1", "gap", "gap^2", "gap current"``.
    robust : bool
        Whether estimates far from a surface get less weight (Huber).
    actuators : dict of str to float, optional
        Actuator parameters to store in the model of a gas bearing.
    pade_order : int
        Order of the delays of the model of a gas bearing, equal to that of the fitted structure.
    name, title, source : str
        Texts for the model.

    Returns
    -------
    LPVFit or ScheduledFit
        Its model is valid in the range of each scheduling variable that the operating points span.

    Raises
    ------
    UsageError
        When an option is unknown, or when parameters or operating points are missing.
    DataError
        When there are too few operating points for the order, when they do not determine its terms, when no fit
        remains, or when a fit has no covariance for the weights.
    """
    variables = as_names(scheduling)
    if structure is not None:
        if actuators is not None or isinstance(fits, FitTable | Estimates):
            what = "actuators belong" if actuators is not None else "a table of fits belongs"
            raise UsageError(f"fit_lpv: {what} to the model of a gas bearing; give fit results and their points")
        chosen = None if parameters is None else tuple(parameters)
        return fit_scheduled(fits, points, structure, variables, chosen, weighting, order, robust, name)
    if variables != SCHEDULING or parameters is not None:
        raise UsageError(
            "fit_lpv: scheduling and parameters need the structure of the fits, structure=...; without one the model "
            "is that of a gas bearing over pressure_bar and speed_rpm"
        )
    found = regression(as_estimates(fits, points), weighting, order, robust)  # type: ignore[arg-type]  # see overload
    coefficients = np.zeros((len(KEY_PARAMETERS), len(TERMS)))
    coefficients[:, _places(found.exponents)] = found.coefficients
    model = LPVModel(
        name,
        {key: tuple(row) for key, row in zip(KEY_PARAMETERS, coefficients.tolist(), strict=True)},
        rectangle(found.estimates.points),
        actuators=actuators or {},
        pade_order=pade_order,
        operating_points=tuple((float(p), float(w)) for p, w in distinct_points(found.estimates.points)),
        title=title,
        source=source,
    )
    return LPVFit(
        model,
        of_all_terms(found.covariance, found.exponents),
        found.scatter,
        found.estimates,
        found.outliers,
        found.orders,
        found.lack_of_fit,
        found.options,
        notes=(*found.notes, *_impossible(model)),
    )


def of_all_terms(covariance: FloatArray, exponents: Exponents) -> FloatArray:
    """Return the covariance of the coefficients of all terms of Eq. 16, with zeros for those not used: (84, 84)."""
    k, m = len(KEY_PARAMETERS), len(exponents)
    full = np.zeros((k, len(TERMS), k, len(TERMS)))
    places, every = np.array(_places(exponents)), np.arange(k)
    full[np.ix_(every, places, every, places)] = covariance.reshape(k, m, k, m)
    return full.reshape(k * len(TERMS), -1)


def _places(exponents: Exponents) -> list[int]:
    return [EXPONENTS.index((i, j)) for i, j in exponents]


def rectangle(points: FloatArray) -> Domain:
    """Return the smallest domain that contains operating points (n, 2)."""
    (p_low, w_low), (p_high, w_high) = points.min(axis=0), points.max(axis=0)
    return Domain((float(p_low), float(p_high)), (float(w_low), float(w_high)))


def _impossible(model: LPVModel) -> tuple[str, ...]:
    """Return notes about operating points of the domain at which a delay is negative."""
    (p_low, p_high), (n_low, n_high) = model.domain.pressure_bar, model.domain.speed_rpm
    grid = np.meshgrid(np.linspace(p_low, p_high, 41), np.linspace(n_low, n_high, 41))
    pressure, speed = (side.ravel() for side in grid)
    found = model.key_parameters(pressure, speed)
    return tuple(
        SurfaceNote.NEGATIVE_DELAY(
            f"{key} is negative in part of the domain, {1e3 * found[key][at]:.3g} ms at "
            f"{point_label(pressure[at], speed[at])}; the model cannot be used there"
        )
        for key in ("tau_x", "tau_y")
        if found[key][at := int(np.argmin(found[key]))] < 0
    )
