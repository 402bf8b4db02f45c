"""Draft of an experiment from a folder of measured files: roles of channels, names, kinds, and the YAML."""

from __future__ import annotations

import json
import math
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from gbid.core.arrays import point_label
from gbid.core.errors import DataError, UsageError
from gbid.core.units import conversion_factor
from gbid.experiment.experiment import by_count
from gbid.experiment.schema import KINDS, Kind, NamePattern, name_of, name_pattern
from gbid.lpv.estimates import order_words, possible_order
from gbid.prefilter.identify_runout import compare_runout
from gbid.prefilter.runout import running_median
from gbid.recording import Recording, import_recording
from gbid.recording.formats import file_formats
from gbid.recording.importing import list_channels
from gbid.recording.mapping import nearest
from gbid.recording.quality import speed_change
from gbid.recording.readers import FileChannel

_WORDS = {
    "r": {"r", "ref", "reference", "referenz", "soll", "sollwert", "setpoint", "command", "fuehrung", "führung"},
    "u": {"u", "piezo", "piezos", "actuator", "aktor", "aktuator", "stack", "stellweg"},
    "phi": {"phi", "angle", "winkel", "drehwinkel", "encoder", "drehgeber", "theta"},
    "p": {"p", "pos", "position", "weg", "wege", "disp", "displacement", "disc", "scheibe", "auslenkung", "rotor"},
}
_TIME = {"t", "time", "zeit", "timestamp", "zeitstempel", "sekunden", "seconds"}
_AXES = {"x": 0, "y": 1}
_SHORT = re.compile(r"(r|u|p)([xy12])")


@dataclass(frozen=True)
class ChannelRoles:
    """Channels of a file that an experiment uses.

    Attributes
    ----------
    time : str or None
        Column of the sample times.
    signals : dict of str to tuple of str
        Columns by signal: two for ``r``, ``u`` and ``p`` (x, y), one for ``phi``.
    """

    time: str | None
    signals: Mapping[str, tuple[str, ...]]


def find_roles(
    channels: Sequence[FileChannel], given: Mapping[str, tuple[str, ...]], time: str | None, where: str
) -> ChannelRoles:
    """Return the roles of the channels of a file, those given first.

    Parameters
    ----------
    channels : sequence of FileChannel
        Channels of the file.
    given : dict of str to tuple of str
        Columns by signal, where they are known.
    time : str or None
        Column of the sample times, where it is known.
    where : str
        Name of the file, for messages.

    Raises
    ------
    UsageError
        When the file has no channel of a given name.
    """
    longest = max((channel.n_samples for channel in channels), default=0)
    usable = {channel.name: channel for channel in channels if not channel.remark and channel.n_samples == longest}
    for name in (*(column for columns in given.values() for column in columns), *([time] if time else [])):
        if name not in usable:
            raise UsageError(f"{where}: no channel {name!r}; {nearest(name, usable)}")
    if time is None:
        rising = [name for name, channel in usable.items() if channel.step is not None]
        named = [name for name in rising if _TIME & set(_split(name))]
        time = named[0] if named else rising[0] if len(rising) == 1 else None
    found: dict[str, dict[int, str]] = {}
    for name in usable:
        role, axis = _role(name)
        if role and name != time:
            found.setdefault(role, {}).setdefault(axis, name)
    signals = {
        role: tuple(column for _, column in sorted(columns.items()))
        for role, columns in found.items()
        if len(columns) == (1 if role == "phi" else 2)
    }
    return ChannelRoles(
        time,
        {role: given.get(role) or signals[role] for role in ("r", "u", "p", "phi") if role in {**signals, **given}},
    )


def _split(name: str) -> list[str]:
    return re.findall(r"[^\W\d_]+|\d+", name.lower())


def _role(name: str) -> tuple[str | None, int]:
    """Return the role of a channel and the number of its axis."""
    words = _split(name)
    short = _SHORT.fullmatch("".join(words)) if words else None
    if short:
        words = [short[1], short[2]]
    axis = next((_AXES.get(word, int(word) if word.isdigit() else None) for word in reversed(words[-1:])), None)
    kinds = [role for role, known in _WORDS.items() if known & set(words)]
    if not kinds and words in (["x"], ["y"]):
        kinds = ["p"]
    if not kinds:
        return None, 0
    return kinds[0], axis if axis is not None and kinds[0] != "phi" else 0


# ---- What a user says about a folder of measured files, and what must be asked.

