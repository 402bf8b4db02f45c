"""What a fit of surfaces gives."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from gbid.arrays import FloatArray
from gbid.brief import brief
from gbid.errors import UsageError
from gbid.lpv.basis import TERMS, regressors
from gbid.lpv.characteristics import Deviation, characteristics, deviations
from gbid.lpv.model import LPVModel
from gbid.lpv.surface_fit.estimates import Estimates
from gbid.lpv.surface_fit.order import OrderScore
from gbid.lpv.surface_fit.outliers import Outlier
from gbid.structure import KEY_PARAMETERS

_TRIES = 20  # draws for each one wanted, before most of them count as useless


@dataclass(frozen=True, eq=False)
class LPVFit:
    """Surfaces of the key parameters, how sure they are, and what they were drawn through.

    Attributes
    ----------
    model : LPVModel
    covariance : (84, 84) array
        Of the coefficients: parameters in the order of `gbid.structure.KEY_PARAMETERS`, for each the six terms of
        `gbid.lpv.TERMS`, in the model's own units (SI per kg, bar, rpm). Zero for terms that were not in use.
    scatter : (14, 14) array
        Covariance of what one recording's parameters lie off the surfaces beside its own error; zeros when it was
        not estimated.
    estimates : Estimates
        What the surfaces were drawn through, and what was left out.
    outliers : tuple of Outlier
        Estimates far off a surface, worst first.
    orders : tuple of OrderScore
        Orders compared on operating points left out.
    lack_of_fit : (14,) array
        Probability that right surfaces would miss the points' means as far as these do; nan when not known.
    options : dict of str to str
        What was asked: method, weighting, order, robust.
    status : str
    success : bool
    notes : tuple of str
        What a reader should know.
    """

    model: LPVModel
    covariance: FloatArray
    scatter: FloatArray
    estimates: Estimates
    outliers: tuple[Outlier, ...] = ()
    orders: tuple[OrderScore, ...] = ()
    lack_of_fit: FloatArray = field(default_factory=lambda: np.full(len(KEY_PARAMETERS), np.nan))
    options: Mapping[str, str] = field(default_factory=dict)
    status: str = "converged"
    success: bool = True
    notes: tuple[str, ...] = ()

    def __repr__(self) -> str:
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
        """Coefficients of the model as one array, (14, 6)."""
        return np.array([self.model.coefficients[key] for key in KEY_PARAMETERS])

    @property
    def surface(self) -> FloatArray:
        """Key parameters of the surfaces where the estimates are, (n, 14)."""
        P, Omega = self.estimates.points.T
        return np.asarray(regressors(P, Omega) @ self.coefficients.T)

    @property
    def characteristics(self) -> tuple[FloatArray, FloatArray]:
        """Delays, modes and static gains, estimated and of the surfaces, each (n, 10): Figs. 14 to 18.

        Columns are those of `gbid.lpv.CHARACTERISTICS`.
        """
        return characteristics(self.estimates.values), characteristics(self.surface)

    @property
    def deviations(self) -> tuple[Deviation, ...]:
        """Rms and largest deviation of each characteristic, as the paper's Sec. 4 gives them."""
        return deviations(*self.characteristics, self.estimates.recordings)

    def uncertainty_at(
        self, pressure_bar: npt.ArrayLike, speed_rpm: npt.ArrayLike, *, scatter: bool = False, extrapolate: bool = False
    ) -> FloatArray:
        """Covariance of the key parameters at operating points.

        Parameters
        ----------
        pressure_bar, speed_rpm : float or array
            Broadcast against each other.
        scatter : bool
            Whether the scatter from one recording to the next is added: the machine tomorrow rather than on average.
        extrapolate : bool
            Whether points outside the model's domain are wanted.

        Returns
        -------
        (..., 14, 14) array
            In the order of `gbid.structure.KEY_PARAMETERS`, SI per kg.

        Raises
        ------
        UsageError
            Outside the domain unless `extrapolate` is set.
        """
        self.model.domain.check(pressure_bar, speed_rpm, f"model {self.model.name!r}", extrapolate)
        phi = regressors(pressure_bar, speed_rpm)
        blocks = self.covariance.reshape(len(KEY_PARAMETERS), len(TERMS), len(KEY_PARAMETERS), len(TERMS))
        found = np.einsum("...i,aibj,...j->...ab", phi, blocks, phi, optimize=True)
        return np.asarray(found + self.scatter if scatter else found)

    def draw(self, n: int, seed: int, *, scatter: bool = False) -> list[LPVModel]:
        """Draw models from the distribution of the coefficients.

        Parameters
        ----------
        n : int
            How many.
        seed : int
        scatter : bool
            Whether each also lies off the surfaces as a recording does.

        Returns
        -------
        list of LPVModel
            Draws with a delay that is not positive at a corner or an operating point of the domain are drawn anew.

        Raises
        ------
        UsageError
            When nearly all draws have such a delay: the delays are too uncertain to draw from.
        """
        rng = np.random.default_rng(seed)
        root = _root(self.covariance)
        lift = _root(self.scatter)
        corners = [(p, w) for p in self.model.domain.pressure_bar for w in self.model.domain.speed_rpm]
        phi = regressors(*np.array([*corners, *self.model.operating_points]).T)
        drawn: list[LPVModel] = []
        for _ in range(_TRIES * n):
            if len(drawn) == n:
                break
            coefficients = self.coefficients + (root @ rng.normal(size=root.shape[1])).reshape(-1, len(TERMS))
            if scatter:
                coefficients[:, 0] += lift @ rng.normal(size=lift.shape[1])
            if (phi @ coefficients[-2:].T > 0).all():
                drawn.append(with_coefficients(self.model, coefficients, name=f"{self.model.name} {len(drawn) + 1}"))
        if len(drawn) < n:
            raise UsageError(
                f"model {self.model.name!r}: {len(drawn)} of {_TRIES * n} draws have positive delays in the domain; "
                "the delays are too uncertain to draw from (hold them, or record for longer)"
            )
        return drawn


def with_coefficients(model: LPVModel, coefficients: FloatArray, **changes: Any) -> LPVModel:
    """Copy a model with other coefficients (14, 6)."""
    rows = {key: tuple(row) for key, row in zip(KEY_PARAMETERS, coefficients.tolist(), strict=True)}
    return replace(model, coefficients=rows, **changes)


def _root(covariance: FloatArray) -> FloatArray:
    """Matrix whose square is a covariance, also a singular one; its entries may differ by many orders."""
    size = np.sqrt(np.diag(covariance))
    scale = np.where(size > 0, size, 1.0)
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)) * scale[:, None])
