"""Experiment: YAML file, planned recordings, plans of fits, and results folder."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from functools import cached_property, lru_cache, partial
from itertools import product
from pathlib import Path
from typing import Any

from gbid.core.apart import read_apart
from gbid.core.errors import DataError, GbidError, UsageError, nearest
from gbid.core.files import is_changed, share_folder
from gbid.core.index import known
from gbid.core.names import file_stem, given_path
from gbid.core.notes import DataNote
from gbid.core.units import SIGNALS
from gbid.core.yaml_file import CHANGED, YamlFile
from gbid.experiment.fields import Found, Item, Location, Problem, Result, content_key, dotted, file_digest, needed
from gbid.experiment.rig_schema import OperatingPoint, Place, RigSection
from gbid.experiment.schema import (
    ExperimentFile,
    FileSection,
    FolderSection,
    ImportedSection,
    ImportSection,
    ListedSection,
    TableSection,
    name_of,
    name_pattern,
)
from gbid.recording.formats import file_formats, format_of
from gbid.recording.hdf5_links import HDF5_ENDINGS, files_beside
from gbid.recording.text_files import NumberedLine, TextLayout, TextTable, read_table

# ---- Entries of the import section for the files of a folder or the rows of a table.

POINT = ("pressure_bar", "speed_rpm")
_NAMED = 5  # largest number of files without match that are listed


def digest_or_not(path: Path) -> str:
    """Return the digest of a file, or a fixed text if the file cannot be read."""
    try:
        return file_digest(path)
    except OSError:
        return "cannot be read"  # what reads the file reports the error; the key changes when it can be read


def with_linked(path: Path) -> list[Path]:
    """Return a data file and the files to which it links."""
    try:
        return [path, *map(Path, known(path, "linked", files_beside))]
    except (OSError, DataError):  # which its import tells
        return [path]


@dataclass(frozen=True)
class FoundFiles:
    """Recordings that an import section finds, and the problems of its folder or table.

    Attributes
    ----------
    files : tuple of (ImportedSection, location)
        Recordings to import, with the location of the entry of each in the YAML.
    problems : tuple of (location, text)
        Location in the YAML and text of each problem.
    """

    files: tuple[tuple[ImportedSection, Location], ...] = ()
    problems: tuple[tuple[Location, str], ...] = ()


def find_files(section: ImportSection, base: Path) -> FoundFiles:
    """Return the recordings of an import section: listed ones first, then files of the folder and rows of the table.

    Parameters
    ----------
    section : ImportSection
        The section.
    base : pathlib.Path
        Folder of the experiment file.
    """
    files: list[tuple[ImportedSection, Location]] = [
        (entry, ("import", "recordings", i)) for i, entry in enumerate(section.recordings or ())
    ]
    problems: list[tuple[Location, str]] = []
    folder, listed = base / section.data_folder, {entry.file for entry, _ in files}
    sources: list[tuple[Location, Iterator[ImportedSection | str], str]] = []
    if section.folder is not None:
        skip = listed | ({section.table.file} if section.table else set())
        remedy = "without {name} in the pattern a recording has the name of its file"
        sources.append((("import", "folder", "pattern"), _by_pattern(section.folder, folder, skip), remedy))
    if section.table is not None:
        remedy = f"give each row of {section.table.file} a name of its own"
        sources.append((("import", "table", "file"), _by_table(section.table, folder), remedy))
    if section.recordings is None and not sources:
        problems.append((("import",), "lists no recordings; add recordings, folder or table"))
    for location, source, remedy in sources if folder.is_dir() else ():
        names: dict[str, str] = {}
        try:
            for entry in source:
                if isinstance(entry, str):
                    problems.append((location, entry))
                elif entry.name in names:
                    both = f"{entry.file} and {names[entry.name]} both give the name {entry.name!r}"
                    problems.append((location, f"{both}; {remedy}"))
                else:
                    names[entry.name] = entry.file
                    files.append((entry, location))
        except GbidError as error:
            problems.append((location, str(error)))
    return FoundFiles(tuple(files), tuple(problems))


def by_count(name: str) -> list[tuple[int, str]]:
    """Return a sort key of names that orders numbers by value: run2 before run10."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", name)]


