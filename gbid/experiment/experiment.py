"""Experiment: its file, its contents, and the folder of its results."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from functools import cached_property
from pathlib import Path
from typing import Any

from gbid.core.errors import DataError, UsageError
from gbid.core.files import is_changed, share_folder
from gbid.core.names import file_stem
from gbid.core.notes import DataNote
from gbid.core.units import SIGNALS
from gbid.core.yaml_file import CHANGED, YamlFile
from gbid.experiment.fields import Found, Location, Problem, Result, content_key, dotted, nearest
from gbid.experiment.rig_schema import CourseSection, OperatingPoint, Place, RigSection
from gbid.experiment.schema import (
    ExperimentFile,
    FileSection,
    FolderSection,
    ImportedSection,
    ImportSection,
    TableSection,
    name_of,
    name_pattern,
)
from gbid.recording.formats import file_formats
from gbid.recording.text_files import read_table

# ---- Entries of the import section for the files of a folder or the rows of a table.

POINT = ("pressure_bar", "speed_rpm")
_RESULTS = (".h5", ".hdf5")  # endings of our own results, which may lie in the same folder
_NAMED = 5  # largest number of files without match that are listed


@dataclass(frozen=True)
class FoundFile:
    """Recording to import, and the location of its entry in the YAML."""

    entry: ImportedSection
    location: Location


@dataclass(frozen=True)
class FoundFiles:
    """Recordings of an import section, and the problems of its folder or table.

    Attributes
    ----------
    files : tuple of FoundFile
        Recordings to import.
    problems : tuple of (location, text)
        Location in the YAML and text of each problem.
    """

    files: tuple[FoundFile, ...]
    problems: tuple[tuple[Location, str], ...]


def find_files(section: ImportSection, base: Path) -> FoundFiles:
    """Return the recordings of an import section: those listed first, then those of the folder and of the table.

    Parameters
    ----------
    section : ImportSection
        The section.
    base : pathlib.Path
        Folder of the experiment file.

    Returns
    -------
    FoundFiles
        Recordings and problems.
    """
    files = [FoundFile(entry, ("import", "recordings", i)) for i, entry in enumerate(section.recordings or ())]
    problems: list[tuple[Location, str]] = []
    folder = base / section.data_folder
    taken = {found.entry.file for found in files}
    sources: list[tuple[Location, Iterator[ImportedSection | str]]] = []
    if section.folder is not None:
        skip = taken | ({section.table.file} if section.table else set())
        sources.append((("import", "folder", "pattern"), _by_pattern(section.folder, folder, skip)))
    if section.table is not None:
        sources.append((("import", "table", "file"), _by_table(section.table, folder)))
    if section.recordings is None and not sources:
        problems.append((("import",), "lists no recordings; add recordings, folder or table"))
    if folder.is_dir():
        for location, source in sources:
            names: dict[str, str] = {}
            for found in source:
                if isinstance(found, str):
                    problems.append((location, found))
                elif found.name in names:
                    both = f"{found.file} and {names[found.name]} both give the name {found.name!r}"
                    text = f"{both}; {_distinct(section, location)}"
                    problems.append((location, text))
                else:
                    names[found.name] = found.file
                    files.append(FoundFile(found, location))
    return FoundFiles(tuple(files), tuple(problems))


def by_count(name: str) -> list[tuple[int, str]]:
    """Return a sort key that puts run2 before run10."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", name)]


def _distinct(section: ImportSection, location: Location) -> str:
    if section.table is not None and "table" in location:
        return f"give each row of {section.table.file} a name of its own"
    return "without {name} in the pattern a recording has the name of its file"


