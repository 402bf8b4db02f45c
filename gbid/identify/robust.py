"""Robust losses (Huber, Student) for several outputs: weights, efficiency, and reweighted fits."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import scipy

from gbid.core.arrays import BoolArray, FloatArray
from gbid.identify.kernel.blocks import reweighted
from gbid.identify.options import FitOptions, LossName
from gbid.identify.problem.nlp import Shooting
from gbid.identify.problem.solve import Solution

EFFICIENCY = 0.95
"""Efficiency of the default thresholds for normal errors without outliers."""


@dataclass(frozen=True)
class RobustLoss:
    """Loss of the squared distance ``d^2 = e' S^-1 e`` of a sample's errors e with covariance S.

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
        """Return the weights of samples with given squared distances."""
        if self.kind == "huber":
            distance = np.sqrt(np.maximum(squared, np.finfo(float).tiny))
            return np.asarray(np.minimum(1.0, self.threshold / distance))
        return np.asarray((self.threshold + n_outputs) / (self.threshold + squared))

    def elasticity(self, squared: FloatArray) -> FloatArray:
        """Return ``d w'(d) / w(d)``: relative change of the weight per relative change of the distance."""
        if self.kind == "huber":
            return np.where(squared > self.threshold**2, -1.0, 0.0)
        return np.asarray(-2 * squared / (self.threshold + squared))

    def moments(self, squared: FloatArray, n_outputs: int, share: FloatArray | float = 1.0) -> WeightMoments:
        """Return the moments of the weights of samples with given squared distances.

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
    """Moments of the weights w and distances d of errors of p outputs.

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


def robust_loss(options: FitOptions, n_outputs: int) -> RobustLoss | None:
    """Return the loss that the options of a fit select; None for squared errors.

    The default threshold has an efficiency of 95 % for normal errors.
    """
    kind, threshold = options.robust, options.robust_threshold
    if kind is None:
        return None
    return _default(kind, n_outputs) if threshold is None else RobustLoss(kind, float(threshold))


@lru_cache(maxsize=32)
def _default(kind: LossName, n_outputs: int) -> RobustLoss:
    def short_of(log_threshold: float) -> float:
        return efficiency(RobustLoss(kind, float(np.exp(log_threshold))), n_outputs) - EFFICIENCY

    return RobustLoss(kind, round(float(np.exp(scipy.optimize.brentq(short_of, np.log(0.2), np.log(200.0)))), 4))


def efficiency(loss: RobustLoss, n_outputs: int) -> float:
    """Return the variance of least squares divided by the loss's variance, for normal errors without outliers."""
    squared, density = _normal_distances(n_outputs)
    scale = 1.0
    if loss.kind == "student":  # its own scale, as the likelihood finds it
        for _ in range(100):
            scale *= loss.moments(squared / scale, n_outputs, density).power
    moments = loss.moments(squared / scale, n_outputs, density)
    return moments.curvature**2 / (moments.scores * scale)


def scale_of_huber(loss: RobustLoss, n_outputs: int) -> float:
    """Return ``E[w^2 d^2] / p`` for normal errors: consistency factor of Huber's second proposal."""
    squared, density = _normal_distances(n_outputs)
    return loss.moments(squared, n_outputs, density).scores


@lru_cache(maxsize=8)
def _normal_distances(n_outputs: int) -> tuple[FloatArray, FloatArray]:
    """Return a grid of squared distances of normal errors, with probabilities."""
    distance = np.linspace(1e-4, np.sqrt(n_outputs) + 9.0, 20_000)
    log_density = (n_outputs - 1) * np.log(distance) - distance**2 / 2
    density = np.exp(log_density - log_density.max())
    return distance**2, density / density.sum()


# ---- Fit with a robust loss, by iteratively reweighted least squares.

_ROUNDS = 40
_SETTLED = 1e-3  # largest change of a weight
_NORMAL = 1.4826  # standard deviation of normal errors over their median absolute value
_SCALE_ROUNDS = 20


@dataclass(frozen=True, eq=False)
class Reweighted:
    """Problem with weighted samples, and the moments of the weights.

    Attributes
    ----------
    problem : Shooting
        The problem with weights.
    moments : WeightMoments
        Moments of the weights.
    outlying : float
        Share of the samples that count less than half.
    """

    problem: Shooting
    moments: WeightMoments
    outlying: float

    @property
    def factors(self) -> tuple[float, float]:
        """Factors of the covariances of the weighted problem, for white and for coloured residuals.

        The Gauss-Newton Hessian of the weighted squares is the mean weight times that of the squares; the derivative of
        the weighted scores is their mean `curvature` times it. Errors are independent of the sensitivities, and their
        distribution is elliptical.
        """
        m = self.moments
        return m.weight * m.scores / (m.power * m.curvature**2), (m.weight / m.curvature) ** 2


