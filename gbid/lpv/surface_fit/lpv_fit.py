"""Result of a surface fit."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt

from gbid.arrays import FloatArray
from gbid.brief import Brief, Description, brief
from gbid.hdf5 import NOT_STORED, Stored
from gbid.identify import FitStatus
from gbid.lpv.basis import TERMS, regressors
from gbid.lpv.characteristics import Deviation, characteristics, deviations
from gbid.lpv.model import LPVModel
from gbid.lpv.surface_fit.coefficients import coefficient_frame, covariance_at, draws
from gbid.lpv.surface_fit.estimates import Estimates
from gbid.lpv.surface_fit.order import OrderScore
from gbid.lpv.surface_fit.outliers import Outlier
from gbid.structure import KEY_PARAMETERS

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
