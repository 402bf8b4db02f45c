"""Shortest convex combination of gradients of the objective, plus multiples of those of limits, bounds and meetings."""

from __future__ import annotations

import numpy as np
import scipy

from gbid.arrays import BoolArray, FloatArray
from gbid.control.tuning.search.nonsmooth.active import ActiveFunctions


class GradientHull:
    """Gradients of objective and limits, and bounds at which the design lies, in units of the gains.

    Parameters
    ----------
    unit : (d,) array
        Units of the gains.
    at_lower, at_upper : (d,) array
        Whether the design is at its lower or upper bounds.
    """

    def __init__(self, unit: FloatArray, at_lower: BoolArray, at_upper: BoolArray) -> None:
        self.unit = unit
        self._aims: list[FloatArray] = []
        eye = np.eye(len(unit))
        self._others: list[FloatArray] = [*eye[at_lower], *-eye[at_upper]]

    @property
    def steepest(self) -> float:
        """Length of the longest gradient of the objective."""
        return max((float(np.linalg.norm(aim)) for aim in self._aims), default=0.0)

    def add(self, functions: ActiveFunctions, direction: FloatArray | None = None) -> bool:
        """Add the gradients at a point; return whether one of them shortens the combination along a direction."""
        aims = [piece.slope * self.unit for piece in functions.aim]
        limits = [-piece.slope * self.unit for piece in functions.limits]
        self._aims += aims
        self._others += limits
        if direction is None:
            return False
        enough = 0.5 * float(direction @ direction)
        return any(float(gradient @ direction) < enough for gradient in (*aims, *limits))

    def add_meeting(self, worse: FloatArray, free: list[FloatArray]) -> None:
        """Add the gradients of a function that must not rise, and of functions that must not change."""
        gradients = [-worse, *free, *(-row for row in free)]
        self._others += [gradient * self.unit for gradient in gradients]

    def shortest(self) -> FloatArray:
        """Return the shortest combination (d,); its direction is that of steepest ascent."""
        aims = np.array(self._aims).reshape(-1, len(self.unit)).T
        others = np.array(self._others).reshape(-1, len(self.unit)).T
        scale = max(self.steepest, 1e-300)
        lengths = np.maximum(np.linalg.norm(others, axis=0), 1e-300)
        columns = np.hstack([aims / scale, others / lengths])
        ones = np.append(np.ones(aims.shape[1]), np.zeros(others.shape[1]))
        sides = np.append(np.zeros(len(columns)), 1.0)
        if not np.isfinite(columns).all():  # without a combination there is no certificate
            return np.full(len(self.unit), np.inf)
        # bounded variables by an active set; scipy's nnls frees its memory twice where it does not converge
        weights = scipy.optimize.lsq_linear(
            np.vstack([columns, ones]), sides, (0.0, np.inf), method="bvls", max_iter=500
        ).x
        total = max(float(weights[: aims.shape[1]].sum()), 1e-300)
        return np.asarray(columns @ weights * (scale / total))
