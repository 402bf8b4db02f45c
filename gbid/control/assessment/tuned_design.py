"""Tuned design and its performance, in HDF5 (kind ``tuning``)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from gbid.arrays import BoolArray, FloatArray
from gbid.control.assessment.assess import Assessment
from gbid.control.assessment.point_assessment import FIGURES, LOWEST_IS_WORST
from gbid.control.impact.half_sine import HalfSine
from gbid.control.loop.sampling import Method
from gbid.control.tuning.gain_result import GainResult, GainStatus, WorstMode
from gbid.control.tuning.search.step import SearchStep
from gbid.hdf5 import add_dataset, read_attribute, read_dataset, reading, writing

KIND = "tuning"
_WHERE_KNOWN = ("peak_sensitivity", "peak_control", "static_amplification", "sample_time")
_TEXTS = ("objective", "status", "verified_on")
_NUMBERS = ("value", "violation")
_LISTS = ("active", "notes")
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
    gains: Mapping[str, float]
    points: FloatArray
    figures: FloatArray
    stable: BoolArray
    sampled_stable: BoolArray
    exceeds_travel: BoolArray

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
    front : tuple of (cap, GainResult)
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
    front: tuple[tuple[float, GainResult], ...]
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
    with writing(path, KIND, overwrite) as file:
        file.attrs.update({"name": design.name, "plant": design.plant, "sample_time": design.sample_time})
        file.attrs["method"] = design.method
        file.attrs.update({"peak_n": design.impact.peak_n, "duration_s": design.impact.duration_s})
        _write_result(file.create_group("result"), design.result)
        for i, performance in enumerate(design.performance):
            group = file.create_group(f"performance/{i:03d}")
            group.attrs.update({"name": performance.name, "structure": performance.structure})
            _write_gains(group, performance.gains)
            add_dataset(group, "points", performance.points, "bar, rpm", "operating points")
            add_dataset(group, "figures", performance.figures, "SI", "figures of the design at the points")
            _write_texts(group["figures"], "columns", FIGURES)
            for name in _VERDICTS:
                add_dataset(group, name, getattr(performance, name), "", f"{name.replace('_', ' ')}, at the points")
        for i, (cap, result) in enumerate(design.front):
            group = file.create_group(f"front/{i:03d}")
            group.attrs["cap"] = cap
            _write_result(group, result)


def load_tuned(path: str | Path) -> TunedDesign:
    """Read what `save_tuned` stored.

    Raises
    ------
    DataError
        When the file is missing, unreadable, incomplete or of another kind.
    """
    with reading(path, KIND) as file:
        performance = tuple(
            DesignFigures(
                str(read_attribute(group, "name")),
                str(read_attribute(group, "structure")),
                _read_gains(group),
                read_dataset(group, "points"),
                read_dataset(group, "figures"),
                *(np.asarray(read_dataset(group, name), bool) for name in _VERDICTS),
            )
            for group in file.get("performance", {}).values()
        )
        front = tuple((float(read_attribute(g, "cap")), _read_result(g)) for g in file.get("front", {}).values())
        impact = HalfSine(*(float(read_attribute(file, key)) for key in ("peak_n", "duration_s")))
        name, plant = (str(read_attribute(file, key)) for key in ("name", "plant"))
        return TunedDesign(
            name,
            plant,
            _read_result(file["result"]),
            performance,
            front,
            impact,
            float(read_attribute(file, "sample_time")),
            read_attribute(file, "method"),
        )


def _write_result(group: h5py.Group, result: GainResult) -> None:
    group.attrs.update({name: str(getattr(result, name)) for name in _TEXTS})
    group.attrs.update({name: getattr(result, name) for name in (*_NUMBERS, "success")})
    group.attrs.update({name: getattr(result, name) for name in _WHERE_KNOWN if getattr(result, name) is not None})
    for name in _LISTS:
        _write_texts(group, name, getattr(result, name))
    worst = result.worst
    group.attrs.update({"worst_where": worst.where, "worst_hz": worst.frequency_hz, "worst_damping": worst.damping})
    _write_gains(group, result.gains)
    points = np.array(result.points, float).reshape(-1, 2)
    add_dataset(group, "points", points, "bar, rpm", "operating points of the design")
    steps = np.array([(s.count, s.value, s.violation) for s in result.history], float).reshape(-1, 3)
    add_dataset(group, "history", steps, "", "designs evaluated, best aim, its violation")
    _write_texts(group["history"], "stages", [step.stage for step in result.history])


def _read_result(group: h5py.Group) -> GainResult:
    found: dict[str, Any] = {name: str(read_attribute(group, name)) for name in _TEXTS}
    found["status"] = GainStatus(found["status"])
    found |= {name: float(read_attribute(group, name)) for name in _NUMBERS}
    found |= {name: float(group.attrs[name]) for name in _WHERE_KNOWN if name in group.attrs}
    found |= {name: _read_texts(group, name) for name in _LISTS}
    steps = zip(_read_texts(group["history"], "stages"), read_dataset(group, "history"), strict=True)
    return GainResult(
        _read_gains(group),
        success=bool(read_attribute(group, "success")),
        worst=WorstMode(
            str(read_attribute(group, "worst_where")),
            float(read_attribute(group, "worst_hz")),
            float(read_attribute(group, "worst_damping")),
        ),
        history=tuple(SearchStep(stage, int(n), float(value), float(over)) for stage, (n, value, over) in steps),
        points=tuple((float(p), float(n)) for p, n in read_dataset(group, "points")),
        **found,
    )


def _write_gains(group: h5py.Group, gains: Mapping[str, float]) -> None:
    add_dataset(group, "gains", np.array(list(gains.values()), float), "", "gains")
    _write_texts(group["gains"], "names", gains)


def _read_gains(group: h5py.Group) -> dict[str, float]:
    return dict(zip(_read_texts(group["gains"], "names"), map(float, read_dataset(group, "gains")), strict=True))


def _write_texts(item: h5py.HLObject, name: str, texts: Iterable[str]) -> None:
    listed = list(texts)
    item.attrs.create(name, listed, dtype=h5py.string_dtype(), shape=(len(listed),))


def _read_texts(item: h5py.HLObject, name: str) -> tuple[str, ...]:
    return tuple(str(text) for text in read_attribute(item, name))