def reweighted_solution(
    problem: Shooting, first: Solution, loss: RobustLoss, run: Callable[[FloatArray, Shooting], Solution]
) -> tuple[Reweighted | None, Solution]:
    """Return the minimum of a robust loss, starting from the least-squares solution.

    Parameters
    ----------
    problem : Shooting
        Problem of least squares.
    first : Solution
        Its solution.
    loss : RobustLoss
        The loss.
    run : callable
        Solves, from a start, a problem.

    Returns
    -------
    Reweighted or None
        Problem with weights; None where there are no finite errors.
    Solution
        The solution, with the iterations of all rounds.

    Notes
    -----
    With the covariance S of the errors, a sample has the weight ``w(d)`` of its distance ``d^2 = e' S^-1 e``. The
    minimum for constant weights lowers the loss (Holland and Welsch, 1977; for Student it is an EM step). S is that of
    the likelihood for Student. For Huber it is that of his second proposal, ``S = sum w^2 e e' / (n k)``, on which
    outliers have bounded influence. The first S is from the median absolute errors.
    """
    solution, S, counted = first, None, _counted(problem)
    weights = np.zeros(len(counted))
    for _ in range(_ROUNDS):
        rows = _errors(problem, solution.unknowns)
        if not np.isfinite(rows).all():
            return None, solution
        S = _scale(rows[counted], loss, S)
        squared = _distances(rows, S)
        before, weights = weights, loss.weight(squared, rows.shape[1])
        weighted = _with_weights(problem, weights)
        if np.abs(weights - before).max() < _SETTLED:
            break
        following = run(solution.unknowns, weighted)
        solution, at_rest = following.after(solution, problem)
        if at_rest or not following.status.success:
            break
    moments = loss.moments(squared[counted], rows.shape[1])
    return Reweighted(weighted, moments, float((weights[counted] < 0.5).mean())), solution


def _errors(problem: Shooting, unknowns: FloatArray) -> FloatArray:
    """Return the errors of all samples of all parts, (n, n_y); zero outside the cost."""
    theta, starts = problem.unpack(unknowns)
    return _samples(problem, problem.errors(problem.values(theta), starts))


def _counted(problem: Shooting) -> BoolArray:
    """Return which samples are in the cost, (n,)."""
    return _samples(problem, [part.blocks.used[:, :, None] for part in problem.parts])[:, 0] > 0


def _samples(problem: Shooting, blocks: Sequence[FloatArray]) -> FloatArray:
    """Return values given in blocks as rows of samples, over all parts."""
    parts = zip(problem.parts, blocks, strict=True)
    return np.concatenate([rows for part, values in parts for rows in part.blocks.by_segment(values)])


def _scale(rows: FloatArray, loss: RobustLoss, S: FloatArray | None) -> FloatArray:
    """Return the robust covariance of the errors, started from the last one or from median errors."""
    n_y = rows.shape[1]
    floor = np.finfo(float).tiny + 1e-30 * float((rows**2).mean())  # exact data have no errors at all
    if S is None:
        S = np.diag((_NORMAL * np.median(np.abs(rows), axis=0)) ** 2 + floor)
    consistent = scale_of_huber(loss, n_y) if loss.kind == "huber" else 1.0
    for _ in range(_SCALE_ROUNDS):
        w = loss.weight(_distances(rows, S), n_y)
        w = w**2 if loss.kind == "huber" else w
        S = (w[:, None] * rows).T @ rows / (len(rows) * consistent) + floor * np.eye(n_y)
    return S


def _distances(rows: FloatArray, S: FloatArray) -> FloatArray:
    """Return the squared distances ``e' S^-1 e``, (n,)."""
    return np.asarray(np.einsum("ky,ky->k", rows @ np.linalg.inv(S), rows))


def _with_weights(problem: Shooting, weights: FloatArray) -> Shooting:
    """Return the problem with sample weights, in the order of `_errors`."""
    parts, rest = [], weights
    for part in problem.parts:
        of_part = []
        for segment in part.blocks.by_segment(part.blocks.used[:, :, None]):
            of_segment, rest = np.split(rest, [len(segment)])
            of_part.append(of_segment)
        parts.append(replace(part, blocks=reweighted(part.blocks, of_part)))
    return replace(problem, parts=tuple(parts))
