"""Which recordings an experiment will have, known before any is made."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from gbid.experiment.problems import Location
from gbid.experiment.schema import ExperimentFile, ImportedSection, OperatingPoint, RigSection
from gbid.units import SIGNALS

RIG_SIGNALS = {name: SIGNALS[name].channels for name in ("r", "u", "p", "phi")}
"""Signals of the virtual rig and their channels."""


@dataclass(frozen=True)
class PlannedRecording:
    """A recording to be made or imported.

    Attributes
    ----------
    name : str
    excited : bool
        Whether the piezos move; false for a stationary run.
    conditions : dict of str to float
        Operating point.
    signals : dict of str to tuple of str
        Names of its signals and their channels.
    location : tuple
        Where the YAML asks for it.
    imported : ImportedSection or None
        How to read it; None for a recording of the rig.
    """

    name: str
    excited: bool
    conditions: Mapping[str, float]
    signals: Mapping[str, tuple[str, ...]]
    location: Location
    imported: ImportedSection | None = None

    @property
    def point(self) -> str:
        """Operating point as a word, e.g. ``p5_n6000``; ``any`` when the conditions do not tell."""
        pressure, speed = self.conditions.get("pressure_bar"), self.conditions.get("speed_rpm")
        parts = [f"{letter}{v:g}" for letter, v in (("p", pressure), ("n", speed)) if v is not None]
        return "_".join(parts) or "any"


def planned_recordings(spec: ExperimentFile) -> Iterator[PlannedRecording]:
    """List the recordings, those of the rig first; names may still occur twice."""
    if spec.rig is not None:
        for i, point in enumerate(spec.rig.operating_points):
            yield from _of_rig(spec.rig, point, ("rig", "operating_points", i))
    if spec.imported is not None:
        for i, entry in enumerate(spec.imported.recordings):
            yield PlannedRecording(
                entry.name,
                entry.kind == "excited",
                entry.conditions,
                {name: _channels(name, len(c.columns), c.channels) for name, c in entry.signals.items()},
                ("import", "recordings", i),
                entry,
            )


def _of_rig(rig: RigSection, point: OperatingPoint, location: Location) -> Iterator[PlannedRecording]:
    conditions = {"pressure_bar": point.pressure_bar, "speed_rpm": point.speed_rpm}
    label = f"p{point.pressure_bar:g}_n{point.speed_rpm:g}"
    for i in range(rig.stationary.recordings):
        yield PlannedRecording(f"{label}_still{i + 1}", False, conditions, RIG_SIGNALS, location)
    for i in range(rig.prbs.recordings):
        yield PlannedRecording(f"{label}_prbs{i + 1}", True, conditions, RIG_SIGNALS, location)


def _channels(signal: str, count: int, given: tuple[str, ...] | None) -> tuple[str, ...]:
    if given:
        return given
    known = SIGNALS.get(signal)
    return known.channels if known else tuple(str(i + 1) for i in range(count))
