"""Robust losses of Huber and Student for errors of several outputs, and their efficiency."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np
import scipy

from gbid.arrays import FloatArray
from gbid.errors import UsageError

LossName = Literal["huber", "student"]
EFFICIENCY = 0.95
"""Efficiency of the default thresholds for normal errors without outliers."""


@dataclass(frozen=True)
class RobustLoss:
    """Loss of the squared distance ``d^2 = e' S^-1 e`` of the errors of a sample, with their covariance S.

    Attributes
    ----------
    kind : {"huber", "student"}
        Huber: quadratic up to the threshold, linear beyond. Student: negative log-likelihood of the t distribution.
    threshold : float
        Huber: distance up to which a sample has its full weight. Student: degrees of freedom.
    """

    kind: LossName
    threshold: float

    def weight(self, squared: FloatArray, n_outputs: int) -> FloatArray:
        """Return the weight of the squared errors of samples with these squared distances."""
        if self.kind == "huber":
            distance = np.sqrt(np.maximum(squared, np.finfo(float).tiny))
            return np.asarray(np.minimum(1.0, self.threshold / distance))
        return np.asarray((self.threshold + n_outputs) / (self.threshold + squared))

    def elasticity(self, squared: FloatArray) -> FloatArray:
        """Return ``d w'(d) / w(d)``, the relative change of the weight over that of the distance."""
        if self.kind == "huber":
            return np.where(squared > self.threshold**2, -1.0, 0.0)
        return np.asarray(-2 * squared / (self.threshold + squared))

    def moments(self, squared: FloatArray, n_outputs: int, share: FloatArray | float = 1.0) -> WeightMoments:
        """Return the moments of the weights, for samples with these squared distances.

        `share` is the probability of each sample; by default all are equally probable.
        """
        w = self.weight(squared, n_outputs)
        total = float(np.sum(share * np.ones_like(w)))

        def mean(values: FloatArray) -> float:
            return float(np.sum(share * values)) / total

        return WeightMoments(
            mean(w),
            mean(w * squared) / n_outputs,
            mean(w**2 * squared) / n_outputs,
            mean(w * (1 + self.elasticity(squared) / n_outputs)),
        )


@dataclass(frozen=True)
class WeightMoments:
    """WeightMoments of the weights w over the distances d of p outputs.

    Attributes
    ----------
    weight : float
        Mean weight.
    power : float
        ``E[w d^2] / p``: weighted errors.
    scores : float
        ``E[w^2 d^2] / p``: variance of the weighted errors.
    curvature : float
        ``E[w + d w' / p]``: mean derivative of the weighted errors by the errors.
    """

    weight: float
    power: float
    scores: float
    curvature: float


def robust_loss(kind: LossName | None, threshold: float | None, n_outputs: int) -> RobustLoss | None:
    """Return a loss, None for squared errors; the default threshold has an efficiency of 95 % for normal errors.

    Parameters
    ----------
    kind : {"huber", "student"}, optional
        The loss.
    threshold : float, optional
        Threshold of Huber in standard deviations, or degrees of freedom of Student.
    n_outputs : int
        Number of outputs.

    Returns
    -------
    RobustLoss or None
        The loss.

    Raises
    ------
    UsageError
        When the loss is unknown, or its threshold is not positive.
    """
    if kind is None:
        if threshold is not None:
            raise UsageError("robust_threshold is for robust = 'huber' or 'student'; give one of them, too")
        return None
    if kind not in ("huber", "student"):
        raise UsageError(f"robust = {kind!r}; choose 'huber' or 'student', or None for squared errors")
    if threshold is None:
        return _default(kind, n_outputs)
    if not (np.isfinite(threshold) and threshold > 0):
        raise UsageError(f"robust_threshold = {threshold}; it must be above 0")
    return RobustLoss(kind, float(threshold))


@lru_cache(maxsize=32)
def _default(kind: LossName, n_outputs: int) -> RobustLoss:
    def short_of(log_threshold: float) -> float:
        return efficiency(RobustLoss(kind, float(np.exp(log_threshold))), n_outputs) - EFFICIENCY

    return RobustLoss(kind, round(float(np.exp(scipy.optimize.brentq(short_of, np.log(0.2), np.log(200.0)))), 4))


def efficiency(loss: RobustLoss, n_outputs: int) -> float:
    """Return the variance of least squares over that of the loss, for normal errors without outliers."""
    squared, density = _normal_distances(n_outputs)
    scale = 1.0
    if loss.kind == "student":  # its own scale, as the likelihood finds it
        for _ in range(100):
            scale *= loss.moments(squared / scale, n_outputs, density).power
    found = loss.moments(squared / scale, n_outputs, density)
    return found.curvature**2 / (found.scores * scale)


def scale_of_huber(loss: RobustLoss, n_outputs: int) -> float:
    """Return ``E[w^2 d^2] / p`` for normal errors, which makes the scale of Huber's second proposal consistent."""
    squared, density = _normal_distances(n_outputs)
    return loss.moments(squared, n_outputs, density).scores


@lru_cache(maxsize=8)
def _normal_distances(n_outputs: int) -> tuple[FloatArray, FloatArray]:
    """Return squared distances of normal errors and their probabilities on a grid."""
    distance = np.linspace(1e-4, np.sqrt(n_outputs) + 9.0, 20_000)
    log_density = (n_outputs - 1) * np.log(distance) - distance**2 / 2
    density = np.exp(log_density - log_density.max())
    return distance**2, density / density.sum()
