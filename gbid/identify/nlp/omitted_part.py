"""Part of the Hessian that Gauss-Newton omits: the errors times the second derivatives of the predictor."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from gbid.arrays import FloatArray
from gbid.identify.kernel.kernel_protocol import Moved
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


def omitted_part(
    problem: Shooting,
    theta: FloatArray,
    starts: FloatArray,
    ends: FloatArray,
    curvatures: Sequence[FloatArray],
    weight: FloatArray,
    wanted: Sequence[Sequence[int]] | None = None,
) -> list[PartHessian]:
    """Return the second derivatives of cost and weighted window ends that Gauss-Newton omits, part by part.

    They are by the own parameters of each predictor and by the starts of its windows.

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
        sum of the shares sets the steps of differences.
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
    windows = [slice(a, b) for a, b in pairwise(problem.first_window)]
    found = []
    for k, (part, v, own) in enumerate(zip(problem.parts, problem.values(theta), windows, strict=True)):
        n_own = len(part.predictor.free)
        columns = range(n_own) if wanted is None else wanted[k]
        sizes = (n_own, n_own), (part.blocks.n_windows, n_own, problem.n_states)
        if not np.isfinite(curvature).all():  # no steps can be chosen where the errors overflow
            found.append(PartHessian(*(np.full(size, np.nan) for size in sizes)))
        elif len(columns):
            moved = _moved(problem, part, theta, columns, units)
            made = part.kernel.left_out(v, part.blocks, starts[own], ends[own], weight, moved)
            found.append(PartHessian(*made))
        else:
            found.append(PartHessian(*(np.zeros(size) for size in sizes)))
    return found


def _moved(
    problem: Shooting, part: RecordGroup, theta: FloatArray, columns: Sequence[int], units: FloatArray
) -> list[Moved]:
    """Return predictors of a part with one own parameter moved within its bounds, for each of some parameters."""
    here = np.array(part.own(theta), float)
    own = np.tile(here, (len(columns) + 1, 1))  # the point itself is the first
    steps = []
    for row, j in zip(own[1:], columns, strict=True):
        onto = np.eye(len(here))[j] if part.tie is None else np.abs(part.tie[j])
        step = _DIFFERENCE * float((onto * units[part.index]).max())
        step = min(step, _MOST * max(abs(float(here[j])), float((onto * problem.theta_scale[part.index]).max())))
        steps.append(-step if here[j] + step > part.predictor.free[j].upper else step)
        row[j] += steps[-1]
    values = part.predictor.at_each(own)[1:]
    return [Moved(j, step, v) for j, step, v in zip(columns, steps, values, strict=True)]
