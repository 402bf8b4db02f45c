"""What the shooting problem is made of: groups of records, what is known beforehand, what it says at a point."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from gbid.arrays import FloatArray, IntArray
from gbid.identify.kernel.block_sums import PassEngine
from gbid.identify.kernel.blocks import Blocks
from gbid.identify.kernel.sweep import Sweep
from gbid.identify.predictor import Predictor


@dataclass(frozen=True, eq=False)
class RecordGroup:
    """Segments that share one predictor and the same values of its parameters.

    Attributes
    ----------
    predictor : Predictor
    blocks : Blocks
    index : (n_p,) integer array
        Which of the problem's parameters are those of the predictor.
    engine : PassEngine
        Runs the pass.
    tie : (n_own, n_p) array or None
        When the predictor's own parameters are linear in the problem's, ``own = tie @ theta[index]``; None when they
        are those of `index` themselves.
    """

    predictor: Predictor
    blocks: Blocks
    index: IntArray
    engine: PassEngine
    tie: FloatArray | None = None

    def own(self, theta: FloatArray) -> FloatArray:
        """Values of the predictor's parameters at the problem's parameters."""
        return theta[self.index] if self.tie is None else np.asarray(self.tie @ theta[self.index])

    @property
    def noise(self) -> IntArray:
        """Which of the problem's parameters only the disturbance gain depends on."""
        rows = list(self.predictor.noise)
        if self.tie is None:
            return self.index[rows]
        return self.index[np.flatnonzero(self.tie[rows].any(axis=0))]

    def within_bounds(self, theta: FloatArray) -> bool:
        """Whether parameters that are tied lie where the predictor allows them: no bound of an unknown says so."""
        if self.tie is None:
            return True
        free = self.predictor.free
        return all(q.lower <= v <= q.upper for q, v in zip(free, self.own(theta).tolist(), strict=True))


class Iterate(NamedTuple):
    """What a solver asks for at one point, in scaled units.

    Attributes
    ----------
    cost : float
    gradient : (n_unknowns,) array
    gaps : (n_gaps,) array
    jacobian : (n_nonzeros,) array
        Entries of the Jacobian of the gaps, where the problem's pattern has them.
    hessian : (n_nonzeros,) array
        Entries of the upper triangle, where the problem's pattern has them.
    sweeps : tuple of Sweep
        What the pass says of each part, in physical units; empty where the problem has no value.
    factor : float
        What brings the sums of a sweep to the scale of the cost.
    """

    cost: float
    gradient: FloatArray
    gaps: FloatArray
    jacobian: FloatArray
    hessian: FloatArray
    sweeps: tuple[Sweep, ...]
    factor: float


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
    """What is known of parameters beforehand: normal, independent.

    Attributes
    ----------
    mean : (n_p,) array
    information : (n_p,) array
        Inverse variances; zero where nothing is known.
    """

    mean: FloatArray
    information: FloatArray
