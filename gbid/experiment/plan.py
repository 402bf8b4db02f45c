"""Planned recordings: the recordings that an experiment will have, known before a run."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

from gbid.experiment.problems import Location
from gbid.experiment.schema import ExperimentFile
from gbid.experiment.stages.importing.folders import FoundFile
from gbid.experiment.stages.importing.schema import ImportedSection
from gbid.experiment.stages.rig.schema import CourseSection, OperatingPoint, Place, RigSection
from gbid.units import SIGNALS

RIG_SIGNALS = {name: SIGNALS[name].channels for name in ("r", "u", "p", "phi")}
"""Signals of the virtual rig with the names of their channels."""

NO_POINT = "any"
"""Word for the operating point of recordings without one."""

_STACK_SIGNALS = {name: SIGNALS[name].channels for name in ("y_p", "v", "r_p")}
_COURSE_SIGNALS = {name: SIGNALS[name].channels for name in ("pressure_bar", "speed_rpm", "unbalance")}
_LOOP_SIGNALS = {"w": SIGNALS["w"].channels}
_EXTRA_SIGNALS = {
    "stack_staircase": _STACK_SIGNALS,
    "hammer": {"f": SIGNALS["f"].channels},
    "loop": _LOOP_SIGNALS,
    "loop_still": _LOOP_SIGNALS,
}


@dataclass(frozen=True)
class PlannedRecording:
    """Recording that the rig will make or the import will read.

    Attributes
    ----------
    name : str
        Name of the recording.
    excited : bool
        Whether the piezos move; false for a stationary run.
    conditions : dict of str to float
        Operating point: ``pressure_bar`` [bar] and ``speed_rpm`` [rpm].
    signals : dict of str to tuple of str
        Names of the channels by signal.
    location : tuple
        Location of its entry in the YAML.
    imported : ImportedSection or None
        How to read the file; None for a recording of the rig.
    staircase : bool
        Whether it serves the static characterisation only. Fits and run-out maps then do not use it.
    run : tuple
        Run of the rig, for example ``("prbs",)``, ``("hammer", "x")`` or ``("course", 0)``; empty for a file.
    """

    name: str
    excited: bool
    conditions: Mapping[str, float]
    signals: Mapping[str, tuple[str, ...]]
    location: Location
    imported: ImportedSection | None = None
    staircase: bool = False
    run: tuple[str | int | bool, ...] = ()

    @property
    def kind(self) -> str:
        """Kind of recording: ``excited``, ``stationary``, ``staircase``, or another run, e.g. ``hammer``."""
        if self.excited or self.staircase:
            return "excited" if self.excited else "staircase"
        return "stationary" if self.stationary else str(self.run[0])

    @property
    def stationary(self) -> bool:
        """Whether the piezos do not move, so that run-out maps can be made from the recording."""
        return not self.excited and not self.staircase and self.run[:1] in ((), ("stationary",))

    @property
    def in_loop(self) -> bool:
        """Whether a controller of the section rig acts."""
        return self.run[:1] in (("loop",), ("loop_still",))

    @property
    def point(self) -> str:
        """Operating point as text, e.g. ``p5_n6000``; ``any`` when the conditions contain no operating point."""
        pressure, speed = self.conditions.get("pressure_bar"), self.conditions.get("speed_rpm")
        parts = [f"{letter}{v:g}" for letter, v in (("p", pressure), ("n", speed)) if v is not None]
        return "_".join(parts) or NO_POINT


def planned_recordings(spec: ExperimentFile, files: Iterable[FoundFile] = ()) -> Iterator[PlannedRecording]:
    """Yield the recordings of the rig, then those of files; names can still occur twice."""
    if spec.rig is not None:
        for i, point in enumerate(spec.rig.operating_points):
            yield from _of_rig(spec.rig, point, ("rig", "operating_points", i))
        for i, course in enumerate(spec.rig.courses):
            yield from _along(spec.rig, course, i)
    for found in files:
        entry = found.entry
        yield PlannedRecording(
            entry.name,
            entry.kind == "excited",
            entry.conditions,
            {name: _channels(name, len(c.columns), c.channels) for name, c in entry.signals.items()},
            found.location,
            entry,
            entry.kind == "staircase",
        )


def _of_rig(rig: RigSection, point: OperatingPoint, location: Location) -> Iterator[PlannedRecording]:
    conditions = {"pressure_bar": point.pressure_bar, "speed_rpm": point.speed_rpm}
    label = f"p{point.pressure_bar:g}_n{point.speed_rpm:g}"
    signals = {**RIG_SIGNALS, **(_STACK_SIGNALS if rig.actuators.record_stacks else {})}

    def planned(word: str, count: int, run: tuple[str | int | bool, ...]) -> Iterator[PlannedRecording]:
        own = {**signals, **_EXTRA_SIGNALS.get(str(run[0]), {})}
        stairs = run[0] in ("staircase", "stack_staircase")
        for i in range(count):
            name = f"{label}_{word}{i + 1}"
            excited = run[0] in ("prbs", "played", "loop")
            yield PlannedRecording(name, excited, conditions, own, location, None, stairs, run)

    yield from planned("still", rig.stationary.recordings, ("stationary",))
    prbs = rig.prbs.recordings if point.prbs_recordings is None else point.prbs_recordings
    yield from planned("prbs", prbs, ("prbs",))
    if rig.played is not None and _there(rig.played.at, point):
        yield from planned("played", rig.played.recordings, ("played",))
    if rig.loop is not None:
        offline = rig.loop.runout == "offline"
        yield from planned(
            "loop_still", int(offline) if rig.loop.stationary is None else rig.loop.stationary, ("loop_still",)
        )
        yield from planned("loop", rig.loop.recordings, ("loop",))
    if rig.staircase is not None and _there(rig.staircase.at, point):
        for axis in rig.staircase.axes:
            yield from planned(f"stairs_{axis}", rig.staircase.recordings, ("staircase", axis))
    if rig.stack_staircase is not None and _there(rig.stack_staircase.at, point):
        for stack in rig.stack_staircase.stacks:
            for controlled in rig.stack_staircase.controlled:
                word = f"stack{stack}_{'controlled' if controlled else 'open'}"
                yield from planned(word, rig.stack_staircase.recordings, ("stack_staircase", stack, controlled))
    if rig.hammer is not None:
        for axis in rig.hammer.axes:
            yield from planned(f"hammer_{axis}", rig.hammer.recordings, ("hammer", axis))
    if rig.run_up is not None:
        yield from planned("runup", rig.run_up.recordings, ("run_up",))


def _along(rig: RigSection, course: CourseSection, index: int) -> Iterator[PlannedRecording]:
    """Yield the recordings of a course; they have no operating point."""
    signals = {**RIG_SIGNALS, **_COURSE_SIGNALS, **(_STACK_SIGNALS if rig.actuators.record_stacks else {})}
    for i in range(course.recordings):
        run = ("course", index)
        yield PlannedRecording(
            f"{course.name}{i + 1}", course.excited, {}, signals, ("rig", "courses", index), None, False, run
        )


def _there(places: tuple[Place, ...] | None, point: OperatingPoint) -> bool:
    """Return whether a run is planned at an operating point; without a list it is planned at all."""
    return places is None or any((q.pressure_bar, q.speed_rpm) == (point.pressure_bar, point.speed_rpm) for q in places)


def _channels(signal: str, count: int, given: tuple[str, ...] | None) -> tuple[str, ...]:
    if given:
        return given
    known = SIGNALS.get(signal)
    return known.channels if known else tuple(str(i + 1) for i in range(count))
