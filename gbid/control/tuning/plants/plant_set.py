"""Plants of a design: loops at any of their points, and the points with which a search starts."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any

import numpy as np

from gbid.arrays import FloatArray
from gbid.control.controllers.scheduled import Scheduled
from gbid.control.tuning.search.loop_family import LoopFamily
from gbid.operating_point import point_label


class PlantSet(ABC):
    """Plants with one controller structure, whose loops have common gains."""

    structure: Any
    """Structure or Scheduled."""

    @abstractmethod
    def family(self, points: FloatArray, which: Sequence[int] | None = None) -> LoopFamily:
        """Return the loops at points (m, 2), or some of them."""

    @abstractmethod
    def first(self, points: FloatArray) -> list[int]:
        """Return the indices of the loops with which a search over many loops starts."""

    def gain_limits(self, points: FloatArray) -> tuple[tuple[str, FloatArray, float], ...]:
        """Return the bounds of scheduled gains at the points, as rows over the coefficients in units of their width."""
        if not isinstance(self.structure, Scheduled):
            return ()
        names = [parameter.name for parameter in self.structure.parameters]
        units = np.eye(len(names))
        rows = []
        for P, Omega in dict.fromkeys(map(tuple, points)):
            columns = [self.structure.gains(dict(zip(names, unit, strict=True)), P, Omega) for unit in units]
            for gain in self.structure.base.parameters:
                row = np.array([float(column[gain.name]) for column in columns])
                width = gain.upper - gain.lower
                where = f"{gain.name} at {point_label(P, Omega)}"
                rows.append((f"upper bound of {where}", row / width, gain.upper / width))
                rows.append((f"lower bound of {where}", -row / width, -gain.lower / width))
        return tuple(rows)


def corners(points: FloatArray) -> list[int]:
    """Return the indices of the points nearest to the corners of the rectangle that contains all points."""
    low, high = points.min(axis=0), points.max(axis=0)
    unit = (points - low) / np.where(high > low, high - low, 1.0)
    places = [(0.0, 0.0), (0.0, 1.0), (1.0, 0.0), (1.0, 1.0)]
    return list(dict.fromkeys(int(np.argmin(((unit - corner) ** 2).sum(axis=1))) for corner in places))