def _by_pattern(section: FolderSection, folder: Path, skip: set[str]) -> Iterator[ImportedSection | str]:
    """Yield a recording for each file whose name matches, and a text for each problem.

    Raises
    ------
    UsageError
        When the pattern cannot be used.
    """
    pattern, words = name_pattern(section.pattern), repr(section.pattern)
    for name in section.more_conditions:
        if name not in pattern.numbers:
            raise UsageError(f"{words} has no field {name}; write {{{name}:g}}, or remove it from more_conditions")
    suffix = Path(section.pattern).suffix.lower()
    if not suffix:
        raise UsageError(f"{words} has no ending; write that of the files, such as .csv or .txt")
    for name in _needed_point(section):
        if name not in pattern.numbers:
            raise UsageError(f"{words} has no field {name}; write {{{name}:g}} into it, or give it in conditions")
    paths = folder.rglob("*") if "/" in section.pattern else folder.glob("*")
    endings = {suffix, *(ending for ending in file_formats() if ending not in HDF5_ENDINGS or suffix in HDF5_ENDINGS)}
    known = [p for p in paths if p.suffix.lower() in endings and not p.name.startswith("._")]  # macOS writes these
    files = sorted((p.relative_to(folder).as_posix() for p in known), key=by_count)
    read = {f: pattern.read(f) for f in files if f not in skip and not any(fnmatchcase(f, p) for p in section.ignore)}
    unmatched = [file for file, fields in read.items() if fields is None]
    for file, fields in read.items():
        if fields is not None:
            numbers = {name: float(fields[name]) for name in pattern.numbers}
            conditions = {name: value for name, value in numbers.items() if name in (*POINT, *section.more_conditions)}
            name, kind = str(fields.get("name", Path(file).stem)), fields.get("kind")
            yield _entry(section, file, name_of(name), None if kind is None else str(kind), conditions)
    if len(unmatched) == len(read):
        example = f"there is {', '.join(unmatched[:_NAMED])}" if unmatched else f"{folder} has no such files"
        raise UsageError(f"no file matches {words}; {example}: correct the pattern or data_folder")
    for file in unmatched[:_NAMED]:
        yield f"file {file} does not match {words}; rename it, or add it to ignore"
    if len(unmatched) > _NAMED:
        yield f"{len(unmatched) - _NAMED} more files do not match {words}"


def _by_table(section: TableSection, folder: Path) -> Iterator[ImportedSection | str]:
    """Yield a recording for each row of a table, and a text for each problem.

    Raises
    ------
    DataError
        When there is no such table.
    """
    path, more = folder / section.file, section.more_conditions
    try:
        table = read_apart(read_table, path, types=(TextTable, TextLayout, NumberedLine))
        cells = table.cells
        if table.layout.remark:  # no line of conditions is left out
            raise DataError(f"{path}: {table.layout.remark}")
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror}; give a CSV table") from None
    except DataError as error:
        text = "the table has a line with the names of the columns and one line for each recording"
        raise DataError(f"{error}; {text}") from None
    header = list(table.headings)
    missing = [name for name in ("file", *more, *_needed_point(section)) if name not in header]
    yield from (f"{path}: no column {name!r}; {nearest(name, header)}" for name in missing)
    for line, texts in zip(table.rows, cells, strict=True) if not missing else ():
        where = f"{path}: line {line.number}"
        row = {name: cell.strip() for name, cell in zip(header, texts, strict=True)}
        conditions, faults = {}, []
        for name in dict.fromkeys((*more, *(name for name in POINT if name in row))):
            value = _number(row[name], table.layout.decimal)
            conditions[name] = value
            if not math.isfinite(value):
                faults.append(f"{where}: {name} is {repr(row[name]) if row[name] else 'empty'}; write a number")
        file = row["file"]
        if not file:
            faults.append(f"{where}: file is empty; name the file, or remove the line")
        elif not _is_file(folder / file):
            faults.append(f"{where}: no file {folder / file}; put it there, or remove the line")
        elif format_of(folder / file) is None:
            faults.append(f"{where}: file {file}: unknown ending; expected one of {', '.join(file_formats())}")
        yield from faults
        if not faults:
            name = row.get("name") or name_of(Path(file).stem)
            entry = _entry(section, file, name, row.get("kind") or None, conditions)
            yield f"{where}: {entry}" if isinstance(entry, str) else entry


def _is_file(path: Path) -> bool:
    try:
        return given_path(path).is_file()
    except UsageError:
        return False


def _number(text: str, decimal: str) -> float:
    """Return the number in a table cell; NaN if it is not a number."""
    try:
        return float(text.replace(decimal, "."))
    except ValueError:
        return math.nan


def _needed_point(section: ListedSection) -> list[str]:
    """Return the parts of the operating point that file names or columns must state."""
    return [name for name in POINT if section.operating_point and name not in section.conditions]


