"""Loops at operating points, with all drawn plants, and with bounds of scheduled gains."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gbid.arrays import FloatArray
from gbid.control.controllers.scheduled import Scheduled
from gbid.control.tuning.search.loop_family import LoopEquations, LoopFamily
from gbid.control.tuning.uncertainty import Uncertainty
from gbid.operating_point import point_label
from gbid.structure.linear import Structure


@dataclass(frozen=True, eq=False)
class LoopsAtPoints:
    """Loops of one plant and one controller structure at operating points, with all drawn plants.

    Parameters
    ----------
    structure : Structure or Scheduled
        Structure of the controller.
    equations : LoopEquations
        Symbolic closed loop.
    points : (m, 2) array
        Operating points of the design: pressure [bar] and speed [rpm].
    uncertainty : Uncertainty or None
        Draws of the plant for which the design must also hold.
    """

    structure: Structure | Scheduled
    equations: LoopEquations
    points: FloatArray
    uncertainty: Uncertainty | None

    def family(self, points: FloatArray, which: Sequence[int] | None = None) -> LoopFamily:
        """Return the loops at given points, or some of them."""
        scenarios = points if self.uncertainty is None else self.uncertainty.scenarios(points)
        labels = [
            point_label(P, Omega) + (f", plant {i // len(points)}" if i >= len(points) else "")
            for i, (P, Omega) in enumerate(scenarios[:, :2])
        ]
        chosen = range(len(scenarios)) if which is None else which
        return self.equations.family(scenarios[list(chosen)], [labels[i] for i in chosen])

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
