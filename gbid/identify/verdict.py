"""Verdict on a fit: whether what the solver calls converged is an estimate."""

from __future__ import annotations

import numpy as np

from gbid.arrays import BoolArray, FloatArray
from gbid.identify.data import column_means
from gbid.identify.nlp.shooting import Shooting
from gbid.identify.status import FitStatus

_WORSE = 0.01  # part by which the loss may exceed that of a constant: its mean takes a little of the noise along
_OF_A_MEAN = 10.0  # the same for short records, over the number of samples


def explains_nothing(problem: Shooting, products: FloatArray, outputs: list[FloatArray]) -> bool:
    """Return whether the errors are larger than those of a constant for each record, its mean.

    Parameters
    ----------
    problem : Shooting
        Problem of the fit, for its criterion.
    products : (n_y, n_y) array
        Sum of the products of the errors.
    outputs : list of (n_samples, n_y) array
        Outputs of each record that are in the cost.
    """
    centred = [y - column_means(y) for y in outputs if len(y)]
    constant = problem.cost(np.asarray(sum(y.T @ y for y in centred)))
    cost = problem.cost(products)
    return not cost <= constant + 0.5 * float(np.log1p(_WORSE + _OF_A_MEAN / problem.n_samples))


def verdict(
    status: FitStatus, *, overflows: bool, worse_than_constant: bool, at_edge: bool, undetermined: BoolArray
) -> FitStatus:
    """Return the status of a fit, which is a success only for an estimate.

    The solver has checked the first-order optimality already (`gbid.identify.nlp.optimality`).

    Parameters
    ----------
    status : FitStatus
        Status of the solver.
    overflows : bool
        Whether the errors or the parameters are not finite.
    worse_than_constant : bool
        Result of `explains_nothing`.
    at_edge : bool
        Whether the disturbance gain makes a predictor unstable or almost so, see `Shooting.parts_at_edge`.
    undetermined : (n_free,) boolean array
        Free parameters without a finite standard deviation that lie on no bound.
    """
    if overflows:
        return FitStatus.OVERFLOW
    if not status.success:
        return status
    if worse_than_constant:
        return FitStatus.WORSE_THAN_CONSTANT
    if at_edge:
        return FitStatus.UNSTABLE_PREDICTOR
    return FitStatus.NOT_DETERMINED if undetermined.any() else status