def _entry(
    section: ListedSection, file: str, name: str, word: str | None, conditions: dict[str, float]
) -> ImportedSection | str:
    """Return the import entry of one file, or a text with the reason why it has none."""
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
    """Recording that the rig will simulate or the import will read.

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
        """Kind of recording: ``excited``, ``stationary``, ``staircase``, or another run such as ``hammer``."""
        if self.excited or self.staircase:
            return "excited" if self.excited else "staircase"
        return "stationary" if self.stationary else str(self.run[0])

    @property
    def stationary(self) -> bool:
        """Whether the piezos stand still, so that run-out maps can be computed from the recording."""
        return not self.excited and not self.staircase and self.run[:1] in ((), ("stationary",))

    @property
    def in_loop(self) -> bool:
        """Whether a controller of the section rig closes the loop."""
        return self.run[:1] in (("loop",), ("loop_still",))

    @property
    def point(self) -> str:
        """Operating point as text, such as ``p5_n6000``; ``any`` if the conditions contain none."""
        pressure, speed = self.conditions.get("pressure_bar"), self.conditions.get("speed_rpm")
        parts = [f"{letter}{v:g}" for letter, v in (("p", pressure), ("n", speed)) if v is not None]
        return "_".join(parts) or NO_POINT


def planned_recordings(spec: ExperimentFile, imports: FoundFiles) -> Iterator[PlannedRecording]:
    """Yield the recordings of the rig, then the imported ones; names may occur twice before the checks."""
    if spec.rig is not None:
        for i, point in enumerate(spec.rig.operating_points):
            yield from _at_point(spec.rig, point, ("rig", "operating_points", i))
        for i, course in enumerate(spec.rig.courses):  # recordings of a course have no operating point
            planned = partial(PlannedRecording, excited=course.excited, conditions={}, run=("course", i))
            signals = {**_rig_signals(spec.rig), **_COURSE_SIGNALS}
            for n in range(course.recordings):
                yield planned(f"{course.name}{n + 1}", signals=signals, location=("rig", "courses", i))
    for entry, location in imports.files:
        signals = {name: _channels(name, len(c.columns), c.channels) for name, c in entry.signals.items()}
        excited, staircase = entry.kind == "excited", entry.kind == "staircase"
        yield PlannedRecording(entry.name, excited, entry.conditions, signals, location, entry, staircase)


def _rig_signals(rig: RigSection) -> dict[str, tuple[str, ...]]:
    return {**RIG_SIGNALS, **(_STACK_SIGNALS if rig.actuators.record_stacks else {})}


def _at_point(rig: RigSection, point: OperatingPoint, location: Location) -> Iterator[PlannedRecording]:
    """Yield the recordings of the rig at an operating point, run by run."""
    conditions = {"pressure_bar": point.pressure_bar, "speed_rpm": point.speed_rpm}
    for word, count, run in _runs(rig, point):
        signals = {**_rig_signals(rig), **_EXTRA_SIGNALS.get(str(run[0]), {})}
        excited, staircase = run[0] in ("prbs", "played", "loop"), run[0] in ("staircase", "stack_staircase")
        for i in range(count):
            name = f"p{point.pressure_bar:g}_n{point.speed_rpm:g}_{word}{i + 1}"
            yield PlannedRecording(name, excited, conditions, signals, location, None, staircase, run)


def _runs(rig: RigSection, point: OperatingPoint) -> Iterator[tuple[str, int, tuple[str | int | bool, ...]]]:
    """Yield the runs at an operating point: word in the names, number of recordings, and run."""
    yield "still", rig.stationary.recordings, ("stationary",)
    yield "prbs", rig.prbs.recordings if point.prbs_recordings is None else point.prbs_recordings, ("prbs",)
    if rig.played is not None and _is_at(rig.played.at, point):
        yield "played", rig.played.recordings, ("played",)
    if (loop := rig.loop) is not None:
        yield (
            "loop_still",
            int(loop.runout == "offline") if loop.stationary is None else loop.stationary,
            ("loop_still",),
        )
        yield "loop", loop.recordings, ("loop",)
    if (stairs := rig.staircase) is not None and _is_at(stairs.at, point):
        yield from ((f"stairs_{axis}", stairs.recordings, ("staircase", axis)) for axis in stairs.axes)
    if (steps := rig.stack_staircase) is not None and _is_at(steps.at, point):
        for stack, controlled in product(steps.stacks, steps.controlled):
            word = f"stack{stack}_{'controlled' if controlled else 'open'}"
            yield word, steps.recordings, ("stack_staircase", stack, controlled)
    if rig.hammer is not None:
        yield from ((f"hammer_{axis}", rig.hammer.recordings, ("hammer", axis)) for axis in rig.hammer.axes)
    if rig.run_up is not None:
        yield "runup", rig.run_up.recordings, ("run_up",)


def _is_at(places: tuple[Place, ...] | None, point: Place) -> bool:
    """Return whether a run is planned at an operating point; a run without a list is planned at all points."""
    return places is None or any((q.pressure_bar, q.speed_rpm) == (point.pressure_bar, point.speed_rpm) for q in places)


def _channels(signal: str, count: int, given: tuple[str, ...] | None) -> tuple[str, ...]:
    if given:
        return given
    known = SIGNALS.get(signal)
    return known.channels if known else tuple(str(i + 1) for i in range(count))


@dataclass(frozen=True, eq=False)
class Experiment:
    """Experiment file with its contents and positions, and the results folder.

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
        """Folder of the YAML file, the base of its relative paths."""
        return self.file.path.parent

    def folder_of(self, file: str) -> Path:
        """Return the base folder of a file name: the folder of the experiment, or the models of gbid."""
        for folder in (self.folder, share_folder("models")):
            if (folder / file).is_file():
                return folder
        return self.folder

    @cached_property
    def recordings(self) -> Mapping[str, PlannedRecording]:
        """Planned recordings by name: recordings of the rig, then imported recordings."""
        return {planned.name: planned for planned in planned_recordings(self.spec, self.imports)}

    @cached_property
    def imports(self) -> FoundFiles:
        """Files that the import section lists or finds in its folder, searched once."""
        section = self.spec.imported
        return find_files(section, self.folder) if section is not None else FoundFiles()

    @cached_property
    def points(self) -> Mapping[str, list[PlannedRecording]]:
        """Planned recordings by operating point."""
        points: dict[str, list[PlannedRecording]] = {}
        for planned in self.recordings.values():
            points.setdefault(planned.point, []).append(planned)
        return points

    @cached_property
    def fits_of(self) -> Mapping[str, list[str]]:
        """Names of the fits that use a recording, keyed by the name of the recording."""
        fits: dict[str, list[str]] = {}
        for fit in self.spec.fits:
            for planned in self.fit_recordings(fit):
                fits.setdefault(planned.name, []).append(fit)
        return fits

    def matching(self, patterns: tuple[str, ...]) -> list[PlannedRecording]:
        """Return the recordings whose names match one of the patterns, in the order of the experiment."""
        return [q for q in self.recordings.values() if any(fnmatchcase(q.name, p) for p in patterns)]

    def fit_recordings(self, fit: str) -> list[PlannedRecording]:
        """Return the recordings of a fit.

        When it names none, all excited ones; of the rig those in the loop for a fit with `loop`, else the others.
        """
        section = self.spec.fits[fit]
        if section.recordings is not None:
            return self.matching(section.recordings)
        closed = section.loop is not None
        excited = (q for q in self.recordings.values() if q.excited)
        return [q for q in excited if q.imported is not None or q.in_loop == closed]

    def path(self, folder: str, *names: str, ending: str = ".h5") -> Path:
        """Return the path of a result from folder and file names; a long name is shortened with a digest."""
        *above, last = map(file_stem, names)
        return self.results.joinpath(self.folders.get(folder, folder), *above, f"{last}{ending}")

    def result(
        self,
        item: Item,
        folder: str,
        settings: Mapping[str, Any],
        sources: Iterable[Result | str] = (),
        *,
        ending: str = ".h5",
    ) -> Result:
        """Return the result file of a stage with its content key; all content keys are computed here.

        Parameters
        ----------
        item : Item
            What the result is about.
        folder : str
            Folder of the file, which has the name of the item.
        settings : dict
            What the stage takes from the YAML, as plain values.
        sources : iterable of Result or str
            Results that the stage reads, and digests or content keys of other files.
        ending : str
            Ending of the file.
        """
        keys = [source if isinstance(source, str) else source.key for source in sources]
        path = self.path(folder, *filter(None, (item.section, item.model)), ending=ending)
        return Result(item, path, content_key(item.stage, settings, keys))

    def data_file(self, entry: ImportedSection) -> Path:
        """Return the path of the file of an imported recording."""
        return self.folder / needed(self.spec.imported, "import").data_folder / entry.file

    def origin(self, recordings: Iterable[str] = (), fit: str = "") -> dict[str, Any]:
        """Return the provenance of a result: the YAML, its seeds, and its data files with sha256.

        Paths are relative to the folder of the experiment.

        Parameters
        ----------
        recordings : iterable of str
            Recordings from which the result is made; those of the rig have no data files.
        fit : str
            Fit that the result is; its frequency responses are data files as well.
        """
        imported = [self.recordings[name].imported for name in recordings if name in self.recordings]
        files = [self.data_file(entry) for entry in imported if entry is not None]
        files += [self.folder / each.file for each in (self.spec.fits[fit].responses if fit else ())]
        yaml = {"file": self.file.path.name, "sha256": digest_or_not(self.file.path)}
        data = {self.beside(path): digest_or_not(path) for file in files for path in with_linked(file)}
        return {"experiment": yaml, "seeds": self._seeds, "data": data}

    def beside(self, path: str | Path) -> str:
        """Return a path relative to the folder of the experiment, so that results contain no user folders."""
        try:
            return Path(os.path.relpath(Path(path).resolve(), self.folder.resolve())).as_posix()
        except ValueError:  # on another drive
            return Path(path).name

    @cached_property
    def _seeds(self) -> dict[str, int]:
        """Seeds of the YAML, defaults included, by their keys."""
        seeds: dict[str, int] = {}

        def search(value: Any, keys: str) -> None:
            if isinstance(value, dict):
                for key, entry in value.items():
                    if key == "seed" and isinstance(entry, int):
                        seeds[f"{keys}{key}"] = entry
                    search(entry, f"{keys}{key}.")

        search(self.spec.model_dump(), "")
        return seeds

    def problem(self, location: Location, text: str) -> Problem:
        """Return a problem with the file position of a key."""
        return Problem(self.file.position(location), dotted(location), text)


