"""Draft of an experiment from a folder of measured files: roles of channels, names, kinds, and the YAML."""

from __future__ import annotations

import json
import math
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined

from gbid.core.arrays import point_label
from gbid.core.errors import DataError, UsageError
from gbid.core.units import conversion_factor
from gbid.experiment.experiment import POINT, by_count
from gbid.experiment.schema import KINDS, Kind, NamePattern, name_of, name_pattern
from gbid.lpv.estimates import order_words, possible_order
from gbid.prefilter.runout import running_median
from gbid.prefilter.runout_identification import compare_runout
from gbid.recording import Recording, import_recording
from gbid.recording.formats import file_formats
from gbid.recording.importing import list_channels
from gbid.recording.mapping import nearest
from gbid.recording.quality import speed_change
from gbid.recording.readers import FileChannel

# ---- Roles of the channels of a file, by their names.

_WORDS = {
    "r": {"r", "ref", "reference", "referenz", "soll", "sollwert", "setpoint", "command", "fuehrung", "führung"},
    "u": {"u", "piezo", "piezos", "actuator", "aktor", "aktuator", "stack", "stellweg"},
    "phi": {"phi", "angle", "winkel", "drehwinkel", "encoder", "drehgeber", "theta"},
    "p": {"p", "pos", "position", "weg", "wege", "disp", "displacement", "disc", "scheibe", "auslenkung", "rotor"},
}
_TIME = {"t", "time", "zeit", "timestamp", "zeitstempel", "sekunden", "seconds"}
_AXES = {"x": 0, "y": 1}
_SHORT = re.compile(r"(r|u|p)([xy12])")
_ORDER = ("r", "u", "p", "phi")

Roles = tuple[str | None, Mapping[str, tuple[str, ...]]]
"""Column of the sample times if there is one, and columns by signal: two for ``r``, ``u``, ``p``, one for ``phi``."""


def find_roles(
    channels: Sequence[FileChannel], given: Mapping[str, tuple[str, ...]], time: str | None, file: str
) -> Roles:
    """Return the roles of the channels of a file, those given first.

    Parameters
    ----------
    channels : sequence of FileChannel
        Channels of the file.
    given : dict of str to tuple of str
        Columns by signal, where they are known.
    time : str or None
        Column of the sample times, where it is known.
    file : str
        Name of the file, for messages.

    Raises
    ------
    UsageError
        When the file has no channel of a given name.
    """
    longest = max((channel.n_samples for channel in channels), default=0)
    usable = {channel.name: channel for channel in channels if not channel.remark and channel.n_samples == longest}
    for name in (*chain.from_iterable(given.values()), *([time] if time else [])):
        if name not in usable:
            raise UsageError(f"{file}: no channel {name!r}; {nearest(name, usable)}")
    if time is None:
        rising = [name for name, channel in usable.items() if channel.step is not None]
        named = [name for name in rising if _TIME & set(_split(name))]
        time = named[0] if named else rising[0] if len(rising) == 1 else None
    axes: dict[str, dict[int, str]] = {role: {} for role in _ORDER}
    for name in usable:
        role, axis = _role(name)
        if role and name != time:
            axes[role].setdefault(axis, name)
    pairs = {role: tuple(name for _, name in sorted(names.items())) for role, names in axes.items()}
    complete = {role: names for role, names in pairs.items() if len(names) == (1 if role == "phi" else 2)}
    complete.update(given)
    return time, {role: complete[role] for role in _ORDER if role in complete}


def _split(name: str) -> list[str]:
    return re.findall(r"[^\W\d_]+|\d+", name.lower())


def _role(name: str) -> tuple[str | None, int]:
    """Return the role of a channel and the number of its axis."""
    words = _split(name)
    if short := _SHORT.fullmatch("".join(words)):
        words = [short[1], short[2]]
    if words in (["x"], ["y"]):
        return "p", _AXES[words[0]]
    role = next((role for role, known in _WORDS.items() if known & set(words)), None)
    last = words[-1] if words and role != "phi" else ""
    return role, int(last) if last.isdecimal() else _AXES.get(last, 0)