ASKED = {
    "p": "columns of the disc position, x then y, with a comma between",
    "u": "columns of the piezo positions, x then y, with a comma between",
    "time": "column of the sample times",
    "unit": "unit of the positions in the files, such as um",
    "pressure_bar": "injection pressure of all files [bar]",
    "speed_rpm": "rotational speed of all files [rpm]",
}
"""Questions by option."""


class UnansweredError(UsageError):
    """Something that the files do not say and that must be given."""

    def __init__(self, option: str, reason: str) -> None:
        flag = f"--signal {option}=X,Y" if option in ("p", "u") else f"--{option.split('_')[0]} ..."
        super().__init__(f"{reason}; give the {ASKED[option]}: {flag}")
        self.option = option


@dataclass(frozen=True)
class DraftOptions:
    """Answers about a folder of measured files; what is not given is found in the files.

    Attributes
    ----------
    folder : pathlib.Path
        Folder of the files.
    signals : dict of str to tuple of str
        Columns of ``r``, ``u``, ``p`` and ``phi``.
    time : str or None
        Column of the sample times.
    sample_time_s : float or None
        Time between samples [s].
    unit : str or None
        Unit of positions in files that state none.
    pattern : str or None
        Pattern of the file names.
    from_s, to_s : float or None
        Part of each file to use [s].
    pressure_bar, speed_rpm : float or None
        Operating point of all files, where the names do not contain it.
    controller : str
        Structure of the controller.
    """

    folder: Path
    signals: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    time: str | None = None
    sample_time_s: float | None = None
    unit: str | None = None
    pattern: str | None = None
    from_s: float | None = None
    to_s: float | None = None
    pressure_bar: float | None = None
    speed_rpm: float | None = None
    controller: str = "P"

    def answered(self, option: str, text: str) -> DraftOptions:
        """Return the options with one more answer.

        Raises
        ------
        UsageError
            When a number was expected.
        """
        if option in ("p", "u"):
            return replace(self, signals={**self.signals, option: tuple(word.strip() for word in text.split(","))})
        if option in ("time", "unit"):
            words: dict[str, Any] = {option: text.strip()}
            return replace(self, **words)
        try:
            numbers: dict[str, Any] = {option: float(text.replace(",", "."))}
            return replace(self, **numbers)
        except ValueError:
            raise UsageError(f"{option}: expected a number, found {text!r}") from None


# ---- Survey of a folder of measured files: their channels, how they are read, and what their names say.

POSITIONS = ("r", "u", "p")


@dataclass(frozen=True)
class SurveyedFile:
    """One measured file.

    Attributes
    ----------
    path : pathlib.Path
        The file.
    roles : ChannelRoles
        Its channels with their roles.
    units : dict of str to str
        Units that the mapping must state, by signal, because the file does not.
    """

    path: Path
    roles: ChannelRoles
    units: Mapping[str, str]

    def mapping(self, options: DraftOptions) -> dict[str, object]:
        """Return the import mapping of the file, without range and conditions."""
        clock = {"sample_time_s": options.sample_time_s} if options.sample_time_s else {"time": self.roles.time}
        signals = {
            name: {"columns": list(columns), **({"unit": self.units[name]} if name in self.units else {})}
            for name, columns in self.roles.signals.items()
        }
        return {**clock, "signals": signals}


def survey(options: DraftOptions) -> tuple[list[SurveyedFile], list[str]]:
    """Return the measured files of a folder, and the names of files of other kinds.

    Raises
    ------
    UsageError
        When the folder holds no file that can be imported, or when a channel is not there.
    UnansweredError
        When the files do not show which columns are u and p, or when a unit is missing.
    DataError
        When a file cannot be read.
    """
    folder = options.folder
    if not folder.is_dir():
        raise UsageError(f"no folder {folder}; name the folder of the measured files")
    there = sorted((p for p in folder.iterdir() if p.is_file()), key=lambda p: by_count(p.name))
    paths = [p for p in there if p.suffix.lower() in file_formats()]
    if not paths:
        raise UsageError(f"{folder} holds no file that can be imported; expected {', '.join(file_formats())}")
    listed = {path: list_channels(path) for path in paths}
    known = _known_units(listed, options)
    files = [_surveyed(path, channels, options, known) for path, channels in listed.items()]
    return files, [p.name for p in there if p not in listed]


def _roles(path: Path, channels: list[FileChannel], options: DraftOptions) -> ChannelRoles:
    names = {channel.name for channel in channels}
    given = {signal: columns for signal, columns in options.signals.items() if set(columns) <= names}
    return find_roles(channels, given, options.time if options.time in names else None, path.name)


