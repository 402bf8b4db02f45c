"""Loops of an LPV plant at operating points, with all drawn plants."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from gbid.arrays import FloatArray
from gbid.control.controllers.scheduled import Scheduled
from gbid.control.tuning.plants.plant_set import PlantSet, corners
from gbid.control.tuning.plants.uncertainty import Uncertainty
from gbid.control.tuning.search.loop_family import LoopEquations, LoopFamily
from gbid.lpv import LPVModel
from gbid.operating_point import point_label
from gbid.structure.linear import Structure


@dataclass(frozen=True, eq=False)
class LoopsAtPoints(PlantSet):
    """Continuous loops of one plant and one controller structure at operating points, with all drawn plants.

    Parameters
    ----------
    structure : Structure or Scheduled
        Structure of the controller.
    equations : LoopEquations
        Symbolic closed loop of this model and structure.
    points : (m, 2) array
        Operating points of the design: pressure [bar] and speed [rpm].
    uncertainty : Uncertainty or None
        Draws of the plant for which the design must also hold.
    lpv : LPVModel, optional
        The model of the equations.
    delay_s : float
        Delay of sampling and computation in them [s].
    """

    structure: Structure | Scheduled
    equations: LoopEquations
    points: FloatArray
    uncertainty: Uncertainty | None
    lpv: LPVModel | None = None
    delay_s: float = 0.0

    def family(self, points: FloatArray, which: Sequence[int] | None = None) -> LoopFamily:
        """Return the loops at given points, or some of them."""
        scenarios, labels = self.scenarios(points)
        chosen = list(range(len(scenarios)) if which is None else which)
        return self.equations.family(scenarios[chosen], [labels[i] for i in chosen])

    def scenarios(self, points: FloatArray) -> tuple[FloatArray, list[str]]:
        """Return every plant at every point (m, 2) or (m, 16), and their names."""
        scenarios = points if self.uncertainty is None else self.uncertainty.scenarios(points)
        labels = [
            point_label(P, Omega) + (f", plant {i // len(points)}" if i >= len(points) else "")
            for i, (P, Omega) in enumerate(scenarios[:, :2])
        ]
        return scenarios, labels

    def first(self, points: FloatArray) -> list[int]:
        """Return the points nearest to the corners of the operating range."""
        return corners(points)
