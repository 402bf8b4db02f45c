"""Surfaces over scheduling variables from many fits (paper, Eqs. 16 to 18): `fit_lpv`, its result, and its files."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import islice
from pathlib import Path
from typing import Annotated, Any

import h5py
import numpy as np
import numpy.typing as npt

from gbid.core import hdf5
from gbid.core.arrays import FloatArray, one_blas_thread
from gbid.core.brief import Brief, Description, brief
from gbid.core.errors import DataError, UsageError
from gbid.core.extras import data_frame
from gbid.core.figures import Figure, Pictured
from gbid.core.hdf5 import NOT_STORED, Stored
from gbid.core.notes import SurfaceNote
from gbid.core.tables import Cell, Column, Entry, Row, Table, shown_unit
from gbid.identify import FitStatus
from gbid.identify.result import FitResult
from gbid.identify.table import FitTable
from gbid.lpv.estimates import Estimates, Order, as_estimates, orthonormal
from gbid.lpv.model import (
    EXPONENTS,
    SCHEDULING,
    Deviation,
    LPVModel,
    characteristics,
    deviations,
    regressors,
)
from gbid.lpv.model_file import load_model, save_model
from gbid.lpv.regression import (
    HUBER,
    OrderScore,
    Outlier,
    Weighting,
    choose_terms,
    covariance_root,
    in_terms,
    in_units_of_terms,
    lack_of_fit,
    outliers,
    solve_surfaces,
    surface_notes,
    with_covariance,
)
from gbid.structure import KEY_PARAMETERS
from gbid.structure.built_in import EXACT_AS_PADE
from gbid.structure.linear import Structure, as_names
from gbid.structure.scheduling import term_name

_LACK = Stored("1", "probability that right surfaces miss the points' means as far", "k")
LACK = 0.01
"""Probability below which the lack of fit of surfaces is significant."""
_SHOWN_OUTLIERS = 10
_TRIES = 20  # largest number of draws for each requested model


@dataclass(frozen=True, eq=False)
class LPVFit(Brief, Pictured, hdf5.InFile):
    """Surfaces of k parameters with m terms each, their uncertainty, and the estimates that they were fitted to.

    For a gas bearing these are the fourteen key parameters in the order of `gbid.structure.KEY_PARAMETERS`, with the
    six terms of `TERMS`, in the units of the model (SI per kg, bar, rpm).

    Attributes
    ----------
    model : LPVModel
        Model with the fitted coefficients.
    covariance : (k m, k m) array
        Covariance of the coefficients: parameters in the order of ``estimates.parameters``, for each its terms. Zero
        for terms that were not used.
    scatter : (k, k) array
        Covariance of the deviations of recordings from the surfaces, without the error of each estimate; zeros when it
        was not estimated.
    estimates : Estimates
        Estimates to which the surfaces were fitted, with the list of those that were left out.
    outliers : tuple of Outlier
        Estimates far from a surface, the farthest first.
    orders : tuple of OrderScore
        Orders compared by cross-validation over operating points.
    lack_of_fit : (k,) array
        p-value of the hypothesis that the polynomials are of sufficient order; nan when not known.
    options : dict of str to str
        Options of the fit: method, weighting, order, robust.
    status : FitStatus
        Status of the fit; a weighted fit always converges.
    notes : tuple of str
        Remarks for the reader of the result.
    """

    FILE = hdf5.FileKind("lpv_fit", "fit anew with `gbid lpv`", 2)

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

    def to_hdf5(self, group: h5py.Group) -> None:
        """Write all fields but the model to the empty `group`; the model has a separate file."""
        hdf5.write_fields(group, self)
        group.attrs.update({"model": self.model.name, "success": self.success})
        hdf5.add_texts(group, "parameters", KEY_PARAMETERS)
        hdf5.add_texts(group, "terms", self.model.terms)
        long_name = "coefficients, parameters by terms"
        hdf5.add_dataset(group, "coefficients", self.coefficients, "SI per kg, bar, rpm", long_name)

    def write_beside(self, path: Path, overwrite: bool) -> None:
        """Write the model to a YAML file beside `path`; `overwrite` as for `gbid.save`."""
        save_model(self.model, path.with_suffix(".yaml"), overwrite)

    @classmethod
    def from_hdf5(cls, group: h5py.Group) -> LPVFit:
        """Return the fit in a `group` written by `to_hdf5`, with the model from the YAML file beside it."""
        path = Path(group.file.filename).with_suffix(".yaml")
        fit = hdf5.read_fields(group, LPVFit, model=load_model(path))
        stored = hdf5.read_dataset(group, "coefficients")
        if stored.shape != fit.coefficients.shape or not np.allclose(stored, fit.coefficients, rtol=1e-9, atol=0):
            raise DataError(
                f"{group.file.filename}: belongs to other coefficients than {path}; fit again, or use files of one fit"
            )
        return fit

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

    def document(self) -> Row:
        """Return status, deviations, orders, coefficients and outliers as plain values, for JSON."""
        names, std = self.estimates.parameters, np.sqrt(np.diag(self.covariance)).reshape(self.coefficients.shape)

        def by_parameter(values: FloatArray) -> Row:
            return dict(zip(names, values.tolist(), strict=True))

        return {
            "model": self.model.name,
            "recordings": len(self.estimates.recordings),
            "operating_points": len(self.model.operating_points),
            "status": self.status,
            "success": self.success,
            "options": dict(self.options),
            "deviations": [asdict(d) for d in self.deviations],
            "orders": [{"order": s.order, "score": s.score, "why_not": s.why_not} for s in self.orders],
            "coefficients": by_parameter(self.coefficients),
            "coefficients_std": by_parameter(std),
            "scatter_std": by_parameter(np.sqrt(np.diag(self.scatter))),
            "lack_of_fit": by_parameter(self.lack_of_fit),
            "outliers": [asdict(o) for o in self.outliers],
            "left_out": list(self.estimates.left_out),
            "notes": list(self.notes),
        }

    def tables(self) -> list[Table]:
        """Return the tables of deviations from the surfaces (with orders and outliers), and of coefficients."""
        std = np.sqrt(np.diag(self.covariance)).reshape(self.coefficients.shape)
        coefficients: list[Sequence[Entry]] = [
            (name, *(Cell(value, f"{value:.4g} ({s:.1g})") for value, s in zip(*pair, strict=True)))
            for name, *pair in zip(self.estimates.parameters, self.coefficients.tolist(), std.tolist(), strict=True)
        ]
        terms = [Column("parameter"), *(Column(term, format=4) for term in self.model.terms)]
        of_terms = Table("coefficients, in brackets their standard deviations", terms, coefficients)
        if self.model.structure is not None:
            return [of_terms]
        rows: list[list[Entry]] = []
        for d in self.deviations:
            factor, unit = shown_unit(d.unit)
            rows.append([d.name, factor * d.rms, factor * d.largest, unit, d.recording])
        title = (
            f"{len(self.estimates.recordings)} recordings at {len(self.model.operating_points)} operating points, "
            f"{self.options.get('method', 'fitted')}, {self.status}"
        )
        columns = [Column(""), *(Column(name, format=".4g") for name in ("rms", "largest"))]
        return [Table(title, [*columns, Column("unit"), Column("recording")], rows, ["", *self._remarks()]), of_terms]

    def _remarks(self) -> Iterator[str]:
        orders = [f"{q.order}: {(q.why_not and 'not possible') or format(q.score, '.3f')}" for q in self.orders]
        if orders:
            yield f"error at points left out, by order (order 0 = 1): {', '.join(orders)}"
        lacking = [name for name, p in zip(self.estimates.parameters, self.lack_of_fit, strict=True) if p < LACK]
        if lacking:
            yield f"the surfaces miss the means of {', '.join(lacking)} by more than chance"
        for outlier in self.outliers[:_SHOWN_OUTLIERS]:
            yield f"off the surface: {outlier.recording}, {outlier.parameter}, {outlier.standardised:+.1f} std"
        if len(self.outliers) > _SHOWN_OUTLIERS:
            yield f"off the surface: {len(self.outliers)} estimates in all; the largest are above"
        yield from (f"left out: {text}" for text in self.estimates.left_out)
        yield from (f"note: {note}" for note in self.notes)

    def figures(self) -> list[Figure]:
        """Return modes and delays over pressure, and surfaces of the other parameters, with estimates.

        Over two other scheduling variables there are the surfaces alone, over one or three no pictures.
        """
        over = {"frequency": "natural frequencies", "damping": "damping factors", "delay": "delays"}
        surfaces = {"k": "stiffness", "d": "damping", "b": "piezo influence"}
        if self.model.scheduling != SCHEDULING:
            over, surfaces = {}, surfaces if len(self.model.scheduling) == 2 else {}
        return [
            *(Figure("plot_over_pressure", f"{over[q]} over pressure", (self,), {"what": q}) for q in over),
            *(Figure("plot_surfaces", f"{surfaces[q]} as surfaces", (self,), {"letter": q}) for q in surfaces),
        ]

    @property
    def coefficients(self) -> FloatArray:
        """Coefficients of the model as one array, (k, m), in the units of the model."""
        return np.array([self.model.coefficients[key] for key in self.estimates.parameters])

    def to_frame(self) -> Any:
        """Return a data frame of coefficients: a row for each parameter, columns for terms and standard deviations.

        Returns
        -------
        pandas.DataFrame

        Raises
        ------
        UsageError
            When pandas is not installed.
        """
        std = np.sqrt(np.diag(self.covariance)).reshape(self.coefficients.shape)
        columns: dict[str, Any] = {"parameter": list(self.estimates.parameters)}
        for j, term in enumerate(self.model.terms):
            columns |= {term: self.coefficients[:, j], f"{term} std": std[:, j]}
        return data_frame(columns, index="parameter")

    @property
    def surface(self) -> FloatArray:
        """Parameter values of the surfaces at the operating points of the estimates, (n, k)."""
        terms = regressors(*self.estimates.points.T, exponents=self.model.exponents)
        return np.asarray(terms @ self.coefficients.T)

    @property
    def characteristics(self) -> tuple[FloatArray, FloatArray]:
        """Delays, modes and static gains from estimates and from surfaces, each (n, 10): Figs. 14 to 18.

        Columns are in the order of `CHARACTERISTICS`. They are those of a gas bearing.
        """
        self.model.need_bearing(None)
        return characteristics(self.estimates.values), characteristics(self.surface)

    @property
    def deviations(self) -> tuple[Deviation, ...]:
        """Rms and largest deviation of each characteristic from the surfaces, as in Sec. 4 of the paper."""
        return deviations(*self.characteristics, self.estimates.recordings)

    def uncertainty_at(self, *point: npt.ArrayLike, scatter: bool = False, extrapolate: bool = False) -> FloatArray:
        """Return the covariance of the surfaces' parameter values at operating points.

        Parameters
        ----------
        *point : float or array
            Scheduling variables in the order of ``model.scheduling``; for a gas bearing [bar], [rpm]. Arrays broadcast
            against each other.
        scatter : bool
            Whether the scatter between recordings is added. With it the covariance is that of the machine in one
            recording, without it that of its mean.
        extrapolate : bool
            Whether points outside the domain of the model are allowed.

        Returns
        -------
        (..., k, k) array
            Covariance in the order of ``estimates.parameters``.

        Raises
        ------
        UsageError
            When a point lies outside the domain and `extrapolate` is not set.
        """
        self.model.domain.check(point, f"model {self.model.name!r}", extrapolate)
        terms = regressors(*point, exponents=self.model.exponents)
        k, m = self.coefficients.shape
        blocks = self.covariance.reshape(k, m, k, m)
        covariance = np.einsum("...i,aibj,...j->...ab", terms, blocks, terms, optimize=True)
        return np.asarray(covariance + self.scatter if scatter else covariance)

    def draw(self, n: int, seed: int, *, scatter: bool = False) -> list[LPVModel]:
        """Return random models, drawn from the distribution of the coefficients.

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
            Models whose parameters are within their bounds, such as positive delays, at the corners of the domain and
            at its operating points; other draws are rejected.

        Raises
        ------
        UsageError
            When almost all draws are rejected, because the surfaces are too uncertain.
        """
        names, domain = self.estimates.parameters, self.model.domain
        bounds = {p.name: (p.lower, p.upper) for p in self.model.equations.parameters}
        low, high = np.array([bounds[name] for name in names]).T
        points = np.array([*domain.corners, *self.model.operating_points])
        terms = regressors(*points.T, exponents=self.model.exponents)

        def within_bounds(coefficients: FloatArray) -> bool:
            values = terms @ coefficients.T
            return bool(((values >= low) & (values <= high)).all())

        draws = self._draws(_TRIES * n, np.random.default_rng(seed), scatter)
        accepted = list(islice(filter(within_bounds, draws), n))
        if len(accepted) < n:
            raise UsageError(
                f"model {self.model.name!r}: only {len(accepted)} of {_TRIES * n} draws are within the bounds of the "
                "parameters; the fitted coefficients are too uncertain (fix the delays in the fits, or record longer)"
            )
        return [
            with_coefficients(self.model, names, coefficients, name=f"{self.model.name} {i}")
            for i, coefficients in enumerate(accepted, start=1)
        ]

    def _draws(self, n: int, rng: np.random.Generator, scatter: bool) -> Iterator[FloatArray]:
        """Yield random coefficients (k, m); a recording's random deviation is added to the constant terms."""
        root, lift = covariance_root(self.covariance), covariance_root(self.scatter)
        for _ in range(n):
            drawn = self.coefficients + (root @ rng.normal(size=root.shape[1])).reshape(self.coefficients.shape)
            if scatter:
                drawn[:, 0] += lift @ rng.normal(size=lift.shape[1])
            yield drawn