# ---- What a user says about a folder of measured files, and the questions that remain.

QUESTIONS = {
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
        super().__init__(f"{reason}; give the {QUESTIONS[option]}: {flag}")
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
        value: Any = text.strip()
        if option in ("p", "u"):
            option, value = "signals", {**self.signals, option: tuple(word.strip() for word in text.split(","))}
        elif option in POINT:
            try:
                value = float(text.replace(",", "."))
            except ValueError:
                raise UsageError(f"{option}: expected a number, found {text!r}") from None
        return replace(self, **{option: value})


# ---- Survey of a folder of measured files: their channels, and how they are read.


@dataclass(frozen=True, eq=False)
class MeasuredFile:
    """One measured file.

    Attributes
    ----------
    path : pathlib.Path
        The file.
    time : str or None
        Column of the sample times.
    signals : dict of str to tuple of str
        Columns by signal.
    units : dict of str to str
        Units that the mapping must state, by signal, because the file does not.
    """

    path: Path
    time: str | None
    signals: Mapping[str, tuple[str, ...]]
    units: Mapping[str, str]


def survey(options: DraftOptions) -> tuple[list[MeasuredFile], list[str]]:
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
    listed = sorted((p for p in folder.iterdir() if p.is_file()), key=lambda p: by_count(p.name))
    channels = {path: list_channels(path) for path in listed if path.suffix.lower() in file_formats()}
    if not channels:
        raise UsageError(f"{folder} holds no file that can be imported; expected {', '.join(file_formats())}")
    roles: dict[Path, Roles] = {}
    units: dict[str, str] = {}  # of each signal in the first file that states one
    for path, each in channels.items():
        names = {channel.name for channel in each}
        given = {signal: columns for signal, columns in options.signals.items() if names.issuperset(columns)}
        roles[path] = find_roles(each, given, options.time if options.time in names else None, path.name)
        stated = {channel.name: channel.unit for channel in each if channel.unit}
        units = {s: stated[columns[0]] for s, columns in roles[path][1].items() if columns[0] in stated} | units
    files = [_measured(path, each, roles[path], units, options) for path, each in channels.items()]
    return files, [path.name for path in listed if path not in channels]


def _measured(
    path: Path, channels: Sequence[FileChannel], roles: Roles, usual: Mapping[str, str], options: DraftOptions
) -> MeasuredFile:
    """Return a file with the units that its mapping states: as given, or as in the other files."""
    time, signals = roles
    for signal in ("u", "p"):
        if signal not in signals:
            names = ", ".join(channel.name for channel in channels)
            raise UnansweredError(signal, f"{path}: its channels do not show which are {signal}: {names}")
    if time is None and options.sample_time_s is None:
        raise UnansweredError("time", f"{path}: no column rises evenly as a time does")
    stated = {channel.name for channel in channels if channel.unit}
    units = {}
    for signal, columns in signals.items():
        if stated.intersection(columns):
            continue
        is_angle = signal == "phi"
        unit = usual.get(signal, "rad") if is_angle else options.unit or usual.get(signal)
        if unit is None:
            raise UnansweredError("unit", f"{path}: the file states no unit of {signal}")
        conversion_factor(unit, "rad" if is_angle else "m")
        units[signal] = unit
    return MeasuredFile(path, time, signals, units)


# ---- Operating point and kind of recordings from the names of their files.

_COMMA = re.compile(r"(?<=\d),(?=\d)")
_TOKEN = re.compile(r"\d+(?:\.\d+)?|[^\W\d_]+|[\W_]")
_BESIDE = {  # words before and after the number
    "pressure_bar": ({"p", "druck", "pressure", "press"}, {"bar"}),
    "speed_rpm": ({"n", "drehzahl", "speed", "rpm", "omega"}, {"rpm", "upm", "u"}),
}


@dataclass(frozen=True)
class NamesRead:
    """Pattern that the names of files have in common.

    Attributes
    ----------
    pattern : NamePattern
        The pattern.
    tells_kind : bool
        Whether a single word differs between the files, which may be their kind.
    commas : bool
        Whether the names have decimal commas, which a pattern cannot read.
    """

    pattern: NamePattern
    tells_kind: bool
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
    split = [_TOKEN.findall(_COMMA.sub(".", file.rpartition(".")[0])) for file in files]
    if len({tuple(map(_form, tokens)) for tokens in split}) != 1:
        return None
    parts: list[str] = []
    words: list[str] = []
    used: set[str] = set()
    for i, column in enumerate(zip(*split, strict=True)):
        token, differs = column[0], len(set(column)) > 1
        quantity = _quantity([t.lower() for t in split[0]], i) if _form(token) == "number" else ""
        if quantity and quantity not in used and (quantity != "nr" or differs):
            used.add(quantity)
            integers = quantity != "pressure_bar" and all(each.isdigit() for each in column)
            parts.append(f"{{{quantity}:{'d' if integers else 'g'}}}")
        elif not differs:
            parts.append(token)
        elif quantity:
            parts.append(f"{{part{i}}}")
        else:
            words.append(f"word{i}" if words else "kind")
            parts.append(f"{{{words[-1]}}}")
    text = "".join(parts) + "." + files[0].rpartition(".")[2]
    return NamesRead(name_pattern(text), len(words) == 1, any(_COMMA.search(file) for file in files))


def _form(token: str) -> str:
    return "number" if token[0].isdigit() else "word" if token[0].isalpha() else token


def _quantity(tokens: list[str], at: int) -> str:
    """Return the quantity of a number by the words beside it; ``nr`` for any other number."""
    before = next((t for t in reversed(tokens[:at]) if t[0].isalnum()), "")
    after = next((t for t in tokens[at + 1 :] if t[0].isalnum()), "")
    return next((q for q, (left, right) in _BESIDE.items() if after in right or before in left), "nr")


# ---- What the recordings of a folder say about an experiment: operating points, kinds, junk, and harmonics of run-out.

STILL = 0.5e-6
"""Largest movement of r and u at rest [m], as for `gbid.identify_runout`."""


@dataclass(frozen=True, eq=False)
class DraftedFile(MeasuredFile):
    """One measured file with what its name and its signals say.

    Attributes
    ----------
    recording : Recording
        The part of it that is used, with its operating point.
    kind : str
        ``excited`` when the piezos move, else ``stationary``.
    """

    recording: Recording
    kind: Kind

    @property
    def point(self) -> tuple[float, ...]:
        """Operating point: pressure [bar] and speed [rpm]."""
        return tuple(self.recording.conditions[key] for key in POINT)


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
    part : dict of str to float
        Part of the files to use, ``from_s`` and ``to_s`` [s], as far as it is limited.
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
    part: Mapping[str, float]
    harmonics: int | None
    runout: tuple[str, ...]
    notes: tuple[str, ...]


def read_data(options: DraftOptions, files: Sequence[MeasuredFile]) -> DraftData:
    """Return what measured files say.

    Raises
    ------
    DataError
        When a file cannot be imported.
    UnansweredError
        When the names of the files do not contain the operating point.
    """
    names = _names(options, files)
    recordings = []
    for file in files:
        clock = {"sample_time_s": options.sample_time_s} if options.sample_time_s else {"time": file.time}
        units = {name: {"unit": unit} for name, unit in file.units.items()}
        signals = {name: {"columns": list(names), **units.get(name, {})} for name, names in file.signals.items()}
        conditions = _conditions(options, names, file.path)
        recordings.append(import_recording(file.path, {**clock, "signals": signals, "conditions": conditions}))
    part, notes = _part(options, recordings)
    drafted = []
    for file, rec in zip(files, recordings, strict=True):
        first = round(part.get("from_s", 0.0) / rec.sample_time)
        last = round(part["to_s"] / rec.sample_time) if "to_s" in part else rec.n_samples
        used = rec.slice(min(first, rec.n_samples - 1), min(last, rec.n_samples))
        drafted.append(DraftedFile(**vars(file), recording=used, kind="excited" if _moves(used) else "stationary"))
    kinds = None if names is None or names.commas else _kinds(names, drafted)
    harmonics, words = find_harmonics(drafted)
    notes += [*_remarks(recordings), *words]
    known = None if kinds is None else names
    return DraftData(tuple(drafted), known, kinds or {}, part, harmonics, words, tuple(notes))


def _names(options: DraftOptions, files: Sequence[MeasuredFile]) -> NamesRead | None:
    """Return the pattern of the names of the most files of one kind, or the given one."""
    if options.pattern is not None:
        pattern = name_pattern(options.pattern)
        if not any(pattern.read(file.path.name) is not None for file in files):
            raise UsageError(f"--pattern: no file of {options.folder} matches {options.pattern!r}")
        return NamesRead(pattern, "kind" in pattern.fields)
    groups: dict[tuple[object, ...], list[str]] = {}
    for file in files:
        key = (file.path.suffix, file.time, tuple(file.signals.items()))
        groups.setdefault(key, []).append(file.path.name)
    return read_names(max(groups.values(), key=len))


def _conditions(options: DraftOptions, names: NamesRead | None, path: Path) -> dict[str, float]:
    """Return the operating point of a file: as given, or by the pattern, whatever the ending, or by its name alone."""
    fields = names.read(f"{path.stem}.{names.pattern.text.rpartition('.')[2]}") if names else None
    if not fields:
        alone = read_names([path.name])
        fields = (alone.read(path.name) if alone else None) or {}
    conditions = {}
    for key in POINT:
        given = getattr(options, key)
        value = fields.get(key) if given is None else given
        if value is None:
            raise UnansweredError(key, f"{path.name}: the name does not contain {key}")
        conditions[key] = float(value)
    return conditions


def _part(options: DraftOptions, recordings: Sequence[Recording]) -> tuple[dict[str, float], list[str]]:
    """Return the part that is used of all files, as given or with a constant speed of the shaft, and notes on it."""
    given = {key: value for key in ("from_s", "to_s") if (value := getattr(options, key)) is not None}
    if given:
        return given, []
    changes = {rec.name: change for rec in recordings if (change := speed_change(rec)) and change.steady}
    starts = [change.from_s for change in changes.values() if change.from_s is not None]
    ends = [change.to_s for change in changes.values() if change.to_s is not None]
    part = {"from_s": math.ceil(10 * max(starts)) / 10} if starts else {}
    part |= {"to_s": math.floor(10 * min(ends)) / 10} if ends else {}
    words = " ".join(f"{key}: {value:g}" for key, value in part.items())
    shortest = min(recordings, key=lambda rec: rec.duration)
    if part.get("from_s", 0.0) >= part.get("to_s", shortest.duration):
        raise DataError(
            f"{shortest.name}: no part of all files has a constant speed ({words} of "
            f"{shortest.duration:g} s); give --from-s and --to-s, or leave out the files with a run-up"
        )
    note = f"the speed changes in {len(changes)} of {len(recordings)} files, so of all files is used {words}"
    return part, [note] if part else []


def _remarks(recordings: Sequence[Recording]) -> list[str]:
    """Return the remarks of the import, one for all files whose remarks differ in numbers only."""
    alike: dict[str, list[str]] = {}
    for rec in recordings:
        if remark := rec.provenance.get("import_remarks"):
            alike.setdefault(re.sub(r"[\d.]+", "", remark), []).append(f"{rec.name}: {remark}")
    return [first + (f" ({len(others)} more files alike)" if others else "") for first, *others in alike.values()]


def _moves(rec: Recording) -> bool:
    """Return whether the piezos move."""
    driven = (rec.signal(name) for name in ("r", "u") if name in rec.signals)
    return any(np.ptp(running_median(signal, 3), axis=0).max() > STILL for signal in driven)


def _kinds(names: NamesRead, files: Sequence[DraftedFile]) -> dict[str, Kind] | None:
    """Return the kind of each word of the names, empty where gbid knows them all.

    None when the names do not tell the kinds that the signals show: a word has two kinds, or a stationary recording has
    no word.
    """
    kinds: dict[str, Kind] = {}
    for file in files:
        if (fields := names.read(file.path.name)) is not None:
            word = str(fields.get("kind", ""))
            expected = file.kind if word and names.tells_kind else KINDS.get(word, "excited")
            if kinds.setdefault(word, expected) != file.kind:
                return None
    kinds.pop("", None)
    return {} if all(KINDS.get(word) == kind for word, kind in kinds.items()) else kinds


def find_harmonics(files: Sequence[DraftedFile]) -> tuple[int | None, tuple[str, ...]]:
    """Return the number of harmonics of the run-out maps, and what is left over at each operating point, as text.

    It is the largest number chosen at an operating point by stationary recordings on held-out data; None when no map
    can be compared.
    """
    points: dict[tuple[float, ...], list[Recording]] = {}
    for file in files:
        if file.kind == "stationary" and "phi" in file.signals:
            still = points.setdefault(file.point, [])
            still.append(replace(file.recording, name=f"{file.recording.name} {len(still)}"))
    sizes, words = [], []
    for point, still in sorted(points.items()):
        label = point_label(*point)
        try:
            chosen = compare_runout(still, bins=()).chosen
        except DataError as error:
            words.append(f"{label}: not compared ({error})")
            continue
        if chosen.method == "harmonics":
            sizes.append(chosen.size)
            left = ", ".join(f"{1e9 * rms:.0f}" for rms in chosen.residual_rms)
            words.append(f"{label}: {chosen.size} harmonics leave {left} nm")
    return max(sizes, default=None), tuple(words)


# ---- Text of a drafted experiment: commented YAML.


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
    left_out = (f"left out, of a kind that is not imported: {', '.join(others)}",) if others else ()
    return Draft(draft_text(target, options, data), (*data.notes, *left_out))


def draft_text(target: Path, options: DraftOptions, data: DraftData) -> str:
    """Return the YAML of an experiment for a folder, from what was given and what the files say.

    Raises
    ------
    DataError
        When no recording is excited.
    """
    excited = [file for file in data.files if file.kind == "excited"]
    if not excited:
        raise DataError(f"{options.folder}: r and u move in no file; add recordings with an excitation")
    points = np.array([file.point for file in excited])
    distinct, counts = np.unique(points, axis=0, return_counts=True)
    stems = [name_of(file.path.stem) for file in data.files]
    names = {  # with the ending where two files would have one name
        file.path: name_of(file.path.name if stems.count(stem) > 1 else file.path.stem)
        for file, stem in zip(data.files, stems, strict=True)
    }
    patterned = [file for file in data.files if data.names and data.names.pattern.read(file.path.name) is not None]
    mapped = {file.point for file in data.files if file.kind == "stationary"}
    environment = Environment(
        loader=PackageLoader("gbid.experiment", "."), undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters |= {"quoted": lambda text: json.dumps(str(text), ensure_ascii=False), "seconds": _seconds}
    return environment.get_template("draft.yaml.j2").render(
        name=name_of(target.name),
        data_folder=os.path.relpath(options.folder.resolve(), target.resolve()),
        options=options,
        data=data,
        patterned=patterned,
        alone=[file for file in data.files if file not in patterned],
        names=names,
        has_maps=mapped.issuperset(file.point for file in excited)
        and all("phi" in file.signals for file in data.files),
        has_references=all("r" in file.signals for file in excited),
        n_excited=len(excited),
        n_points=len(distinct),
        repeated=counts.min() > 1,
        order=order_words(possible_order(points)),
        sample_time=excited[0].recording.sample_time,
    )


def _seconds(value: float) -> str:
    """Return a time with a decimal point, as YAML needs it for a number."""
    text = f"{value:.6g}"
    return text if "." in text else text.replace("e", ".0e") if "e" in text else f"{text}.0"
