"""What the recordings of a folder say about an experiment: operating points, kinds, junk, and harmonics of run-out."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from gbid.errors import DataError, UsageError
from gbid.experiment.draft.draft_options import DraftOptions, UnansweredError
from gbid.experiment.draft.file_survey import SurveyedFile
from gbid.experiment.draft.name_reading import NamesRead, read_names
from gbid.experiment.stages.importing.file_names import name_pattern
from gbid.experiment.stages.importing.schema import KINDS, Kind
from gbid.operating_point import point_label
from gbid.prefilter.compare import compare_runout
from gbid.prefilter.median import running_median
from gbid.recording import Recording, import_recording
from gbid.recording.quality_speed import speed_change

STILL = 0.5e-6
"""Largest movement of r and u at rest [m], as for `gbid.identify_runout`."""
POINT = ("pressure_bar", "speed_rpm")


@dataclass(frozen=True, eq=False)
class DraftedFile:
    """One measured file with what its name and its signals say.

    Attributes
    ----------
    survey : SurveyedFile
        File and mapping.
    conditions : dict of str to float
        Operating point.
    kind : str
        ``excited`` when the piezos move, else ``stationary``.
    recording : Recording
        The part of it that is used.
    """

    survey: SurveyedFile
    conditions: Mapping[str, float]
    kind: Kind
    recording: Recording


@dataclass(frozen=True, eq=False)
class DraftData:
    """Measured files with what they say together.

    Attributes
    ----------
    files : tuple of DraftedFile
        The files.
    names : NamesRead or None
        Pattern of the names of most files; None when they have none in common.
    kinds : dict of str to str
        Kind by word of the names, beyond the words that gbid knows.
    from_s, to_s : float or None
        Part of the files to use [s].
    notes : tuple of str
        What was found and assumed.
    """

    files: tuple[DraftedFile, ...]
    names: NamesRead | None
    kinds: Mapping[str, Kind]
    from_s: float | None
    to_s: float | None
    notes: tuple[str, ...]


def read_data(options: DraftOptions, files: Sequence[SurveyedFile]) -> DraftData:
    """Return what measured files say.

    Raises
    ------
    DataError
        When a file cannot be imported.
    UnansweredError
        When the names of the files do not contain the operating point.
    """
    names, patterned = _names(options, files)
    notes: list[str] = []
    whole = []
    for each in files:
        fields = names.read(each.path.name) if names and each.path in patterned else _by_pattern(names, each)
        conditions = _conditions(options, each, fields or {})
        whole.append(import_recording(each.path, {**each.mapping(options), "conditions": conditions}))
    from_s, to_s = _part(options, whole, notes)
    drafted = []
    for each, rec in zip(files, whole, strict=True):
        first = round((from_s or 0.0) / rec.sample_time)
        last = rec.n_samples if to_s is None else round(to_s / rec.sample_time)
        used = rec.slice(min(first, rec.n_samples - 1), min(last, rec.n_samples))
        drafted.append(DraftedFile(each, rec.conditions, "excited" if _moves(used) else "stationary", used))
    notes += _remarks(whole)
    kinds = _kinds(names, drafted) if names and names.word else {}
    if names is not None and (
        names.commas or not _tells_kinds(names, kinds or {}, [q for q in drafted if q.survey.path in patterned])
    ):
        names = None
    return DraftData(tuple(drafted), names, kinds or {}, from_s, to_s, tuple(notes))


def _names(options: DraftOptions, files: Sequence[SurveyedFile]) -> tuple[NamesRead | None, set[Path]]:
    """Return the pattern of the names of the most files of one kind, and these files."""
    if options.pattern is not None:
        pattern = name_pattern(options.pattern)
        matching = {each.path for each in files if pattern.read(each.path.name) is not None}
        if not matching:
            raise UsageError(f"--pattern: no file of {options.folder} matches {options.pattern!r}")
        return NamesRead(pattern, "kind" if "kind" in pattern.fields else None), matching
    groups: dict[tuple[object, ...], list[Path]] = {}
    for each in files:
        signals = tuple(each.roles.signals.items())
        groups.setdefault((each.path.suffix, each.roles.time, signals), []).append(each.path)
    most = max(groups.values(), key=len)
    names = read_names([path.name for path in most])
    return names, set(most) if names else set()


def _by_pattern(names: NamesRead | None, each: SurveyedFile) -> dict[str, str | float] | None:
    """Return the fields of the name of a file of another ending."""
    if names is None:
        alone = read_names([each.path.name])
        return alone.read(each.path.name) if alone else None
    ending = names.pattern.text.rpartition(".")[2]
    return names.read(f"{each.path.stem}.{ending}") or _by_pattern(None, each)


def _conditions(options: DraftOptions, each: SurveyedFile, fields: Mapping[str, str | float]) -> dict[str, float]:
    found = {}
    for key in POINT:
        given = getattr(options, key)
        value = fields.get(key, given) if given is None else given
        if value is None:
            raise UnansweredError(key, f"{each.path.name}: the name does not contain {key}")
        found[key] = float(value)
    return found


def _part(options: DraftOptions, whole: Sequence[Recording], notes: list[str]) -> tuple[float | None, float | None]:
    """Return the part that is used of all files: as given, or that in which the shaft has its speed."""
    if options.from_s is not None or options.to_s is not None:
        return options.from_s, options.to_s
    changes = {rec.name: change for rec in whole if (change := speed_change(rec)) and change.steady}
    starts = [change.from_s for change in changes.values() if change.from_s is not None]
    ends = [change.to_s for change in changes.values() if change.to_s is not None]
    from_s = math.ceil(10 * max(starts)) / 10 if starts else None
    to_s = math.floor(10 * min(ends)) / 10 if ends else None
    parts = [f"{key} {value:g}" for key, value in (("from_s:", from_s), ("to_s:", to_s)) if value is not None]
    if parts:
        notes.append(
            f"the speed changes in {len(changes)} of {len(whole)} files, so of all files is used {' '.join(parts)}"
        )
    shortest = min(whole, key=lambda rec: rec.duration)
    if (from_s or 0.0) >= (to_s or shortest.duration):
        raise DataError(
            f"{shortest.name}: no part of all files has a constant speed ({' '.join(parts)} of "
            f"{shortest.duration:g} s); give --from-s and --to-s, or leave out the files with a run-up"
        )
    return from_s, to_s


def _remarks(whole: Sequence[Recording]) -> list[str]:
    """Return the remarks of the import, one for all files whose remarks differ in numbers only."""
    alike: dict[str, list[Recording]] = {}
    for rec in whole:
        if "import_remarks" in rec.provenance:
            alike.setdefault(re.sub(r"[\d.]+", "", rec.provenance["import_remarks"]), []).append(rec)
    return [
        f"{group[0].name}: {group[0].provenance['import_remarks']}"
        + (f" ({len(group) - 1} more files alike)" if len(group) > 1 else "")
        for group in alike.values()
    ]


def _moves(rec: Recording) -> bool:
    """Return whether the piezos move."""
    for name in ("r", "u"):
        if name in rec.signals and np.ptp(running_median(rec.signal(name), 3), axis=0).max() > STILL:
            return True
    return False


def _kinds(names: NamesRead, drafted: Sequence[DraftedFile]) -> dict[str, Kind] | None:
    """Return the kind of each word of the names that gbid does not know; None where a word has two kinds."""
    found: dict[str, Kind] = {}
    for each in drafted:
        fields = names.read(each.survey.path.name)
        if fields is not None and names.word is not None:
            word = str(fields[names.word])
            if found.setdefault(word, each.kind) != each.kind:
                return None
    return {} if all(KINDS.get(word) == kind for word, kind in found.items()) else found


def _tells_kinds(names: NamesRead, kinds: Mapping[str, Kind], drafted: Sequence[DraftedFile]) -> bool:
    """Return whether the pattern gives each file the kind that its signals show."""
    for each in drafted:
        fields = names.read(each.survey.path.name) or {}
        known = {**KINDS, **kinds}
        if known.get(str(fields.get("kind")), "excited") != each.kind:
            return False
    return True


@dataclass(frozen=True)
class RunoutFound:
    """Choice of the harmonics of the run-out maps.

    Attributes
    ----------
    harmonics : int or None
        Largest number chosen at an operating point; None when no map can be compared.
    words : tuple of str
        What is left over at each operating point, or why nothing can be compared.
    """

    harmonics: int | None
    words: tuple[str, ...]


def find_harmonics(files: Sequence[DraftedFile]) -> RunoutFound:
    """Return the number of harmonics by what is left over of stationary recordings on held-out data."""
    points: dict[tuple[float, ...], list[Recording]] = {}
    for each in files:
        if each.kind == "stationary" and "phi" in each.recording.signals:
            points.setdefault(tuple(each.conditions[key] for key in POINT), []).append(each.recording)
    sizes, words = [], []
    for point, still in sorted(points.items()):
        label = point_label(*point)
        try:
            chosen = compare_runout(
                [replace(rec, name=f"{rec.name} {i}") for i, rec in enumerate(still)], bins=()
            ).chosen
        except DataError as error:
            words.append(f"{label}: not compared ({error})")
            continue
        if chosen.method == "harmonics":
            sizes.append(chosen.size)
            left = ", ".join(f"{1e9 * rms:.0f}" for rms in chosen.residual_rms)
            words.append(f"{label}: {chosen.size} harmonics leave {left} nm")
    return RunoutFound(max(sizes, default=None), tuple(words))
