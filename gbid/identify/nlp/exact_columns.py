"""Exact columns of the Hessian by differences of the adjoint gradient; they include what Gauss-Newton omits."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from gbid.arrays import FloatArray
from gbid.identify.nlp.adjoint import own_gradients
from gbid.identify.nlp.record_group import RecordGroup
from gbid.identify.nlp.shooting import Shooting

# Step of a difference, in units in which the cost has curvature one. It is small, because states with little influence
# on the outputs amplify errors in their columns. Second: largest step relative to a parameter without influence.
_DIFFERENCE, _MOST = 3e-8, 1e-4


class PartHessian(NamedTuple):
    """Hessian of a part, without the block of its window starts.

    Attributes
    ----------
    theta : (n_p, n_p) array
        Derivatives by two parameters.
    mixed : (n_windows, n_p, n) array
        Derivatives by a parameter and a window start.
    """

    theta: FloatArray
    mixed: FloatArray


def exact_columns(
    problem: Shooting,
    theta: FloatArray,
    starts: FloatArray,
    ends: FloatArray,
    curvatures: Sequence[FloatArray],
    weight: FloatArray,
    wanted: Sequence[Sequence[int]] | None = None,
) -> list[PartHessian]:
    """Return second derivatives of cost and weighted window ends, by the own parameters of each predictor.

    One pass over the samples moves one parameter of every part. So the part with the most parameters sets the number of
    passes.

    Parameters
    ----------
    problem : Shooting
        Problem of the fit.
    theta : (n_p,) array
        Parameters.
    starts : (n_windows, n) array
        States at the starts of the windows.
    ends : (n_windows, n) array
        Multipliers at the ends of the windows.
    curvatures : sequence of (n_p,) array
        For each part, its approximate share in the second derivatives of the cost by the parameters at its `index`. The
        sum of the shares sets the steps.
    weight : (n_y, n_y) array
        Constant weight of the errors; with it, parts do not depend on each other.
    wanted : sequence of sequence of int, optional
        For each part, the indices of its own parameters with a column; all when left out. Other columns are zero.

    Returns
    -------
    list of PartHessian
        Columns of each part in physical units; not finite when the errors overflow.
    """
    curvature = np.zeros(problem.n_theta)
    for part, share in zip(problem.parts, curvatures, strict=True):
        curvature[part.index] += share
    units = 1 / np.sqrt(np.maximum(curvature, np.finfo(float).tiny))
    values = problem.values(theta)
    here = own_gradients(problem, values, starts, ends, weight)
    everything = [range(len(part.predictor.free)) for part in problem.parts]
    wanted = everything if wanted is None else wanted
    columns = [
        PartHessian(np.zeros((len(own),) * 2), np.zeros((part.blocks.n_windows, len(own), problem.n_states)))
        for part, own in zip(problem.parts, everything, strict=True)
    ]
    if not np.isfinite(curvature).all():  # no steps can be chosen where the errors overflow
        for found in columns:
            found.theta.fill(np.nan)
            found.mixed.fill(np.nan)
        return columns
    for k in range(max(map(len, wanted))):
        moved = [
            _moved(problem, part, theta, own[k], units) if k < len(own) else (v, 1.0)
            for part, own, v in zip(problem.parts, wanted, values, strict=True)
        ]
        there = own_gradients(problem, [v for v, _ in moved], starts, ends, weight)
        for found, own, (_, step), after, before in zip(columns, wanted, moved, there, here, strict=True):
            if k < len(own):
                found.theta[:, own[k]] = (after.theta - before.theta) / step
                found.mixed[:, own[k]] = (after.starts - before.starts) / step
    return columns


def _moved(problem: Shooting, part: RecordGroup, theta: FloatArray, j: int, units: FloatArray) -> tuple[Any, float]:
    """Return the predictor of a part with one own parameter moved within its bounds, and the step."""
    own = np.array(part.own(theta), float)
    onto = np.eye(len(own))[j] if part.tie is None else np.abs(part.tie[j])
    step = _DIFFERENCE * float((onto * units[part.index]).max())
    step = min(step, _MOST * max(abs(float(own[j])), float((onto * problem.theta_scale[part.index]).max())))
    if own[j] + step > part.predictor.free[j].upper:
        step = -step
    own[j] += step
    return part.predictor.at(own), step