def _known_units(listed: Mapping[Path, list[FileChannel]], options: DraftOptions) -> dict[str, str]:
    """Return the unit that each signal has in the files that state one."""
    known: dict[str, str] = {}
    for path, channels in listed.items():
        units = {channel.name: channel.unit for channel in channels}
        for signal, columns in _roles(path, channels, options).signals.items():
            if units[columns[0]]:
                known.setdefault(signal, str(units[columns[0]]))
    return known


def _surveyed(path: Path, channels: list[FileChannel], options: DraftOptions, known: dict[str, str]) -> SurveyedFile:
    roles = _roles(path, channels, options)
    for signal in ("u", "p"):
        if signal not in roles.signals:
            names = ", ".join(channel.name for channel in channels)
            raise UnansweredError(signal, f"{path}: its channels do not show which are {signal}: {names}")
    if roles.time is None and options.sample_time_s is None:
        raise UnansweredError("time", f"{path}: no column rises evenly as a time does")
    stated = {channel.name: channel.unit for channel in channels}
    units = {}
    for signal, columns in roles.signals.items():
        if any(stated[column] for column in columns):
            continue
        unit = (options.unit if signal in POSITIONS else None) or known.get(signal)
        if unit is None and signal == "phi":
            unit = "rad"
        if unit is None:
            raise UnansweredError("unit", f"{path}: the file states no unit of {signal}")
        conversion_factor(unit, "rad" if signal == "phi" else "m")
        units[signal] = unit
    return SurveyedFile(path, roles, units)


# ---- Operating point and kind of recordings from the names of their files.

_COMMA = re.compile(r"(?<=\d),(?=\d)")
_TOKEN = re.compile(r"\d+(?:\.\d+)?|[^\W\d_]+|[\W_]")
_PRESSURE = ({"p", "druck", "pressure", "press"}, {"bar"})  # words before and after the number
_SPEED = ({"n", "drehzahl", "speed", "rpm", "omega"}, {"rpm", "upm", "u"})


@dataclass(frozen=True)
class NamesRead:
    """Pattern that the names of files have in common.

    Attributes
    ----------
    pattern : NamePattern
        The pattern.
    word : str or None
        Field of the word that differs between the files and may be their kind.
    commas : bool
        Whether the names have decimal commas, which a pattern cannot read.
    """

    pattern: NamePattern
    word: str | None
    commas: bool = False

    def read(self, file: str) -> dict[str, str | float] | None:
        """Return the fields of a file name, with decimal points or commas; None when it does not match."""
        return self.pattern.read(_COMMA.sub(".", file) if self.commas else file)


def read_names(files: Sequence[str]) -> NamesRead | None:
    """Return the pattern of file names of one form: equal words and signs, with numbers that may differ.

    A number before ``bar`` or after ``p`` is the pressure, one before ``rpm`` or after ``n`` the speed. One word may
    differ between the files.

    Parameters
    ----------
    files : sequence of str
        Names of the files with the same ending.

    Returns
    -------
    NamesRead or None
        None when the names have different forms.
    """
    stems = [_COMMA.sub(".", file.rpartition(".")[0]) for file in files]
    split = [_TOKEN.findall(stem) for stem in stems]
    if len({tuple(_form(token) for token in tokens) for tokens in split}) != 1:
        return None
    parts: list[str] = []
    words: list[str] = []
    used: set[str] = set()
    for i, column in enumerate(zip(*split, strict=True)):
        token = column[0]
        if _form(token) == "number":
            field = _field([t.lower() for t in split[0]], i)
            if field in used or (field == "nr" and len(set(column)) == 1):
                parts.append(token if len(set(column)) == 1 else f"{{part{i}}}")
                continue
            used.add(field)
            whole = all(each.isdigit() for each in column)
            parts.append(f"{{{field}:{'d' if whole and field != 'pressure_bar' else 'g'}}}")
        elif len(set(column)) > 1:
            words.append("kind" if not words else f"word{i}")
            parts.append(f"{{{words[-1]}}}")
        else:
            parts.append(token)
    text = "".join(parts) + "." + files[0].rpartition(".")[2]
    commas = any(_COMMA.search(file) for file in files)
    return NamesRead(name_pattern(text), words[0] if len(words) == 1 else None, commas)


def _form(token: str) -> str:
    return "number" if token[0].isdigit() else "word" if token[0].isalpha() else token


