"""Uncertainty of the plant: draws from the covariance of an LPV fit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from gbid.arrays import FloatArray, is_whole
from gbid.brief import Brief
from gbid.errors import UsageError
from gbid.lpv import TERMS, basis
from gbid.structure import KEY_PARAMETERS


@dataclass(frozen=True, eq=False)
class Uncertainty(Brief):
    """Uncertainty of the key parameters of a model.

    Parameters
    ----------
    covariance : (84, 84) array, optional
        Covariance of the coefficients of Eq. 16: the fourteen key parameters (`gbid.structure.KEY_PARAMETERS`) with six
        terms each (`gbid.lpv.TERMS`), in SI per bar and rpm, as an LPV fit gives it.
    samples : (n, 14) array, optional
        In place of the covariance: deviations of the key parameters from the model, the same at every operating point.
    draws : int
        Number of plants drawn from the covariance.
    seed : int
        Seed of the draws.
    scatter : (14, 14) array, optional
        Covariance of the deviations of single recordings from the surfaces (`gbid.LPVFit.scatter`). Each draw gets one
        such deviation, the same at every operating point.
    chosen : tuple of int, optional
        Indices of the draws or samples that are used; all by default.

    Raises
    ------
    UsageError
        When not exactly one of the two is given, when its shape is wrong, when the covariance is not symmetric or has a
        negative eigenvalue, or when draws, seed or chosen do not fit.
    """

    covariance: npt.ArrayLike | None = None
    samples: npt.ArrayLike | None = None
    draws: int = 10
    seed: int = 0
    scatter: npt.ArrayLike | None = None
    chosen: tuple[int, ...] | None = None

    def __post_init__(self) -> None:
        n = len(KEY_PARAMETERS) * len(TERMS)
        if (self.covariance is None) == (self.samples is None):
            raise UsageError("uncertainty: give either the covariance of the coefficients or samples")
        if self.covariance is not None:
            for name, given, size in (
                ("covariance", self.covariance, n),
                ("scatter", self.scatter, len(KEY_PARAMETERS)),
            ):
                matrix = None if given is None else _array(name, given)
                if matrix is not None and not (matrix.shape == (size, size) and _symmetric(matrix)):
                    raise UsageError(
                        f"uncertainty: {name} has shape {matrix.shape}; give finite and symmetric {(size, size)}"
                    )
            for name, value, least in (("draws", self.draws, 1), ("seed", self.seed, 0)):
                if not is_whole(value, least):
                    raise UsageError(f"uncertainty: {name} = {value!r}; give an integer of at least {least}")
            known = int(self.draws)
        else:
            samples = _array("samples", self.samples)
            known = len(samples) if samples.ndim else 0
            if samples.ndim != 2 or samples.shape[1] != len(KEY_PARAMETERS) or not np.isfinite(samples).all():
                raise UsageError(
                    f"uncertainty: samples have shape {samples.shape}, expected finite (n, {len(KEY_PARAMETERS)})"
                )
        if any(i not in range(known) for i in self.chosen or ()):
            raise UsageError(f"uncertainty: chosen = {self.chosen}; there are {known}, from 0")

    def scenarios(self, points: FloatArray) -> FloatArray:
        """Return every drawn plant at every point, the model itself first: (m (1 + n), 16).

        Parameters
        ----------
        points : (m, 2) array
            Pressure [bar] and speed [rpm].
        """
        deviations = self._deviations(points)
        if self.chosen is not None:
            deviations = [deviations[i] for i in self.chosen]
        nominal = np.hstack([points, np.zeros((len(points), len(KEY_PARAMETERS)))])
        drawn = [np.hstack([points, deviation]) for deviation in deviations]
        return np.vstack([nominal, *drawn])

    def _deviations(self, points: FloatArray) -> list[FloatArray]:
        """Return the deviations (m, 14) of each draw."""
        if self.samples is not None:
            samples = np.asarray(self.samples, float)
            return [np.broadcast_to(sample, (len(points), len(sample))) for sample in samples]
        root = _root(np.asarray(self.covariance, float))
        normal = np.random.default_rng(self.seed).standard_normal((self.draws, len(root)))
        terms = np.stack([term * np.ones(len(points)) for term in basis(points[:, 0], points[:, 1])], axis=1)
        coefficients = (normal @ root.T).reshape(self.draws, len(KEY_PARAMETERS), len(TERMS))
        found = [terms @ draw.T for draw in coefficients]
        if self.scatter is not None:
            lift = np.random.default_rng([self.seed, 1]).standard_normal((self.draws, len(KEY_PARAMETERS)))
            lift = lift @ _root(np.asarray(self.scatter, float)).T
            found = [deviation + one for deviation, one in zip(found, lift, strict=True)]
        return found


def _array(name: str, given: npt.ArrayLike | None) -> FloatArray:
    try:
        return np.asarray(given, float)
    except (TypeError, ValueError):
        raise UsageError(f"uncertainty: {name} = {given!r}; give an array of numbers") from None


def _symmetric(matrix: FloatArray) -> bool:
    size = np.sqrt(np.abs(np.diag(matrix)))
    return bool(np.isfinite(matrix).all() and (np.abs(matrix - matrix.T) <= 1e-6 * np.outer(size, size)).all())


def _root(covariance: FloatArray) -> FloatArray:
    """Return a matrix R with R R' equal to a covariance."""
    size = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    size = np.where(size > 0, size, 1.0)
    values, vectors = np.linalg.eigh(covariance / np.outer(size, size))
    if values[0] < -1e-6 * max(values[-1], 1.0):
        raise UsageError("uncertainty: the covariance has a negative direction; it is no covariance")
    return np.asarray(size[:, None] * vectors * np.sqrt(np.maximum(values, 0.0)))
