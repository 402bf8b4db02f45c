"""Tuned designs and their performance in HDF5 (kind ``tuning``)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np

from gbid import hdf5
from gbid.arrays import BoolArray, FloatArray
from gbid.control.assessment.assess import Assessment
from gbid.control.assessment.point_assessment import FIGURES, LOWEST_IS_WORST
from gbid.control.impact.half_sine import HalfSine
from gbid.control.loop.sampling import Method
from gbid.control.tuning.gain_result import GainResult
from gbid.hdf5 import Stored

KIND = hdf5.FileKind("tuning", "make it again with `gbid tune`", (None,))
_VERDICTS = ("stable", "sampled_stable", "exceeds_travel")


@dataclass(frozen=True, eq=False)
class DesignFigures:
    """Performance of a design at operating points, as numbers.

    Attributes
    ----------
    name, structure : str
        Names of design and structure.
    gains : dict of str to float
        Gains by name.
    points : (m, 2) array
        Operating points: pressure [bar], speed [rpm].
    figures : (m, 12) array
        Figures in the order and units of `gbid.control.assessment.point_assessment.FIGURES`.
    stable, sampled_stable, exceeds_travel : (m,) boolean array
        At each point: whether the continuous loop is stable; whether the sampled loop is stable; whether the impact
        needs more travel than a stack has.
    """

    name: str
    structure: str
    gains: Annotated[Mapping[str, float], Stored("", "gains", "gains")]
    points: Annotated[FloatArray, Stored("bar, rpm", "operating points", "points 2")]
    figures: Annotated[FloatArray, Stored("SI", "figures of the design at the points", "points figures")]
    stable: Annotated[BoolArray, Stored("", "stable, at the points", "points")]
    sampled_stable: Annotated[BoolArray, Stored("", "sampled stable, at the points", "points")]
    exceeds_travel: Annotated[BoolArray, Stored("", "exceeds travel, at the points", "points")]

    @classmethod
    def of(cls, assessment: Assessment) -> DesignFigures:
        """Return the numbers of an assessment."""
        points = [(q.pressure_bar, q.speed_rpm) for q in assessment.points]
        figures = [[q.figures()[name] for name in FIGURES] for q in assessment.points]
        verdicts = (np.array([getattr(q, name) for q in assessment.points]) for name in _VERDICTS)
        about = assessment.name, assessment.structure, assessment.gains
        return cls(*about, np.array(points), np.array(figures), *verdicts)

    def at(self, row: int) -> dict[str, float]:
        """Return the figures at one of the points, by name."""
        return dict(zip(FIGURES, map(float, self.figures[row]), strict=True))

    @property
    def worst(self) -> dict[str, tuple[float, tuple[float, float]]]:
        """Worst value of each figure and the operating point where it occurs."""
        found = {}
        for name, column in zip(FIGURES, self.figures.T, strict=True):
            row = int((np.argmin if name in LOWEST_IS_WORST else np.argmax)(column))
            found[name] = (float(column[row]), (float(self.points[row, 0]), float(self.points[row, 1])))
        return found


class CappedDesign(NamedTuple):
    """Design under a cap on the peak of S_o.

    Attributes
    ----------
    cap : float
        The cap.
    result : GainResult
        The design.
    """

    cap: float
    result: GainResult


class RobustPromise(NamedTuple):
    """What a robust design promises on plants that it has not seen, beside the nominal design.

    Attributes
    ----------
    probability, confidence : float
        Probability of the promise, and its confidence.
    promised : float
        Objective that a plant reaches with this probability; minus infinity when there were too few draws.
    keeps_limits : float
        Lower confidence bound of the probability that a plant keeps all limits.
    plants : int
        Number of drawn plants for which the design was optimised.
    fresh : int
        Number of drawn plants that verified it.
    of_nominal : float
        Objective that the nominal design reaches with this probability.
    limits_of_nominal : float
        Share of the plants in which the nominal design keeps the limits.
    nominal : float
        Objective of the nominal design on the nominal plant.
    """

    probability: float
    confidence: float
    promised: float
    keeps_limits: float
    plants: int
    fresh: int
    of_nominal: float
    limits_of_nominal: float
    nominal: float

    @property
    def holds(self) -> bool:
        """Whether the promise is finite, and the limits hold with the probability as well."""
        return bool(np.isfinite(self.promised) and self.keeps_limits >= self.probability)


@dataclass(frozen=True, eq=False)
class TunedDesign:
    """Tuned design with its performance.

    Attributes
    ----------
    name : str
        Name of the design.
    plant : str
        Name of the model for which it was tuned.
    result : GainResult
        Result of the tuning. Read from a file it has no structure; the controller file contains that.
    performance : tuple of DesignFigures
        Performance of the design, and of the published controller if there is one.
    front : tuple of CappedDesign
        Designs of the same structure under other caps on the peak of S_o, in rising order.
    impact : HalfSine
        Impact for the figures.
    sample_time : float
        Sample time of the sampled loop [s]; its computation takes one sample.
    method : {"tustin", "zoh"}
        Discretisation of the controller.
    promises : tuple of RobustPromise
        Of a robust design: its promise, and those of designs for other probabilities, in rising order.
    """

    name: str
    plant: str
    result: GainResult
    performance: tuple[DesignFigures, ...]
    front: tuple[CappedDesign, ...]
    impact: HalfSine
    sample_time: float
    method: Method = "tustin"
    promises: tuple[RobustPromise, ...] = ()


def save_tuned(design: TunedDesign, path: str | Path, overwrite: bool = False) -> None:
    """Write a tuned design to an HDF5 file.

    Raises
    ------
    UsageError
        When the file exists and `overwrite` is not set.
    DataError
        When the file cannot be written.
    """
    with hdf5.writing(path, KIND, overwrite) as file:
        hdf5.write_fields(file, design)
        for performance in file["performance"].values():
            hdf5.add_texts(performance["figures"], "columns", FIGURES)


def load_tuned(path: str | Path) -> TunedDesign:
    """Return the tuned design in an HDF5 file of `save_tuned`.

    Raises
    ------
    DataError
        When the file is missing, unreadable, incomplete or of another kind.
    """
    return hdf5.load(path, KIND, TunedDesign)