def _by_pattern(section: FolderSection, folder: Path, skip: set[str]) -> Iterator[ImportedSection | str]:
    """Yield a recording for each file whose name matches, and a text for each problem."""
    try:
        pattern = name_pattern(section.pattern)
    except UsageError as error:
        yield str(error)
        return
    more = section.more_conditions or ()
    unknown = [name for name in more if name not in pattern.numbers]
    if unknown:
        name = unknown[0]
        yield f"{section.pattern!r} has no field {name}; write {{{name}:g}}, or remove it from more_conditions"
        return
    suffix = Path(section.pattern).suffix.lower()
    if suffix not in file_formats():
        yield f"{section.pattern!r}: unknown ending {suffix!r}; expected one of {', '.join(file_formats())}"
        return
    point = _missing_point(section, pattern.numbers)
    if point:
        yield f"{section.pattern!r} has no field {point}; write {{{point}:g}} into it, or give it in conditions"
        return
    paths = folder.rglob("*") if "/" in section.pattern else folder.glob("*")
    endings = {ending for ending in file_formats() if ending not in _RESULTS or suffix in _RESULTS}
    there = sorted((p.relative_to(folder).as_posix() for p in paths if p.suffix.lower() in endings), key=by_count)
    seen = [name for name in there if not any(fnmatchcase(name, p) for p in section.ignore or ()) and name not in skip]
    unmatched = []
    matched = 0
    for file in seen:
        fields = pattern.read(file)
        if fields is None:
            unmatched.append(file)
            continue
        matched += 1
        conditions = {name: float(fields[name]) for name in pattern.numbers if name in (*POINT, *more)}
        name = name_of(str(fields.get("name", Path(file).stem)))
        yield _entry(section, file, name, str(fields["kind"]) if "kind" in fields else None, conditions)
    if not matched:
        example = f"; there is {', '.join(unmatched[:_NAMED])}" if unmatched else f"; {folder} has no such files"
        yield f"no file matches {section.pattern!r}{example}: correct the pattern or data_folder"
    elif unmatched:
        for file in unmatched[:_NAMED]:
            yield f"file {file} does not match {section.pattern!r}; rename it, or add it to ignore"
        if len(unmatched) > _NAMED:
            yield f"{len(unmatched) - _NAMED} more files do not match {section.pattern!r}"


def _by_table(section: TableSection, folder: Path) -> Iterator[ImportedSection | str]:
    """Yield a recording for each row of a table, and a text for each problem."""
    path = folder / section.file
    try:
        table = read_table(path)
        cells = table.cells
    except OSError as error:
        yield f"{path}: cannot be read: {error.strerror}; give a CSV table"
        return
    except DataError as error:
        yield f"{error}; the table has a line with the names of the columns and one line for each recording"
        return
    header = list(table.headings)
    more = section.more_conditions or ()
    needed = ["file", *more, *(name for name in _needed_point(section) if name not in section.conditions)]
    missing = [name for name in needed if name not in header]
    if missing:
        for name in missing:
            yield f"{path}: no column {name!r}; {nearest(name, header)}"
        return
    for line, texts in zip(table.rows, cells, strict=True):
        where = f"{path}: line {line.number}"
        row = {name: cell.strip() for name, cell in zip(header, texts, strict=True)}
        conditions, faults = _conditions(
            row, [*more, *(n for n in POINT if n in row and n not in more)], where, table.layout.decimal
        )
        if not row["file"]:
            faults.append(f"{where}: file is empty; name the file, or remove the line")
        elif not (folder / row["file"]).is_file():
            faults.append(f"{where}: no file {folder / row['file']}; put it there, or remove the line")
        elif Path(row["file"]).suffix.lower() not in file_formats():
            faults.append(f"{where}: file {row['file']}: unknown ending; expected one of {', '.join(file_formats())}")
        yield from faults
        if not faults:
            name = row.get("name") or name_of(Path(row["file"]).stem)
            entry = _entry(section, row["file"], name, row.get("kind") or None, conditions)
            yield f"{where}: {entry}" if isinstance(entry, str) else entry


def _conditions(
    row: Mapping[str, str], names: list[str], where: str, decimal: str
) -> tuple[dict[str, float], list[str]]:
    conditions, faults = {}, []
    for name in names:
        try:
            value = float(row[name].replace(decimal, "."))
        except ValueError:
            value = math.nan
        if math.isfinite(value):
            conditions[name] = value
        else:
            said = repr(row[name]) if row[name] else "empty"
            faults.append(f"{where}: {name} is {said}; write a number")
    return conditions, faults


def _needed_point(section: FolderSection | TableSection) -> tuple[str, ...]:
    return POINT if section.operating_point else ()


def _missing_point(section: FolderSection, there: tuple[str, ...]) -> str:
    missing = [name for name in _needed_point(section) if name not in there and name not in section.conditions]
    return missing[0] if missing else ""


