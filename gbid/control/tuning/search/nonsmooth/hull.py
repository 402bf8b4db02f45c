"""Shortest convex combination of gradients of the objective, plus multiples of those of limits, bounds and meetings."""

from __future__ import annotations

import numpy as np
import scipy

from gbid.arrays import BoolArray, FloatArray
from gbid.control.tuning.search.nonsmooth.active import ActiveFunctions

_NO_CHANGE = 1e-10
"""Relative length of a gradient of a meeting that is rounding; its multiple would be without an end."""


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
        self._spreads: list[float] = [0.0] * len(self._others)

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
        self._spreads += [0.0] * len(limits)
        if direction is None:
            return False
        enough = 0.5 * float(direction @ direction)
        return any(float(gradient @ direction) < enough for gradient in (*aims, *limits))

    def add_meeting(self, worse: tuple[FloatArray, float], free: list[tuple[FloatArray, float]]) -> None:
        """Add functions that must not rise, and that must not change: gradient, and by how much it may all the same."""
        rows = [(-worse[0], worse[1]), *free, *((-row, spread) for row, spread in free)]
        lengths = [float(np.linalg.norm(gradient * self.unit)) for gradient, _ in rows]
        for (gradient, spread), length in zip(rows, lengths, strict=True):
            if length > _NO_CHANGE * max(lengths):
                self._others.append(gradient * self.unit)
                self._spreads.append(spread)

    def shortest(self) -> FloatArray:
        """Return the shortest combination (d,); its direction is that of steepest ascent."""
        return self.combination()[0]

    def combination(self) -> tuple[FloatArray, float]:
        """Return the shortest combination, and the rise by all that meetings may change."""
        aims = np.array(self._aims).reshape(-1, len(self.unit)).T
        others = np.array(self._others).reshape(-1, len(self.unit)).T
        scale = max(self.steepest, 1e-300)
        lengths = np.maximum(np.linalg.norm(others, axis=0), 1e-300)
        columns = np.hstack([aims / scale, others / lengths])
        ones = np.append(np.ones(aims.shape[1]), np.zeros(others.shape[1]))
        sides = np.append(np.zeros(len(columns)), 1.0)
        if not np.isfinite(columns).all():  # without a combination there is no certificate
            return np.full(len(self.unit), np.inf), np.inf
        # bounded variables by an active set; scipy's nnls frees its memory twice where it does not converge
        weights = scipy.optimize.lsq_linear(
            np.vstack([columns, ones]), sides, (0.0, np.inf), method="bvls", max_iter=500
        ).x
        total = max(float(weights[: aims.shape[1]].sum()), 1e-300)
        multipliers = weights[aims.shape[1] :] / lengths * (scale / total)
        return np.asarray(columns @ weights * (scale / total)), float(multipliers @ self._spreads)