def with_coefficients(model: LPVModel, names: Sequence[str], coefficients: FloatArray, **changes: Any) -> LPVModel:
    """Return a copy of a model with new coefficients (k, m) of the named parameters."""
    return replace(model, coefficients=_rows(names, coefficients), **changes)


def _rows(names: Sequence[str], coefficients: FloatArray) -> dict[str, tuple[float, ...]]:
    """Return coefficients (k, m) in the form of `LPVModel`."""
    return {key: tuple(row) for key, row in zip(names, coefficients.tolist(), strict=True)}


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
    pade_order: int = EXACT_AS_PADE,
    name: str = "lpv",
    title: str = "",
    source: str = "",
) -> LPVFit:
    """Return surfaces over the scheduling variables, fitted to the parameters of many fits.

    Without `structure` the machine is a rotor on a gas bearing: the surfaces are those of the fourteen key parameters.
    With it, they are those of any parameters of any structure.

    Parameters
    ----------
    fits : FitTable or sequence of FitResult
        One row or result for each recording, with all parameters of the surfaces. Fits that did not converge or are
        not finite are left out and listed.
    points : sequence of points, optional
        Operating point of each fit result or row, in the order of `scheduling`; by default (pressure_bar, speed_rpm),
        which a table contains. With one scheduling variable a sequence of numbers.
    structure : Structure, optional
        Structure of the fits, for a machine other than the gas bearing.
    scheduling : str or sequence of str
        Names of the scheduling variables, such as ``("pressure_bar", "eccentricity")``.
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
        Order of the polynomials: 0 to 2 over pressure and speed, else 0 to 3. ``"auto"`` chooses it up to 2 by
        cross-validation over operating points, without terms in a variable that does not vary. A sequence names terms:
        those of `TERMS`, or names such as ``"1", "gap", "gap^2", "gap current"``.
    robust : bool
        Whether estimates far from a surface get less weight (Huber).
    actuators : dict of str to float, optional
        Actuator parameters to store in the model of a gas bearing.
    pade_order : int
        Order of the Pade filters of the model of a gas bearing: that of the fitted structure, or 3 in place of exact
        delays.
    name, title, source : str
        Texts for the model.

    Returns
    -------
    LPVFit
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
    if len(set(variables)) < len(variables) or not variables:
        raise UsageError(f"scheduling = {list(variables)}; give each variable once, and at least one")
    notes: tuple[str, ...] = ()
    of_structure: dict[str, Any] = {}
    if structure is None:
        if parameters is not None:
            raise UsageError(
                "fit_lpv: parameters need the structure of the fits, structure=...; without one the surfaces are those "
                "of the key parameters of a gas bearing"
            )
        estimates = as_estimates(fits, points, scheduling=variables)
    elif isinstance(fits, FitTable | Estimates) or actuators is not None:
        what = "actuators belong" if actuators is not None else "a table of fits belongs"
        raise UsageError(f"fit_lpv: {what} to the model of a gas bearing; give fit results and their points")
    else:
        surfaces = _surfaces(fits, structure, parameters)
        estimates = as_estimates(fits, points, surfaces, variables)
        of_structure, notes = _beside_surfaces(fits, structure, surfaces)
    if weighting != "ordinary":
        estimates = with_covariance(estimates)
    exponents, orders = choose_terms(estimates, order)
    design = orthonormal(estimates.points, exponents, variables)
    with one_blas_thread():  # threads do not speed up small matrices
        solved = solve_surfaces(estimates, design, weighting, robust)
    missed = lack_of_fit(estimates.points, estimates.values, exponents, variables)
    terms = EXPONENTS if variables == SCHEDULING else exponents
    back = in_terms(design.back, exponents, terms)
    model = LPVModel(
        name,
        _rows(estimates.parameters, solved.coefficients @ back.T),
        estimates.domain,
        actuators=actuators or {},
        pade_order=pade_order,
        operating_points=estimates.operating_points,
        structure=structure,
        exponents=terms,
        title=title,
        source=source,
        **of_structure,
    )
    return LPVFit(
        model,
        in_units_of_terms(solved.covariance, back),
        solved.scatter,
        estimates,
        outliers(estimates.recordings, solved.residuals, solved.z, estimates.parameters),
        orders,
        missed,
        {
            "method": "two-step",
            "weighting": weighting,
            "order": ", ".join(term_name(e, variables) for e in exponents),
            "chosen": "by cross-validation" if isinstance(order, str) and order == "auto" else "given",
            "robust": f"Huber, {HUBER:g} standard deviations" if robust else "no",
        },
        notes=(*solved.notes, *surface_notes(estimates, missed), *notes, *_negative_delays(model)),
    )


def _surfaces(fits: Sequence[FitResult], structure: Structure, parameters: Sequence[str] | None) -> tuple[str, ...]:
    """Parameters of a structure that become surfaces; refuses fits of another structure and unknown names."""
    if not fits or any(fit.structure != structure.name for fit in fits):
        names = ", ".join(sorted({fit.structure for fit in fits})) or "none"
        raise UsageError(f"fit_lpv: the fits are of {names}; give fits of the structure {structure.name!r}")
    known = [parameter.name for parameter in structure.parameters]
    chosen = tuple(key for key in known if key in fits[0].free) if parameters is None else tuple(parameters)
    unknown = [key for key in chosen if key not in known]
    if unknown or not chosen:
        raise UsageError(f"parameters: {', '.join(unknown) or 'none'}; choose from {', '.join(known)}")
    return chosen


def _beside_surfaces(
    fits: Sequence[FitResult], structure: Structure, surfaces: tuple[str, ...]
) -> tuple[dict[str, Any], tuple[str, ...]]:
    """Return a model's channels, and the mean over the fits of each parameter without a surface, with a note."""
    known = [parameter.name for parameter in structure.parameters]
    good = [fit for fit in fits if fit.success]
    if lacking := [key for key in known if any(key not in fit.parameters for fit in good)]:
        raise UsageError(
            f"fit_lpv: the structure has {', '.join(lacking)}, which not all fits have; give it with the options of "
            "the fits"
        )
    held = {key: float(np.mean([fit.parameters[key] for fit in good])) for key in known if key not in surfaces}
    varied = [key for key in held if any(key in fit.free for fit in fits)]
    notes = (SurfaceNote.HELD_AT_MEAN(f"held at the mean of the fits: {', '.join(varied)}"),) if varied else ()
    channels = {"input_names": fits[0].model.input_names, "output_names": fits[0].model.output_names}
    return {"held": held, **channels}, notes


def _negative_delays(model: LPVModel) -> tuple[str, ...]:
    """Return notes on operating points of the domain with a negative delay of a gas bearing."""
    delays = [key for key in ("tau_x", "tau_y") if key in model.coefficients]
    if not delays:
        return ()
    n = max(3, round(41 ** (2 / max(2, len(model.scheduling)))))
    grid = [side.ravel() for side in np.meshgrid(*(np.linspace(*ends, n) for ends in model.domain.bounds))]
    values = model.key_parameters(*grid)
    return tuple(
        SurfaceNote.NEGATIVE_DELAY(
            f"{key} is negative in part of the domain, {1e3 * values[key][at]:.3g} ms at "
            f"{model.domain.label(*(side[at] for side in grid))}; the model cannot be used there"
        )
        for key in delays
        if values[key][at := int(np.argmin(values[key]))] < 0
    )