def _entry(
    section: FolderSection | TableSection, file: str, name: str, word: str | None, conditions: dict[str, float]
) -> ImportedSection | str:
    """Return the entry of one file, or a text with the reason why there is none."""
    if word is not None and word not in section.kinds:
        return f"file {file}: unknown kind {word!r}; {nearest(word, section.kinds)}; add it to kinds"
    common: dict[str, Any] = {key: getattr(section, key) for key in FileSection.model_fields}
    common["conditions"] = {**section.conditions, **conditions}
    kind = section.kind if word is None else section.kinds[word]
    try:
        return ImportedSection(file=file, name=name, kind=kind, **common)
    except ValueError:
        return f"file {file}: {name!r} cannot be a name; use letters, digits, '_', '-', '+' or '.'"


# ---- Planned recordings: the recordings that an experiment will have, known before a run.

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
    controller : str
        File of the controller under which a round of the cycle is recorded, relative to the results; else empty.
    """

    name: str
    excited: bool
    conditions: Mapping[str, float]
    signals: Mapping[str, tuple[str, ...]]
    location: Location
    imported: ImportedSection | None = None
    staircase: bool = False
    run: tuple[str | int | bool, ...] = ()
    controller: str = ""

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


@dataclass(frozen=True, eq=False)
class Experiment:
    """Experiment file with its positions, and the folder of its results.

    Attributes
    ----------
    file : YamlFile
        The YAML, with line and column of each value.
    spec : ExperimentFile
        Contents of the YAML.
    results : pathlib.Path
        Folder of the results.
    folders : dict of str to str
        Folders of the results that lie elsewhere, as those of a round of the cycle.
    """

    file: YamlFile
    spec: ExperimentFile
    results: Path
    folders: Mapping[str, str] = field(default_factory=dict)

    @property
    def folder(self) -> Path:
        """Folder of the YAML; its relative paths start here."""
        return self.file.path.parent

    def folder_of(self, file: str) -> Path:
        """Return the folder to which a file name is relative: that of the experiment, or the models of gbid."""
        for folder in (self.folder, share_folder("models")):
            if (folder / file).is_file():
                return folder
        return self.folder

    @cached_property
    def recordings(self) -> Mapping[str, PlannedRecording]:
        """Recordings by name: those of the rig, then those of imported files."""
        return {planned.name: planned for planned in planned_recordings(self.spec, self.imports.files)}

    @cached_property
    def imports(self) -> FoundFiles:
        """Files that the import section names or finds in its folder, searched once."""
        section = self.spec.imported
        return find_files(section, self.folder) if section is not None else FoundFiles((), ())

    @cached_property
    def points(self) -> Mapping[str, list[PlannedRecording]]:
        """Recordings by operating point."""
        found: dict[str, list[PlannedRecording]] = {}
        for planned in self.recordings.values():
            found.setdefault(planned.point, []).append(planned)
        return found

    @cached_property
    def fits_of(self) -> Mapping[str, list[str]]:
        """Names of the fits that use a recording, by the name of the recording."""
        found: dict[str, list[str]] = {}
        for fit in self.spec.fits:
            for planned in self.fit_recordings(fit):
                found.setdefault(planned.name, []).append(fit)
        return found

    def matching(self, patterns: tuple[str, ...]) -> list[PlannedRecording]:
        """Return the recordings whose names match one of the patterns, in the order of the experiment."""
        return [q for q in self.recordings.values() if any(fnmatchcase(q.name, p) for p in patterns)]

    def fit_recordings(self, fit: str) -> list[PlannedRecording]:
        """Return the recordings of a fit.

        When it names none, all excited ones; of the rig those in the loop for a fit with `loop`, else the others.
        """
        section = self.spec.fits[fit]
        if section.recordings:
            return self.matching(section.recordings)
        closed = section.loop is not None
        excited = (q for q in self.recordings.values() if q.excited)
        return [q for q in excited if q.imported is not None or q.in_loop == closed]

    def path(self, folder: str, name: str, ending: str = ".h5") -> Path:
        """Return the path of a result; a long name is cut, and ends with a digest."""
        first, _, below = folder.partition("/")
        *above, last = map(file_stem, name.split("/"))
        return self.results.joinpath(self.folders.get(first, first), below, *above, f"{last}{ending}")

    def result(
        self,
        stage: str,
        item: str,
        path: Path,
        settings: Mapping[str, Any],
        sources: Iterable[Result | str] = (),
    ) -> Result:
        """Return a result of a stage with its content key, the only place where these keys are made.

        Parameters
        ----------
        stage, item : str
            Names of stage and item.
        path : pathlib.Path
            The result file.
        settings : dict
            What the stage takes from the YAML, as plain values.
        sources : iterable of Result or str
            Results that the stage reads, and digests or content keys of other files.
        """
        keys = [source if isinstance(source, str) else source.key for source in sources]
        return Result(stage, item, path, content_key(stage, settings, keys))

    def problem(self, location: Location, text: str) -> Problem:
        """Return a problem at the position of a key."""
        return Problem(self.file.position(location), dotted(location), text)


Check = Callable[[Experiment], Found]
"""Type of a check: it yields the problems of an experiment. It is silent about values that are missing elsewhere."""


# ---- Model and controller files of an experiment that were changed after gbid wrote them.


def changed_files(experiment: Experiment) -> list[str]:
    """Return a text for each YAML file named in an experiment whose checksum is not that of its lines."""
    notes = []
    for name in dict.fromkeys(_named(experiment.file.data)):
        path = experiment.folder_of(name) / name
        with suppress(OSError):  # the stage that needs it reports the error
            if is_changed(path.read_bytes()):
                notes.append(DataNote.CHANGED_BY_HAND(f"{path}: {CHANGED}; it is used as it is now"))
    return notes


def _named(value: Any) -> Iterator[str]:
    if isinstance(value, str) and value.endswith((".yaml", ".yml")) and "\0" not in value:
        yield value
    elif isinstance(value, dict):
        for each in value.values():
            yield from _named(each)
    elif isinstance(value, list):
        for each in value:
            yield from _named(each)


# ---- Plan of a fit: its models and the recordings of each.

TOGETHER = "together"
"""Name of the one model of a fit to all its recordings together."""


def fit_models(experiment: Experiment, fit: str) -> dict[str, list[str]]:
    """Return the models of a fit by name, each with the recordings to which it is fitted."""
    names = [q.name for q in experiment.fit_recordings(fit)]
    if experiment.spec.fits[fit].together:
        return {TOGETHER: names}
    return {name: [name] for name in names}


def recordings_of(experiment: Experiment, fit: str, model: str) -> list[str]:
    """Return the recordings to which one model of a fit is fitted."""
    if experiment.spec.fits[fit].together:
        return [q.name for q in experiment.fit_recordings(fit)]
    return [model]


# ---- Plan of a cross-validation: pairs of model and recording (paper, Sec. 3.8).

SPECIAL = ("cyclic", "others", "point")
"""Words for the recordings of a cross-validation."""


def validation_pairs(experiment: Experiment, fit: str) -> list[tuple[str, str]]:
    """Return the pairs of model and recording in the cross-validation of a fit.

    ``cyclic``: model j on recording j + 1 of the same operating point, the last on the first. ``others``: each
    model on all other excited recordings. ``point``: on those of its operating points. Names: each model on the
    recordings with these names.

    Returns
    -------
    list of (model, recording)
        The recording is empty for a model without a recording to validate on.
    """
    models, on = fit_models(experiment, fit), experiment.spec.crossval[fit].on
    if on == ("cyclic",):
        return [(model, _next(experiment, model, list(models))) for model in models]
    if on in (("others",), ("point",)):
        excited = [q for q in experiment.recordings.values() if q.excited]
        pairs = []
        for model, used in models.items():
            taken, points = set(used), {experiment.recordings[name].point for name in used}
            there = [q.name for q in excited if q.name not in taken and (on == ("others",) or q.point in points)]
            pairs += [(model, name) for name in there or [""]]
        return pairs
    return [(model, q.name) for model in models for q in experiment.matching(on)]


def figure_pairs(experiment: Experiment, fit: str) -> list[tuple[str, str]]:
    """Return the pairs of the figures of a fit: those of its cross-validation, else each model on its recordings."""
    if fit in experiment.spec.crossval:
        return validation_pairs(experiment, fit)
    return [(model, name) for model, names in fit_models(experiment, fit).items() for name in names]


def _next(experiment: Experiment, model: str, models: list[str]) -> str:
    """Return the next recording of the same operating point; empty when there is none."""
    point = experiment.recordings[model].point
    same = [name for name in models if experiment.recordings[name].point == point]
    return same[(same.index(model) + 1) % len(same)] if len(same) > 1 else ""
