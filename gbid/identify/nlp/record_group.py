"""Parts of the shooting problem: groups of records, prior knowledge, and values at a point."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from gbid.arrays import FloatArray, IntArray
from gbid.identify.kernel.blocks import Blocks
from gbid.identify.kernel.general_predictor import GeneralPredictor
from gbid.identify.kernel.kernel_protocol import Kernel
from gbid.identify.kernel.sweep import Sweep


@dataclass(frozen=True, eq=False)
class RecordGroup:
    """Segments with the same predictor and the same values of its parameters.

    Attributes
    ----------
    predictor : GeneralPredictor
        Predictor of all segments.
    blocks : Blocks
        The segments, cut into blocks.
    index : (n_p,) integer array
        Positions of the predictor's parameters in those of the problem.
    kernel : Kernel
        Kernel of the recursion over the blocks.
    tie : (n_own, n_p) array or None
        Matrix of parameters that are linear in those of the problem, ``own = tie @ theta[index]``; None when they are
        equal to those of `index`.
    """

    predictor: GeneralPredictor
    blocks: Blocks
    index: IntArray
    kernel: Kernel
    tie: FloatArray | None = None

    def own(self, theta: FloatArray) -> FloatArray:
        """Return the values of the predictor's parameters for parameters of the problem."""
        return theta[self.index] if self.tie is None else np.asarray(self.tie @ theta[self.index])

    @property
    def noise(self) -> IntArray:
        """Which of the problem's parameters only the disturbance gain depends on."""
        rows = list(self.predictor.noise)
        if self.tie is None:
            return self.index[rows]
        return self.index[np.flatnonzero(self.tie[rows].any(axis=0))]

    def within_bounds(self, theta: FloatArray) -> bool:
        """Return whether tied parameters are inside the predictor's bounds; bounds of unknowns do not ensure it."""
        if self.tie is None:
            return True
        free = self.predictor.free
        return all(q.lower <= v <= q.upper for q, v in zip(free, self.own(theta).tolist(), strict=True))


class Iterate(NamedTuple):
    """Values at one point for the solver, in scaled units.

    Attributes
    ----------
    cost : float
        Cost.
    gradient : (n_unknowns,) array
        Gradient of the cost.
    gaps : (n_gaps,) array
        Gaps between windows.
    jacobian : (n_nonzeros,) array
        Entries of the Jacobian of the gaps, in the order of its pattern.
    hessian : (n_nonzeros,) array
        Entries of the upper triangle of the Hessian, in the order of its pattern.
    sweeps : tuple of Sweep
        Results of the pass for each part, in physical units; empty where the problem has no value.
    factor : float
        Factor from the sums of a sweep to the scale of the cost.
    extra_rows, extra_slopes : (n_rows,) and (n_rows, n_used) array
        Constraints of the caller and their derivatives by the unknowns that they use.
    rate : float
        Largest growth of a small deviation in a sample; infinite where the predictor overflows.
    """

    cost: float
    gradient: FloatArray
    gaps: FloatArray
    jacobian: FloatArray
    hessian: FloatArray
    sweeps: tuple[Sweep, ...]
    factor: float
    extra_rows: FloatArray = np.zeros(0)
    extra_slopes: FloatArray = np.zeros((0, 0))
    rate: float = np.inf


class GroupGradient(NamedTuple):
    """What a part adds to the gradient of the Lagrangian, without the prior.

    Attributes
    ----------
    theta : (n_p,) array
        By parameters: those at the part's `index`, or the predictor's own.
    starts : (n_windows, n) array
        By its windows' starts; that another window is to end there is left out.
    """

    theta: FloatArray
    starts: FloatArray


class Prior(NamedTuple):
    """Prior knowledge of parameters: independent normal distributions.

    Attributes
    ----------
    mean : (n_p,) array
        Means.
    information : (n_p,) array
        Inverse variances; zero without prior knowledge.
    """

    mean: FloatArray
    information: FloatArray


def tied_limits(parts: Sequence[RecordGroup], theta_scale: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the linear constraints that are bounds of tied parameters, which are sums of several unknowns.

    Returns
    -------
    (n_limits, n_theta) array
        Matrix from the scaled unknowns to the parameters in units of their own scales.
    (n_limits,) array, (n_limits,) array
        Lower and upper bounds.
    """
    rows, lower, upper = [], [], []
    for part in parts:
        if part.tie is None:
            continue
        for q, tie in zip(part.predictor.free, part.tie, strict=True):
            row = np.zeros(len(theta_scale))
            row[part.index] = tie * theta_scale[part.index]
            size = float(np.abs(row).max())
            if size > 0 and np.isfinite([q.lower, q.upper]).any():
                rows.append(row / size)
                lower.append(q.lower / size)
                upper.append(q.upper / size)
    return np.array(rows).reshape(-1, len(theta_scale)), np.array(lower), np.array(upper)
