"""Entries of the import section for the files of a folder or the rows of a table."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

from gbid.errors import DataError, UsageError
from gbid.experiment.problems import Location, nearest
from gbid.experiment.stages.importing.file_names import name_of, name_pattern
from gbid.experiment.stages.importing.schema import (
    FileSection,
    FolderSection,
    ImportedSection,
    ImportSection,
    TableSection,
)
from gbid.recording.importers.formats import file_formats
from gbid.recording.importers.text.text_table import read_table

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