Check = Callable[[Experiment], Found]
"""Type of a check: it yields the problems of an experiment. It is silent about values that are missing elsewhere."""


# ---- Model and controller files that were changed after gbid wrote them.


def changed_files(experiment: Experiment) -> list[str]:
    """Return a text for each YAML file of an experiment whose contents do not match its checksum."""
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


# ---- Plans of a fit and of its validation: models, and the recordings of each model.

TOGETHER = "together"
"""Name of the one model of a fit to all its recordings together."""
RESPONSES = "responses"
"""Name of the one model of a fit to frequency responses alone."""


@lru_cache(maxsize=64)
def fit_models(experiment: Experiment, fit: str) -> Mapping[str, list[str]]:
    """Return the recordings of each model of a fit, by model name; cached."""
    names, section = [q.name for q in experiment.fit_recordings(fit)], experiment.spec.fits[fit]
    if section.responses and not names:
        return {RESPONSES: []}
    return {TOGETHER: names} if section.together else {name: [name] for name in names}


def recordings_of(experiment: Experiment, fit: str, model: str) -> list[str]:
    """Return the recordings to which a model of a fit is fitted."""
    return fit_models(experiment, fit)[model]


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
        Without models that have no recording to validate on; where none has one, all with an empty recording.
    """
    pairs = _validation_pairs(experiment, fit)
    return [pair for pair in pairs if pair[1]] or pairs


def _validation_pairs(experiment: Experiment, fit: str) -> list[tuple[str, str]]:
    models, on = fit_models(experiment, fit), experiment.spec.crossval[fit].on
    if on == ("cyclic",):
        return [(model, _next(experiment, model, list(models))) for model in models]
    if on in (("others",), ("point",)):
        excited = [q for q in experiment.recordings.values() if q.excited]
        pairs = []
        for model, used in models.items():
            taken, points = set(used), {experiment.recordings[name].point for name in used}
            others = [q.name for q in excited if q.name not in taken and (on == ("others",) or q.point in points)]
            pairs += [(model, name) for name in others or [""]]
        return pairs
    return [(model, q.name) for model in models for q in experiment.matching(on)]


def figure_pairs(experiment: Experiment, fit: str) -> list[tuple[str, str]]:
    """Return model and recording of each figure of a fit: the validation pairs, else each model on its recordings."""
    if fit in experiment.spec.crossval:
        return validation_pairs(experiment, fit)
    return [(model, name) for model, names in fit_models(experiment, fit).items() for name in names]


def _next(experiment: Experiment, model: str, models: list[str]) -> str:
    """Return the next recording at the operating point of a recording; empty after the last."""
    if model not in experiment.recordings:  # of a fit to frequency responses alone
        return ""
    point = experiment.recordings[model].point
    same = [name for name in models if experiment.recordings[name].point == point]
    return same[(same.index(model) + 1) % len(same)] if len(same) > 1 else ""