def _field(tokens: list[str], at: int) -> str:
    """Return the field of a number by the words beside it."""
    before = next((t for t in reversed(tokens[:at]) if t[0].isalnum()), "")
    after = next((t for t in tokens[at + 1 :] if t[0].isalnum()), "")
    direct = tokens[at + 1] if at + 1 < len(tokens) else ""
    for quantity, (left, right) in (("pressure_bar", _PRESSURE), ("speed_rpm", _SPEED)):
        if after in right and (direct == after or not direct.isalnum()):
            return quantity
        if before in left:
            return quantity
    return "nr"


# ---- What the recordings of a folder say about an experiment: operating points, kinds, junk, and harmonics of run-out.

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
    harmonics : int or None
        Number of harmonics of the run-out maps; None when no map can be compared.
    runout : tuple of str
        What a map leaves over at each operating point, or why nothing can be compared.
    notes : tuple of str
        What was found and assumed.
    """

    files: tuple[DraftedFile, ...]
    names: NamesRead | None
    kinds: Mapping[str, Kind]
    from_s: float | None
    to_s: float | None
    harmonics: int | None
    runout: tuple[str, ...]
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
    harmonics, words = find_harmonics(drafted)
    return DraftData(tuple(drafted), names, kinds or {}, from_s, to_s, harmonics, words, (*notes, *words))


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


def find_harmonics(files: Sequence[DraftedFile]) -> tuple[int | None, tuple[str, ...]]:
    """Return the number of harmonics of the run-out maps, and what is left over at each operating point, as text.

    It is the largest number chosen at an operating point by stationary recordings on held-out data; None when no map
    can be compared.
    """
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
    return max(sizes, default=None), tuple(words)


# ---- Text of a drafted experiment: commented YAML.


def draft_text(name: str, target: Path, options: DraftOptions, data: DraftData) -> str:
    """Return the YAML of an experiment.

    Parameters
    ----------
    name : str
        Name of the experiment.
    target : pathlib.Path
        Folder that it will be written to.
    options : DraftOptions
        What was given.
    data : DraftData
        The files.
    """
    excited = [each for each in data.files if each.kind == "excited"]
    lines = [
        f"# Gas bearing with the recordings of {options.folder}, drafted by gbid new --from; change what you like.",
        "# gbid check experiment.yaml shows all problems, gbid run experiment.yaml does every step.",
        "format: 1",
        f"name: {name}",
        "",
        "import:",
        f"  data_folder: {_quoted(os.path.relpath(options.folder.resolve(), target.resolve()))}",
        *_files(options, data),
        "",
        *_prefilter(data),
        "",
        *_models(excited, options),
    ]
    return "\n".join(lines) + "\n"


def _quoted(text: object) -> str:
    return json.dumps(text, ensure_ascii=False)


def _mapping(each: DraftedFile, options: DraftOptions, data: DraftData, indent: str) -> list[str]:
    """Return clock, part and signals of a file."""
    survey = each.survey
    given = options.sample_time_s
    lines = [f"sample_time_s: {_seconds(given)}" if given else f"time: {_quoted(survey.roles.time)}"]
    why = "               # the speed changes outside" if options.from_s is None and options.to_s is None else ""
    for key in ("from_s", "to_s"):
        value = getattr(data, key)
        if value is not None:
            lines.append(f"{key}: {value:g}{why}")
    lines.append("signals:")
    for signal, columns in survey.roles.signals.items():
        names = "[" + ", ".join(_quoted(column) for column in columns) + "]"
        unit = f", unit: {_quoted(survey.units[signal])}" if signal in survey.units else ""
        remark = "   # the file states no unit" if unit else _MEANING[signal]
        lines.append(f"  {signal}: {{columns: {names}{unit}}}{remark}")
    return [indent + line for line in lines]


_MEANING = {
    "r": "   # references of the piezos, x and y",
    "u": "   # positions of the piezos",
    "p": "   # position of the disc",
    "phi": "   # shaft angle",
}


def _files(options: DraftOptions, data: DraftData) -> list[str]:
    """Return the files: those of the pattern in one section, the others one by one."""
    by_name = [q for q in data.files if data.names and data.names.pattern.read(q.survey.path.name) is not None]
    alone = [q for q in data.files if q not in by_name]
    lines = []
    if by_name and data.names:
        pattern = data.names.pattern
        lines += [
            "  folder:                      # all files whose names have one form",
            f"    pattern: {_quoted(pattern.text)}",
        ]
        if data.kinds:
            lines.append("    kinds: {" + ", ".join(f"{_quoted(w)}: {k}" for w, k in data.kinds.items()) + "}")
        fixed = {key: by_name[0].conditions[key] for key in POINT if key not in pattern.numbers}
        if fixed:
            lines.append("    conditions: {" + ", ".join(f"{key}: {value!r}" for key, value in fixed.items()) + "}")
        lines += _mapping(by_name[0], options, data, "    ")
    if alone:
        lines.append("  recordings:" + ("                  # files of another kind" if by_name else ""))
    for each in alone:
        point = ", ".join(f"{key}: {value!r}" for key, value in each.conditions.items())
        same = [
            q for q in data.files if q is not each and name_of(q.survey.path.stem) == name_of(each.survey.path.stem)
        ]
        stem = each.survey.path.stem + (each.survey.path.suffix if same else "")
        lines += [
            f"    - name: {name_of(stem)}",
            f"      file: {_quoted(each.survey.path.name)}",
            f"      kind: {each.kind}",
            f"      conditions: {{{point}}}",
            *_mapping(each, options, data, "      "),
        ]
    return lines


def _prefilter(data: DraftData) -> list[str]:
    points = {
        kind: {tuple(q.conditions.values()) for q in data.files if q.kind == kind} for kind in ("excited", "stationary")
    }
    without_angle = any("phi" not in q.recording.signals for q in data.files)
    if without_angle or points["excited"] - points["stationary"]:
        return [
            "prefilter:                     # not every operating point has a stationary run with the shaft angle,",
            "  method: none                 # so that run-out stays in the signals; means and spikes are removed",
        ]
    lines = ["prefilter:                     # run-out over the shaft angle; on held-out data:"]
    lines += [f"  # {words}" for words in data.runout]
    return [*lines, f"  harmonics: {data.harmonics or 10}"]


def _models(excited: Sequence[DraftedFile], options: DraftOptions) -> list[str]:
    lines = ["fits:", "  bearing: {structure: rotor_bearing}   # piezo positions u to disc position p"]
    with_reference = all("r" in each.recording.signals for each in excited)
    points = np.array([[each.conditions[key] for key in POINT] for each in excited])
    if with_reference:
        lines.append("  piezos: {structure: piezo_pair}       # references r to piezo positions u")
    distinct, counts = np.unique(points, axis=0, return_counts=True)
    validated = ["  bearing: {on: cyclic}"] if counts.min() > 1 else []
    validated += ["  piezos: {on: others}"] if with_reference and len(excited) > 1 else []
    if validated:
        lines += ["", "crossval:                      # models on recordings that they were not fitted to", *validated]
    if not with_reference:
        return [
            *lines,
            "",
            "# Without the references r there is no model of the piezos, so no surfaces and no controller.",
        ]
    time = excited[0].recording.sample_time
    return [
        *lines,
        "",
        "nominal: {fit: piezos}         # the most central model of the piezos stands for all",
        "",
        f"lpv:                           # surfaces over pressure and speed, {len(distinct)} operating points",
        "  fit: bearing",
        f"  order: {order_words(possible_order(points))}",
        "  actuators: nominal",
        "",
        "controller:",
        f"  feedback: {{structure: {options.controller}, peak_sensitivity: 2.6, design_for: sampled, "
        f"sample_time_s: {_seconds(time)}}}",
    ]


def _seconds(value: float) -> str:
    """Return a time with a decimal point, as YAML needs it for a number."""
    text = f"{value:.6g}"
    return text if "." in text else text.replace("e", ".0e") if "e" in text else f"{text}.0"


# ---- Experiment for a gas bearing drafted from a folder of measured files.


@dataclass(frozen=True)
class Draft:
    """Drafted experiment.

    Attributes
    ----------
    text : str
        The YAML.
    notes : tuple of str
        What was found and assumed.
    """

    text: str
    notes: tuple[str, ...]


def draft_experiment(options: DraftOptions, target: Path) -> Draft:
    """Return an experiment for a gas bearing with the recordings of a folder.

    Columns, units, operating points, kinds of recordings, the part with a constant speed and the harmonics of run-out
    are found in the files and their names, unless they are given.

    Parameters
    ----------
    options : DraftOptions
        The folder, and what is given.
    target : pathlib.Path
        Folder that the experiment will be written to.

    Raises
    ------
    UnansweredError
        When something is neither found nor given.
    UsageError
        When what is given does not fit the files.
    DataError
        When a file cannot be read.
    """
    files, others = survey(options)
    data = read_data(options, files)
    notes = [*data.notes]
    if others:
        notes.append(f"left out, of a kind that is not imported: {', '.join(others)}")
    return Draft(draft_text(name_of(target.name), target, options, data), tuple(notes))
