"""Order of the surfaces: cross-validation over operating points, and lack-of-fit test."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from scipy.special import fdtrc

from gbid.arrays import FloatArray
from gbid.brief import Brief
from gbid.errors import DataError
from gbid.hdf5 import Stored
from gbid.lpv.basis import SCHEDULING
from gbid.lpv.surface_fit.terms import HIGHEST_ORDER, check_points, orthonormal, varying_exponents
from gbid.structure.scheduling.monomials import Exponents


@dataclass(frozen=True, eq=False)
class OrderScore(Brief):
    """Cross-validation score of polynomials of one order.

    Attributes
    ----------
    order : int
        Order of the polynomials.
    rms : (14,) array
        Root mean square of estimate minus prediction over all recordings, each predicted from the other operating
        points, SI per kg. nan when the operating points do not determine polynomials of this order.
    score : float
        Geometric mean of the rms over the parameters, relative to the lowest order; below one is better.
    why_not : str
        Reason why the order is not possible; otherwise empty.
    """

    order: Annotated[int, Stored("1", "orders compared")]
    rms: Annotated[FloatArray, Stored("SI per kg", "rms error of that prediction, orders by parameters", "k")]
    score: Annotated[float, Stored("1", "prediction of points left out, relative")]
    why_not: str = ""


def compare_orders(
    points: FloatArray, values: FloatArray, scheduling: Sequence[str] = SCHEDULING
) -> tuple[OrderScore, ...]:
    """Return the scores of the orders 0 to 3, by leave-one-operating-point-out cross-validation.

    Terms in a variable that is the same at all points are left out of each order.

    Parameters
    ----------
    points : (n, n_variables) array
        Operating points.
    values : (n, k) array
        Estimates.
    scheduling : sequence of str
        Names of the scheduling variables, for messages.

    Returns
    -------
    tuple of OrderScore
    """
    scores: list[OrderScore] = []
    lowest = np.nan
    for order in range(HIGHEST_ORDER + 1):
        try:
            rms = _left_out(points, values, varying_exponents(points, order), scheduling)
        except DataError as error:
            scores.append(OrderScore(order, np.full(values.shape[1], np.nan), np.nan, str(error)))
            continue
        level = float(np.mean(np.log(np.maximum(rms, 1e-300))))
        lowest = level if np.isnan(lowest) else lowest
        scores.append(OrderScore(order, rms, float(np.exp(level - lowest))))
    return tuple(scores)


def best_order(scores: tuple[OrderScore, ...], highest: int = 2) -> int:
    """Return the order with the best score, up to `highest`; 0 where no order can be compared, as with one point."""
    possible = [s for s in scores if s.order <= highest and np.isfinite(s.score)]
    return min(possible, key=lambda s: s.score).order if possible else 0


def lack_of_fit(
    points: FloatArray, values: FloatArray, exponents: Exponents, scheduling: Sequence[str] = SCHEDULING
) -> FloatArray:
    """Return the p-value of the lack-of-fit test of the surfaces, (k,).

    This is the classical F test: the deviation of the means of the operating points from the surface is compared with
    the scatter of recordings at one point. It is nan without repeated recordings, or without more points than terms.
    """
    _, group = np.unique(points, axis=0, return_inverse=True)
    group = group.ravel()
    n_points, n = int(group.max()) + 1, len(points)
    if n == n_points or n_points == len(exponents):
        return np.full(values.shape[1], np.nan)
    counts = np.bincount(group)[:, None]
    means = np.stack([np.bincount(group, column) for column in values.T], axis=-1) / counts
    Q = orthonormal(points, exponents, scheduling).columns
    surface = Q @ np.linalg.lstsq(Q, values, rcond=None)[0]
    pure = ((values - means[group]) ** 2).sum(axis=0) / (n - n_points)
    missed = ((means[group] - surface) ** 2).sum(axis=0) / (n_points - len(exponents))
    ratio = np.divide(missed, pure, out=np.full(len(pure), np.inf), where=pure > 0)
    return np.asarray(fdtrc(n_points - len(exponents), n - n_points, ratio))


def _left_out(points: FloatArray, values: FloatArray, exponents: Exponents, scheduling: Sequence[str]) -> FloatArray:
    distinct, group = np.unique(points, axis=0, return_inverse=True)
    group = group.ravel()
    check_points(points, exponents, scheduling)
    columns = orthonormal(points, exponents, scheduling).columns
    errors = np.empty_like(values)
    for i in range(len(distinct)):
        out = group == i
        check_points(points[~out], exponents, scheduling)
        found = np.linalg.lstsq(columns[~out], values[~out], rcond=None)[0]
        errors[out] = values[out] - columns[out] @ found
    return np.asarray(np.sqrt(np.mean(errors**2, axis=0)))
