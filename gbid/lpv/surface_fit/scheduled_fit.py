"""Surfaces of any parameters of any structure over any scheduling variables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from gbid.arrays import FloatArray
from gbid.brief import Brief, Description, brief
from gbid.errors import UsageError
from gbid.identify.result import FitResult
from gbid.lpv.scheduled_model import ScheduledModel
from gbid.lpv.surface_fit.coefficients import covariance_at, draws
from gbid.lpv.surface_fit.estimates import Estimates, as_estimates
from gbid.lpv.surface_fit.order import OrderScore
from gbid.lpv.surface_fit.outliers import Outlier
from gbid.lpv.surface_fit.regression import Weighting, regression
from gbid.lpv.surface_fit.terms import Order, distinct_points
from gbid.notes.model_notes import SurfaceNote
from gbid.structure.linear import Structure


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
