"""Outliers from the surfaces: a robust rule that finds them, and Huber's estimate that gives them less weight."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, NamedTuple

import numpy as np
from scipy.special import ndtr, ndtri

from gbid.arrays import FloatArray
from gbid.hdf5 import Stored
from gbid.lpv.surface_fit.mixed import generalised, with_scatter
from gbid.structure import KEY_PARAMETERS

_MAD = 1.4826  # standard deviation of a normal variable over its median absolute deviation
_LEAST = 3.5  # Iglewicz and Hoaglin, How to Detect and Handle Outliers (1993)
_FALSE_ALARM = 0.05  # probability of at least one outlier when all entries are normal
HUBER = 1.345  # standard deviations; 95 % efficient for normal errors (Huber, Robust Statistics, 1981)
CLIPPING_SLOPE = 1 - 2 * float(ndtr(-HUBER))  # mean slope of the clipping function
_DENSITY = float(
    np.exp(-(HUBER**2) / 2) / np.sqrt(2 * np.pi)
)  # density of a standard normal variable at HUBER; the next line is the variance of a clipped one
_VARIANCE = CLIPPING_SLOPE - 2 * HUBER * _DENSITY + 2 * HUBER**2 * float(ndtr(-HUBER))
_ROUNDS, _SETTLED = 30, 1e-2  # of a standard deviation


@dataclass(frozen=True)
class Outlier:
    """Recording far from the surface of one parameter.

    Attributes
    ----------
    recording, parameter : str
        Names of the recording and of the parameter.
    deviation : float
        Estimate minus surface, SI per kg.
    standardised : float
        Deviation in robust standard deviations.
    """

    recording: str
    parameter: str
    deviation: Annotated[float, Stored("SI per kg", "estimate minus surface")]
    standardised: Annotated[float, Stored("1", "the same in robust standard deviations")]


def standardised(residuals: FloatArray, V: FloatArray) -> FloatArray:
    """Return residuals (n, k) over their standard deviations.

    `V` (n, k, k) gives the ratio of the standard deviations of the rows. The scale of each column comes from the
    median, so that an outlier that has enlarged `V` is still found.
    """
    z = residuals / np.sqrt(np.einsum("ikk->ik", V))
    return np.asarray(z / _scale(z))


def _scale(z: FloatArray) -> FloatArray:
    return np.maximum(_MAD * np.median(np.abs(z), axis=0), 1e-12)


def threshold(count: int) -> float:
    """Return the largest standardised residual that is not an outlier.

    It is 3.5, and larger for many entries, because some normal values then exceed 3.5 by chance.
    """
    return max(_LEAST, float(-ndtri(_FALSE_ALARM / (2 * count))))


def outliers(
    recordings: tuple[str, ...], residuals: FloatArray, z: FloatArray, parameters: tuple[str, ...] = KEY_PARAMETERS
) -> tuple[Outlier, ...]:
    """Return the entries of (n, k) arrays beyond the threshold, the largest first."""
    limit = threshold(z.size)
    found = [
        Outlier(recordings[i], parameters[j], float(residuals[i, j]), float(z[i, j]))
        for i, j in zip(*np.nonzero(np.abs(z) > limit), strict=True)
    ]
    return tuple(sorted(found, key=lambda o: -abs(o.standardised)))


class HuberEstimate(NamedTuple):
    """Huber's estimate.

    Attributes
    ----------
    coefficients : (m,) array
        Coefficients.
    scatter : (k, k) array
        Scatter, corrected for the clipping.
    clipped : (n, k) array
        Data with clipped residuals.
    cost : float
        Factor on the covariance of the coefficients that accounts for the clipping.
    """

    coefficients: FloatArray
    scatter: FloatArray
    clipped: FloatArray
    cost: float


def huber_estimate(y: FloatArray, X: FloatArray, C: FloatArray | None) -> HuberEstimate:
    """Return Huber's estimate by modified residuals, which are clipped at 1.345 standard deviations.

    Parameters
    ----------
    y : (n, k) array
        Observations.
    X : (n, k, m) array
        Regressors of each row.
    C : (n, k, k) array or None
        Covariance of the error of each row, to which scatter is added; None for rows of equal weight.
    """
    n, k = y.shape
    S = np.zeros((k, k)) if C is None else with_scatter(y, X, C).scatter
    V = np.broadcast_to(np.eye(k), (n, k, k)) if C is None else C + S
    coefficients, clipped = generalised(y, X, V).coefficients, y
    for _ in range(_ROUNDS):
        surface = X @ coefficients
        sigma = np.sqrt(np.einsum("ikk->ik", V))
        size = HUBER * sigma * _scale((y - surface) / sigma)
        inside = np.clip(y - surface, -size, size)
        clipped = surface + inside
        if C is not None:
            S = with_scatter(surface + inside / np.sqrt(_VARIANCE), X, C, start=S).scatter
            V = C + S
        fit = generalised(clipped, X, V)
        moved = np.abs(fit.coefficients - coefficients) / np.sqrt(np.diag(fit.covariance))
        coefficients = fit.coefficients
        if moved.max() < _SETTLED:
            break
    return HuberEstimate(coefficients, S, clipped, _VARIANCE / CLIPPING_SLOPE**2)
