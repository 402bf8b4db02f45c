"""Tuned design and its performance, in HDF5 (kind ``tuning``)."""

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
    gains : dict of str to float
    points : (m, 2) array
        Pressure [bar], speed [rpm].
    figures : (m, 12) array
        In the order of `gbid.control.assessment.point_assessment.FIGURES`; its units.
    stable, sampled_stable, exceeds_travel : (m,) boolean array
        At each point: of the continuous loop; of the loop as it runs; whether the impact asks for more travel than a
        stack has.
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
        """Take the numbers out of an assessment."""
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
    """A design under a cap on the peak of S_o.

    Attributes
    ----------
    cap : float
    result : GainResult
    """

    cap: float
    result: GainResult


@dataclass(frozen=True, eq=False)
class TunedDesign:
    """A tuned design.

    Attributes
    ----------
    name : str
    plant : str
        Name of the model that it was tuned on.
    result : GainResult
        Without its structure when read from a file; the controller file has it.
    performance : tuple of DesignFigures
        Of the design, and of the published one where there is one.
    front : tuple of CappedDesign
        Designs of the same structure under other caps on the peak of S_o, rising.
    impact : HalfSine
        The impact of the figures.
    sample_time : float
        Of their sampled loop [s]; its computation takes one sample.
    method : {"tustin", "zoh"}
        How the controller is sampled.
    """

    name: str
    plant: str
    result: GainResult
    performance: tuple[DesignFigures, ...]
    front: tuple[CappedDesign, ...]
    impact: HalfSine
    sample_time: float
    method: Method = "tustin"


def save_tuned(design: TunedDesign, path: str | Path, overwrite: bool = False) -> None:
    """Store a tuned design.

    Raises
    ------
    UsageError
        When the file exists and `overwrite` is not set.
    DataError
        When it cannot be written.
    """
    with hdf5.writing(path, KIND, overwrite) as file:
        hdf5.write_fields(file, design)
        for performance in file["performance"].values():
            hdf5.add_texts(performance["figures"], "columns", FIGURES)


def load_tuned(path: str | Path) -> TunedDesign:
    """Read what `save_tuned` stored.

    Raises
    ------
    DataError
        When the file is missing, unreadable, incomplete or of another kind.
    """
    return hdf5.load(path, KIND, TunedDesign)
