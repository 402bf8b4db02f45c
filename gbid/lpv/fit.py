"""Result of a surface fit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, overload

import h5py
import numpy as np
import numpy.typing as npt

from gbid.core import hdf5
from gbid.core.arrays import FloatArray, point_label
from gbid.core.brief import Brief, Description, brief
from gbid.core.errors import DataError, UsageError
from gbid.core.hdf5 import NOT_STORED, Stored
from gbid.core.names import given_path
from gbid.core.notes import SurfaceNote
from gbid.identify import FitStatus
from gbid.identify.result import FitResult
from gbid.identify.table import FitTable
from gbid.lpv.estimates import Estimates, Order, Outlier, as_estimates, distinct_points
from gbid.lpv.model import (
    ACTUATOR_PARAMETERS,
    EXPONENTS,
    SCHEDULING,
    TERMS,
    Deviation,
    Domain,
    LPVModel,
    ScheduledModel,
    characteristics,
    deviations,
    regressors,
)
from gbid.lpv.model_file import load_model, save_model
from gbid.lpv.regression import OrderScore, Weighting, coefficient_frame, covariance_at, draws, regression
from gbid.structure import KEY_PARAMETERS
from gbid.structure.linear import Structure, as_names
from gbid.structure.scheduled import Exponents, Schedule

_LACK = Stored("1", "probability that right surfaces miss the points' means as far", "k")


@dataclass(frozen=True, eq=False)
class LPVFit(Brief):
    """Surfaces of the key parameters, their uncertainty, and the estimates to which they were fitted.

    Attributes
    ----------
    model : LPVModel
        Model with the fitted coefficients.
    covariance : (84, 84) array
        Covariance of the coefficients: parameters in the order of `gbid.structure.KEY_PARAMETERS`, for each the six
        terms of `gbid.lpv.TERMS`, in the units of the model (SI per kg, bar, rpm). Zero for terms that were not used.
    scatter : (14, 14) array
        Covariance of the deviations of recordings from the surfaces, without the error of each estimate, SI per kg;
        zeros when it was not estimated.
    estimates : Estimates
        Estimates to which the surfaces were fitted, with the list of those that were left out.
    outliers : tuple of Outlier
        Estimates far from a surface, the farthest first.
    orders : tuple of OrderScore
        Orders compared by cross-validation over operating points.
    lack_of_fit : (14,) array
        p-value of the hypothesis that the polynomials are of sufficient order; nan when not known.
    options : dict of str to str
        Options of the fit: method, weighting, order, robust.
    status : FitStatus
        Status of the fit; a weighted fit always converges.
    notes : tuple of str
        Remarks for the reader of the result.
    """

    model: Annotated[LPVModel, NOT_STORED]
    covariance: Annotated[FloatArray, Stored("SI per kg, bar, rpm", "covariance of the coefficients", "c c")]
    scatter: Annotated[FloatArray, Stored("SI per kg", "covariance of recordings about the surfaces", "k k")]
    estimates: Estimates
    outliers: tuple[Outlier, ...] = ()
    orders: tuple[OrderScore, ...] = ()
    lack_of_fit: Annotated[FloatArray, _LACK] = field(default_factory=lambda: np.full(len(KEY_PARAMETERS), np.nan))
    options: Mapping[str, str] = field(default_factory=dict)
    status: FitStatus = FitStatus.CONVERGED
    notes: tuple[str, ...] = ()

    @property
    def success(self) -> bool:
        """Whether the fit converged."""
        return self.status.success

    def _brief(self) -> Description:
        return brief(
            self,
            f"{self.model.name}, {self.status}",
            estimates=f"{len(self.estimates.recordings)} recordings, {len(self.estimates.left_out)} left out",
            outliers=f"{len(self.outliers)}",
            options=self.options,
            notes=self.notes,
        )

    @property
    def coefficients(self) -> FloatArray:
        """Coefficients of the model as one array, (14, 6), in the units of the model."""
        return np.array([self.model.coefficients[key] for key in KEY_PARAMETERS])

    def to_frame(self) -> Any:
        """Return the coefficients as a data frame: a row for each parameter, columns for each term and its std.

        Returns
        -------
        pandas.DataFrame

        Raises
        ------
        UsageError
            When pandas is not installed.
        """
        return coefficient_frame(KEY_PARAMETERS, TERMS, self.coefficients, self.covariance)

    @property
    def surface(self) -> FloatArray:
        """Key parameters of the surfaces at the operating points of the estimates, (n, 14), SI per kg."""
        P, Omega = self.estimates.points.T
        return np.asarray(regressors(P, Omega) @ self.coefficients.T)

    @property
    def characteristics(self) -> tuple[FloatArray, FloatArray]:
        """Delays, modes and static gains of the estimates and of the surfaces, each (n, 10): Figs. 14 to 18.

        Columns are in the order of `gbid.lpv.CHARACTERISTICS`.
        """
        return characteristics(self.estimates.values), characteristics(self.surface)

    @property
    def deviations(self) -> tuple[Deviation, ...]:
        """Rms and largest deviation of each characteristic, as in Sec. 4 of the paper."""
        return deviations(*self.characteristics, self.estimates.recordings)

    def uncertainty_at(
        self, pressure_bar: npt.ArrayLike, speed_rpm: npt.ArrayLike, *, scatter: bool = False, extrapolate: bool = False
    ) -> FloatArray:
        """Return the covariance of the key parameters at operating points.

        Parameters
        ----------
        pressure_bar, speed_rpm : float or array
            Operating points [bar], [rpm]; arrays broadcast against each other.
        scatter : bool
            Whether the scatter between recordings is added. With it the covariance is that of the machine in one
            recording, without it that of its mean.
        extrapolate : bool
            Whether points outside the domain of the model are allowed.

        Returns
        -------
        (..., 14, 14) array
            Covariance in the order of `gbid.structure.KEY_PARAMETERS`, SI per kg.

        Raises
        ------
        UsageError
            When a point lies outside the domain and `extrapolate` is not set.
        """
        self.model.domain.check(pressure_bar, speed_rpm, f"model {self.model.name!r}", extrapolate)
        return covariance_at(regressors(pressure_bar, speed_rpm), self.covariance, self.scatter if scatter else None)

    def draw(self, n: int, seed: int, *, scatter: bool = False) -> list[LPVModel]:
        """Return random models from the distribution of the coefficients.

        Parameters
        ----------
        n : int
            Number of models.
        seed : int
            Seed of the random numbers.
        scatter : bool
            Whether each model also has the random deviation of one recording.

        Returns
        -------
        list of LPVModel
            Models with positive delays at the corners and operating points of the domain; other draws are rejected.

        Raises
        ------
        UsageError
            When almost all draws are rejected, because the delays are too uncertain.
        """
        corners = [(p, w) for p in self.model.domain.pressure_bar for w in self.model.domain.speed_rpm]
        phi = regressors(*np.array([*corners, *self.model.operating_points]).T)
        drawn = draws(
            self.coefficients,
            self.covariance,
            self.scatter if scatter else None,
            n,
            seed,
            lambda coefficients: bool((phi @ coefficients[-2:].T > 0).all()),
            (
                f"model {self.model.name!r}",
                "have positive delays in the domain; the delays are too uncertain to draw from (fix them in the fits, "
                "or record longer)",
            ),
        )
        return [
            with_coefficients(self.model, own, name=f"{self.model.name} {i}") for i, own in enumerate(drawn, start=1)
        ]


def with_coefficients(model: LPVModel, coefficients: FloatArray, **changes: Any) -> LPVModel:
    """Return a copy of a model with other coefficients (14, 6)."""
    rows = {key: tuple(row) for key, row in zip(KEY_PARAMETERS, coefficients.tolist(), strict=True)}
    return replace(model, coefficients=rows, **changes)


# ---- Surfaces of any parameters of any structure over any scheduling variables.


@dataclass(frozen=True, eq=False)
class ScheduledFit(Brief):
    """Surfaces of any structure, their uncertainty, and the estimates to which they were fitted.

    k parameters with m terms each.

    Attributes
    ----------
    model : ScheduledModel
        Model with the fitted coefficients.
    covariance : (k m, k m) array
        Covariance of the coefficients: parameters in the order of ``estimates.parameters``, for each its terms.
    scatter : (k, k) array
        Covariance of the deviations of recordings from the surfaces; zeros when it was not estimated.
    estimates : Estimates
        Estimates to which the surfaces were fitted, with the list of those that were left out.
    outliers : tuple of Outlier
        Estimates far from a surface, the farthest first.
    orders : tuple of OrderScore
        Orders compared by cross-validation over operating points.
    lack_of_fit : (k,) array
        p-value of the hypothesis that the polynomials are of sufficient order; nan when not known.
    options : dict of str to str
        Options of the fit: weighting, order, robust.
    notes : tuple of str
        Remarks for the reader of the result.
    """

    model: ScheduledModel
    covariance: FloatArray
    scatter: FloatArray
    estimates: Estimates
    outliers: tuple[Outlier, ...]
    orders: tuple[OrderScore, ...]
    lack_of_fit: FloatArray
    options: Mapping[str, str]
    notes: tuple[str, ...] = ()

    def _brief(self) -> Description:
        return brief(
            self,
            self.model.name,
            surfaces=", ".join(self.estimates.parameters),
            over=", ".join(self.model.scheduling),
            estimates=f"{len(self.estimates.recordings)} recordings, {len(self.estimates.left_out)} left out",
            outliers=f"{len(self.outliers)}",
            options=self.options,
            notes=self.notes,
        )

    @property
    def coefficients(self) -> FloatArray:
        """Coefficients as one array, (k, m)."""
        return np.array([self.model.coefficients[key] for key in self.estimates.parameters])

    def uncertainty_at(self, *point: npt.ArrayLike, scatter: bool = False, extrapolate: bool = False) -> FloatArray:
        """Return the covariance of the surfaces at operating points.

        Parameters
        ----------
        *point : float or array
            Scheduling variables in the order of ``model.scheduling``.
        scatter : bool
            Whether the scatter between recordings is added: the covariance of the machine in one recording instead of
            that of its mean.
        extrapolate : bool
            Whether points outside the domain are allowed.

        Returns
        -------
        (..., k, k) array
            Covariance in the order of ``estimates.parameters``.

        Raises
        ------
        UsageError
            As `ScheduledModel.parameters_at`.
        """
        terms = self.model.terms(self.model.checked(point, extrapolate))
        return covariance_at(terms, self.covariance, self.scatter if scatter else None)

    def draw(self, n: int, seed: int, *, scatter: bool = False) -> list[ScheduledModel]:
        """Return random models from the distribution of the coefficients.

        Parameters
        ----------
        n : int
            Number of models.
        seed : int
            Seed of the random numbers.
        scatter : bool
            Whether each model also has the random deviation of one recording.

        Returns
        -------
        list of ScheduledModel
            Models whose parameters are within their bounds at the operating points; other draws are rejected.

        Raises
        ------
        UsageError
            When almost all draws are rejected.
        """
        names = self.estimates.parameters
        bounds = {p.name: (p.lower, p.upper) for p in self.model.structure.parameters}
        low, high = np.array([bounds[name] for name in names]).T
        terms = self.model.terms(np.array(self.model.operating_points))

        def possible(coefficients: FloatArray) -> bool:
            values = terms @ coefficients.T
            return bool(((values >= low) & (values <= high)).all())

        drawn = draws(
            self.coefficients,
            self.covariance,
            self.scatter if scatter else None,
            n,
            seed,
            possible,
            (
                f"model {self.model.name!r}",
                "are within the bounds of the parameters; the surfaces are too uncertain to draw from",
            ),
        )
        rows = [dict(zip(names, map(tuple, own.tolist()), strict=True)) for own in drawn]
        return [
            replace(self.model, name=f"{self.model.name} {i}", coefficients=own) for i, own in enumerate(rows, start=1)
        ]


def fit_scheduled(
    fits: Sequence[FitResult],
    points: Sequence[Sequence[float]] | Sequence[float] | None,
    structure: Structure,
    scheduling: tuple[str, ...],
    parameters: tuple[str, ...] | None,
    weighting: Weighting,
    order: Order,
    robust: bool,
    name: str,
) -> ScheduledFit:
    """Return the surfaces of a structure; the arguments are those of `gbid.fit_lpv`, which is the public function.

    Raises
    ------
    UsageError
        When there are no fits, when they are of another structure, or when a parameter is unknown.
    DataError
        As `gbid.fit_lpv`.
    """
    fits = list(fits)
    if not fits or any(fit.structure != structure.name for fit in fits):
        there = ", ".join(sorted({fit.structure for fit in fits})) or "none"
        raise UsageError(f"fit_lpv: the fits are of {there}; give fits of the structure {structure.name!r}")
    if len(set(scheduling)) < len(scheduling) or not scheduling:
        raise UsageError(f"scheduling = {list(scheduling)}; give each variable once, and at least one")
    known = [parameter.name for parameter in structure.parameters]
    chosen = tuple(key for key in known if key in fits[0].free) if parameters is None else parameters
    unknown = [key for key in chosen if key not in known]
    if unknown or not chosen:
        raise UsageError(f"parameters: {', '.join(unknown) or 'none'}; there are {', '.join(known)}")
    given = None if points is None else [np.atleast_1d(np.asarray(point, float)).tolist() for point in points]
    found = regression(as_estimates(fits, given, chosen, scheduling), weighting, order, robust)
    grid = found.estimates.points
    good = [fit for fit in fits if fit.success]
    if lacking := [key for key in known if any(key not in fit.parameters for fit in good)]:
        raise UsageError(
            f"fit_lpv: the structure has {', '.join(lacking)}, which not all fits have; give it with the options of "
            "the fits"
        )
    held = {key: float(np.mean([fit.parameters[key] for fit in good])) for key in known if key not in chosen}
    model = ScheduledModel(
        name,
        structure,
        scheduling,
        found.exponents,
        {key: tuple(row) for key, row in zip(chosen, found.coefficients.tolist(), strict=True)},
        {key: (float(v.min()), float(v.max())) for key, v in zip(scheduling, grid.T, strict=True)},
        held,
        tuple(tuple(row) for row in distinct_points(grid).tolist()),
        fits[0].model.input_names,
        fits[0].model.output_names,
    )
    varied = [key for key in held if any(key in fit.free for fit in fits)]
    notes = [SurfaceNote.HELD_AT_MEAN(f"held at the mean of the fits: {', '.join(varied)}")] if varied else []
    return ScheduledFit(
        model,
        found.covariance,
        found.scatter,
        found.estimates,
        found.outliers,
        found.orders,
        found.lack_of_fit,
        found.options,
        (*found.notes, *notes),
    )


# ---- Surfaces over the scheduling variables, fitted to the estimates of a campaign (paper, Eqs. 16 to 18).


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


# ---- Surfaces of a gas bearing from the fit of a scheduled structure (paper, Eqs. 16 to 18).


def lpv_of(
    result: FitResult,
    *,
    actuators: Mapping[str, float] | None = None,
    name: str = "lpv",
    title: str = "",
    source: str = "",
) -> LPVFit:
    """Return the surfaces that the fit of a scheduled structure found, for tuning, figures and reports.

    Parameters
    ----------
    result : FitResult
        Fit of ``gbid.scheduled(...)`` with the fourteen key parameters over pressure_bar and speed_rpm.
    actuators : dict of str to float, optional
        Actuators of the model; by default those of the fit of a `Plant`.
    name, title, source : str
        Texts for the model.

    Returns
    -------
    LPVFit
        Coefficients in bar and rpm with their covariance. There are no estimates of single recordings and no scatter
        between them.

    Raises
    ------
    UsageError
        When the fit is of another structure, or did not converge.
    """
    schedule = result.options.schedule
    if schedule is None:
        raise UsageError(
            f"the fit of {result.structure!r} has constant parameters; surfaces through several fits: gbid.fit_lpv"
        )
    if schedule.variables != SCHEDULING or schedule.surfaces != KEY_PARAMETERS:
        raise UsageError(
            f"the fit has {', '.join(schedule.surfaces)} over {', '.join(schedule.variables)}; an LPV model of a gas "
            f"bearing has the fourteen key parameters over {', '.join(SCHEDULING)}"
        )
    if not result.success:
        raise UsageError(f"the fit did not converge ({result.status}); its surfaces cannot be used")
    coefficients, covariance = _in_bar_and_rpm(result, schedule)
    found = {key: result.parameters[key] for key in ACTUATOR_PARAMETERS if key in result.parameters}
    model = LPVModel(
        name,
        {key: tuple(row) for key, row in zip(KEY_PARAMETERS, coefficients.tolist(), strict=True)},
        Domain(*((low, high) for low, high in zip(schedule.low, schedule.high, strict=True))),
        actuators=found if actuators is None else actuators,
        pade_order=schedule.pade_order,
        title=title,
        source=source,
    )
    k = len(KEY_PARAMETERS)
    return LPVFit(
        model,
        covariance,
        np.zeros((k, k)),
        Estimates((), np.zeros((0, 2)), np.zeros((0, k)), np.zeros((0, k, k))),
        options={
            "method": "scheduled",
            "structure": result.structure,
            "focus": result.options.focus,
            "recordings": str(len(result.recordings)),
            "pieces": str(schedule.pieces),
        },
        status=result.status,
        notes=result.notes,
    )


def _in_bar_and_rpm(result: FitResult, schedule: Schedule) -> tuple[FloatArray, FloatArray]:
    """Return the coefficients of the six terms, (14, 6), and their covariance, (84, 84)."""
    k, m = len(KEY_PARAMETERS), len(TERMS)
    places = [EXPONENTS.index((e[0], e[1])) for e in schedule.exponents]
    onto = np.zeros((m, len(schedule.exponents)))
    onto[places] = schedule.to_own_units
    names = [schedule.names(key) for key in KEY_PARAMETERS]
    scaled = np.array([[result.parameters[name] for name in row] for row in names])
    free = {name: i for i, name in enumerate(result.free)}
    among = np.array([free.get(name, -1) for row in names for name in row])
    covariance = np.where((among[:, None] >= 0) & (among >= 0), result.covariance[np.ix_(among, among)], 0.0)
    every = np.kron(np.eye(k), onto)
    return scaled @ onto.T, every @ covariance @ every.T


# ---- Surface fits in files: the model in YAML, its uncertainty in HDF5 beside it.


KIND = hdf5.FileKind("lpv_fit", "fit anew with `gbid lpv`", 2)


def save_lpv_fit(fit: LPVFit, path: str | Path, overwrite: bool = False, key: str = "") -> None:
    """Write a surface fit: the model to ``path``, which `gbid.load_model` reads, the other fields to an .h5 beside it.

    Parameters
    ----------
    fit : LPVFit
        The fit.
    path : path
        The model file, ending in .yaml; the other file has the same name ending in .h5.
    overwrite : bool
        Whether existing files may be replaced.
    key : str
        Text that identifies settings and data of the fit; stored as attribute ``key``.

    Raises
    ------
    UsageError
        When a file exists and `overwrite` is not set, or when `path` has another ending.
    DataError
        When a file cannot be written.
    """
    path = given_path(path)
    beside = path.with_suffix(".h5")
    if beside.exists() and not overwrite:
        raise UsageError(f"{beside} exists already; choose another name or set overwrite")
    save_model(fit.model, path, overwrite)
    with hdf5.writing(beside, KIND, overwrite) as file:
        write_uncertainty(fit, file, key)


def write_uncertainty(fit: LPVFit, file: h5py.File, key: str) -> None:
    """Write all fields of a fit except its model."""
    hdf5.write_fields(file, fit)
    file.attrs.update({"key": key, "model": fit.model.name, "success": fit.success})
    hdf5.add_texts(file, "parameters", KEY_PARAMETERS)
    hdf5.add_texts(file, "terms", TERMS)
    words = "coefficients, parameters by terms"
    hdf5.add_dataset(file, "coefficients", fit.coefficients, "SI per kg, bar, rpm", words)


def load_lpv_fit(path: str | Path) -> LPVFit:
    """Return the surface fit in the files of `save_lpv_fit`.

    Parameters
    ----------
    path : path
        The model file or the .h5; both must be in the same folder.

    Returns
    -------
    LPVFit
        The fit.

    Raises
    ------
    UsageError
        When the model file is missing or faulty.
    DataError
        When the .h5 is missing, damaged, or belongs to another model.
    """
    path = given_path(path)
    if path.suffix == ".h5":
        path = path.with_suffix(".yaml")
    model = load_model(path)
    beside = path.with_suffix(".h5")
    with hdf5.reading(beside, KIND) as file:
        fit = hdf5.read_fields(file, LPVFit, model=model)
        stored = hdf5.read_dataset(file, "coefficients")
    if stored.shape != fit.coefficients.shape or not np.allclose(stored, fit.coefficients, rtol=1e-9, atol=0):
        raise DataError(f"{beside}: belongs to other coefficients than {path}; fit again, or use the files of one fit")
    return fit
