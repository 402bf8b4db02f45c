"""Fit with a robust loss by iterated weights: each round solves the problem with constant weights of samples."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from gbid.arrays import BoolArray, FloatArray
from gbid.identify.kernel.blocks import reweighted
from gbid.identify.nlp.shooting import Shooting
from gbid.identify.nlp.solver import Solution
from gbid.identify.robust.loss import RobustLoss, WeightMoments, scale_of_huber

_ROUNDS = 40
_SETTLED = 1e-3  # largest change of a weight
_AT_REST = 0.01  # largest step of a round in standard deviations, which scaled parameters are in about
_NORMAL = 1.4826  # standard deviation of normal errors over their median absolute value
_SCALE_ROUNDS = 20


@dataclass(frozen=True, eq=False)
class Reweighted:
    """Problem with the weights of the samples, and what follows for the uncertainty.

    Attributes
    ----------
    unweighted : Shooting
        The problem before.
    problem : Shooting
        The problem with weights.
    moments : WeightMoments
        WeightMoments of the weights.
    light : float
        Share of the samples that count less than half.
    """

    unweighted: Shooting
    problem: Shooting
    moments: WeightMoments
    light: float

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
    """Return the minimum of a robust loss, from that of the squares.

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
        found = run(solution.unknowns, weighted)
        moved = (found.unknowns - solution.unknowns)[: problem.n_theta]
        at_rest = float(np.linalg.norm(moved)) * np.sqrt(problem.likelihood_size) < _AT_REST
        status = solution.status if at_rest else found.status  # where a round starts at its end, the solver is stuck
        solution = replace(found, status=status, iterations=solution.iterations + found.iterations)
        if at_rest or not found.status.success:
            break
    moments = loss.moments(squared[counted], rows.shape[1])
    return Reweighted(problem, weighted, moments, float((weights[counted] < 0.5).mean())), solution


def _errors(problem: Shooting, unknowns: FloatArray) -> FloatArray:
    """Return the errors of all samples of all parts, (n, n_y); zero for samples that do not count."""
    theta, starts = problem.unpack(unknowns)
    errors = problem.errors(problem.values(theta), starts)
    rows = [part.blocks.by_segment(e) for part, e in zip(problem.parts, errors, strict=True)]
    return np.concatenate([segment for part in rows for segment in part])


def _counted(problem: Shooting) -> BoolArray:
    """Return which of these samples count, (n,)."""
    rows = [part.blocks.by_segment(part.blocks.used[:, :, None]) for part in problem.parts]
    return np.concatenate([segment[:, 0] > 0 for part in rows for segment in part])


def _scale(rows: FloatArray, loss: RobustLoss, S: FloatArray | None) -> FloatArray:
    """Return the covariance of the errors without that of outliers, from the last one or from the median errors."""
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
    """Return the problem with weights of its samples, in the order of `_errors`."""
    parts, at = [], 0
    for part in problem.parts:
        own = []
        for like in part.blocks.by_segment(part.blocks.used[:, :, None]):
            own.append(weights[at : at + len(like)])
            at += len(like)
        parts.append(replace(part, blocks=reweighted(part.blocks, own)))
    return replace(problem, parts=tuple(parts), _last={}, _met={})
