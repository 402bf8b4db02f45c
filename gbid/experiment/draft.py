"""Draft of an experiment from a folder of measured files: roles of channels, names, kinds, and the YAML."""

from __future__ import annotations

import json
import math
import os
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined

from gbid.core.arrays import point_label
from gbid.core.errors import DataError, UsageError, nearest
from gbid.core.units import conversion_factor
from gbid.experiment.experiment import POINT, by_count
from gbid.experiment.schema import KINDS, Kind, NamePattern, name_of, name_pattern
from gbid.lpv import MachineData
from gbid.lpv.estimates import order_words, possible_order
from gbid.prefilter.filtering import repair_overloads
from gbid.prefilter.runout import running_median
from gbid.prefilter.runout_identification import compare_runout
from gbid.recording import Recording, import_recording
from gbid.recording.formats import file_formats, format_of
from gbid.recording.importing import list_channels
from gbid.recording.quality import speed_change
from gbid.recording.readers import FileChannel

# ---- Roles of the channels of a file, by their names.

_WORDS = {
    "r": {"r", "ref", "cmd", "command", "demand"},
    "u": {"u", "stack", "stellweg", "stellgröße"},
    "phi": {"phi", "angle", "theta", "resolver"},
    "p": {"p", "pos", "weg", "wege", "disp", "displacement", "disc", "disk", "gap", "probe", "shaft", "rotor"},
}
_STEMS = {  # first letters of words, for compounds such as Sollwert and Winkelgeber
    "r": ("soll", "refer", "setpoint", "führung", "fuehrung"),
    "u": ("piezo", "aktor", "aktuator", "actuator"),
    "phi": ("winkel", "drehwinkel", "drehgeber", "encoder"),
    "p": ("spalt", "position", "wegsensor", "wegaufnehmer", "scheibe", "auslenkung", "welle"),
}
_OTHER = re.compile("drehzahl|speed|rpm|umin|druck|pressure|temp|kraft|force|strom|current|spannung|voltage|trigger")
_TIME = {"t", "time", "zeit", "timestamp", "zeitstempel", "sekunden", "seconds"}
_AXES = {
    "x": 0,
    "a": 0,
    "h": 0,
    "hor": 0,
    "horizontal": 0,
    "y": 1,
    "b": 1,
    "v": 1,
    "ver": 1,
    "vertical": 1,
    "vertikal": 1,
}
_SHORT = re.compile(r"(r|u|p)([xyabhv12])")
_CAMEL = re.compile(r"(?<=[a-zäöüß])(?=[A-ZÄÖÜ])")
_ORDER = ("r", "u", "p", "phi")
_UNKNOWN = "no known name of a signal"


class Roles(NamedTuple):
    """Roles of the columns of a file.

    Attributes
    ----------
    time : str or None
        Column of the sample times if there is one.
    signals : dict of str to tuple of str
        Columns by signal: two for ``r``, ``u``, ``p``, one for ``phi``.
    columns : dict of str to tuple of str
        Of every column, what it is taken as (empty when it is not used), and the reason.
    """

    time: str | None
    signals: Mapping[str, tuple[str, ...]]
    columns: Mapping[str, tuple[str, str]]

    @property
    def has_unknown(self) -> bool:
        """Whether a column may belong to a signal that was not found: it is not used, and its name says nothing."""
        return any(not taken and reason.startswith(_UNKNOWN) for taken, reason in self.columns.values())


def find_roles(channels: Sequence[FileChannel], given: Mapping[str, tuple[str, ...]], time: str | None) -> Roles:
    """Return the roles of the channels of a file, those given first.

    Parameters
    ----------
    channels : sequence of FileChannel
        Channels of the file.
    given : dict of str to tuple of str
        Columns by signal, where they are known; an empty tuple for a signal that the file does not have.
    time : str or None
        Column of the sample times, where it is known.
    """
    longest = max((channel.n_samples for channel in channels), default=0)
    usable = {channel.name: channel for channel in channels if not channel.remark and channel.n_samples == longest}
    reasons = {
        channel.name: ("", channel.remark or f"{channel.n_samples} of {longest} samples") for channel in channels
    }
    was_given = time is not None
    if time is None:
        rising = [name for name, channel in usable.items() if channel.step is not None]
        named = [name for name in rising if _TIME & set(_split(name))]
        time = named[0] if named else rising[0] if len(rising) == 1 else None
    axes: dict[str, dict[int, str]] = {role: {} for role in _ORDER}
    for name in usable:
        role, axis, why = _role(name)
        first = axes[role].setdefault(axis, name) if role and name != time else name
        reasons[name] = ("", why if first == name else f"{why}, as {first!r} before it")
    pairs = {role: tuple(name for _, name in sorted(names.items())) for role, names in axes.items()}
    complete = {role: names for role, names in pairs.items() if len(names) == (1 if role == "phi" else 2)}
    complete = {role: names for role, names in (complete | dict(given)).items() if names}
    for role, names in complete.items():
        for letter, name in zip(("x", "y"), names, strict=False):
            why = "given" if given.get(role) else reasons[name][1]
            reasons[name] = (role if role == "phi" else f"{role} {letter}", why)
    if time is not None:
        reasons[time] = ("time", "given" if was_given else "rises evenly")
    return Roles(time, {role: complete[role] for role in _ORDER if role in complete}, reasons)


def _split(name: str) -> list[str]:
    return re.findall(r"[^\W\d_]+|\d+", _CAMEL.sub(" ", name).lower())


def _role(name: str) -> tuple[str | None, int, str]:
    """Return the role of a channel by its name, the number of its axis, and the reason."""
    words = _split(name)
    if short := _SHORT.fullmatch("".join(words)):
        words = [short[1], short[2]]
    if words in (["x"], ["y"]):
        return "p", _AXES[words[0]], f"axis {words[0]} alone"
    for word in words:
        if _OTHER.match(word):
            return None, 0, f"{word!r} is none of r, u, p and phi"
    for role in _WORDS:
        if word := next((w for w in words if w in _WORDS[role] or w.startswith(_STEMS[role])), ""):
            if role == "phi":
                return role, 0, f"{word!r}"
            axis = words[-1] if words[-1].isdecimal() else next((w for w in reversed(words) if w in _AXES), "")
            number = int(axis) if axis.isdecimal() else _AXES.get(axis, 0)
            return role, number, f"{word!r}, axis {axis}" if axis else f"{word!r}, no axis"
    return None, 0, _UNKNOWN


def column_lines(roles: Mapping[Path, Roles]) -> tuple[str, ...]:
    """Return the lines of a table of all columns and what they are taken as, once for files with equal columns."""
    alike: dict[tuple[object, ...], list[Path]] = {}
    for path, each in roles.items():
        alike.setdefault(tuple(each.columns.items()), []).append(path)
    lines = []
    for paths in alike.values():
        columns = roles[paths[0]].columns
        width = max(map(len, columns))
        more = f" and {len(paths) - 1} more" if len(paths) > 1 else ""
        lines.append(f"columns of {paths[0].name}{more}, and what they are taken as:")
        lines += [f"  {name:{width}}  {taken or 'not used':8}  {why}" for name, (taken, why) in columns.items()]
    return tuple(lines)


# ---- What a user says about a folder of measured files, and the questions that remain.

QUESTIONS = {
    "u": "columns of the piezo positions, x then y, with a comma between",
    "p": "columns of the disc position, x then y, with a comma between",
    "r": "columns of the references of the piezos, x then y, with a comma between; nothing for none",
    "phi": "column of the shaft angle; nothing for none",
    "time": "column of the sample times",
    "unit": "unit of the positions in the files, such as um",
    "pressure_bar": "injection pressure of all files [bar]",
    "speed_rpm": "rotational speed of all files [rpm]",
}
"""Questions by option, in the order in which they are asked."""
OPTIONAL = {
    "r": "without r there is no model of the piezos, and no controller",
    "phi": "without phi there is no map of run-out, and no run-up is cut away",
}
"""Signals that an experiment can do without, and what it lacks then."""


class UnansweredError(UsageError):
    """Things that the files do not say and that must be given.

    Parameters
    ----------
    reasons : dict of str to str
        Why each option is open.
    columns : sequence of str
        Lines of the table of columns.
    """

    def __init__(self, reasons: Mapping[str, str], columns: Sequence[str]) -> None:
        self.reasons = {option: reasons[option] for option in QUESTIONS if option in reasons}
        self.columns = tuple(columns)
        texts = [f"{why}; give the {QUESTIONS[option]}: {_flag(option)}" for option, why in self.reasons.items()]
        super().__init__("\n".join(texts))


def _flag(option: str) -> str:
    if option in _ORDER:
        return f"--signal {option}={'X' if option == 'phi' else 'X,Y'}"
    return f"--{option.split('_')[0]} ..."


@dataclass(frozen=True)
class DraftOptions:
    """Answers about a folder of measured files; what is not given is found in the files.

    Attributes
    ----------
    folder : pathlib.Path
        Folder of the files.
    signals : dict of str to tuple of tuple of str
        Columns of ``r``, ``u``, ``p`` and ``phi``. Files with other names need more than one entry of a signal; a
        signal without any is in no file.
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
    machine : gbid.lpv.MachineData
        Moving mass, travel of the piezos and clearance, which no file says.
    ask : bool
        Whether someone answers; signals that an experiment can do without are asked for only then.
    """

    folder: Path
    signals: Mapping[str, tuple[tuple[str, ...], ...]] = field(default_factory=dict)
    time: str | None = None
    sample_time_s: float | None = None
    unit: str | None = None
    pattern: str | None = None
    from_s: float | None = None
    to_s: float | None = None
    pressure_bar: float | None = None
    speed_rpm: float | None = None
    controller: str = "P"
    machine: MachineData = field(default_factory=MachineData)
    ask: bool = False

    def answered(self, option: str, text: str) -> DraftOptions:
        """Return the options with one more answer.

        Raises
        ------
        UsageError
            When a number was expected.
        """
        value: Any = text.strip()
        if option in _ORDER:
            names = tuple(name for word in text.split(",") if (name := word.strip()))
            if len(names) not in ({0, 1} if option == "phi" else {0, 2} if option in OPTIONAL else {2}):
                raise UsageError(f"{option}: expected the {QUESTIONS[option]}; found {text!r}")
            added = (*self.signals.get(option, ()), names) if names else ()
            option, value = "signals", {**self.signals, option: added}
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


@dataclass(frozen=True, eq=False)
class Survey:
    """What the headings and names of the files of a folder say.

    Attributes
    ----------
    files : tuple of MeasuredFile
        The measured files.
    others : tuple of str
        Names of files of other kinds.
    columns : tuple of str
        Lines of the table of columns.
    notes : tuple of str
        Signals that no column is taken as, though there are columns that are not used; files that cannot be read.
    """

    files: tuple[MeasuredFile, ...]
    others: tuple[str, ...]
    columns: tuple[str, ...]
    notes: tuple[str, ...]


def survey(options: DraftOptions) -> Survey:
    """Return the measured files of a folder, with the roles of their columns.

    Raises
    ------
    UsageError
        When the folder holds no file that can be imported, or when a given channel is in no file.
    UnansweredError
        With all that must be given: columns of u and p, time, unit, and operating point.
    DataError
        When a file cannot be read.
    """
    folder = options.folder
    if not folder.is_dir():
        raise UsageError(f"no folder {folder}; name the folder of the measured files")
    listed = sorted((p for p in folder.iterdir() if p.is_file()), key=lambda p: by_count(p.name))
    known = [path for path in listed if path.suffix.lower() in file_formats()]
    channels, unread = ({path: list_channels(path) for path in known}, {}) if known else _tables_among(listed)
    if unread and not channels:
        raise next(iter(unread.values()))
    if not channels:
        raise UsageError(f"{folder} holds no file that can be imported; expected {', '.join(file_formats())}")
    _refuse_unknown(options, channels)
    roles = {path: find_roles(each, *_given(options, each)) for path, each in channels.items()}
    units: dict[str, str] = {}  # of each signal in the first file that states one
    for path, each in channels.items():
        stated = {channel.name: channel.unit for channel in each if channel.unit}
        units = {s: stated[columns[0]] for s, columns in roles[path].signals.items() if columns[0] in stated} | units
    reasons: dict[str, str] = {}
    files = [_measured(path, each, roles[path], units, options, reasons) for path, each in channels.items()]
    names = _names(options, files)
    for file, key in ((file, key) for file in files for key in POINT):
        if _conditions(options, names, file.path)[key] is None:
            reasons.setdefault(key, f"{file.path.name}: the name does not contain {key}")
    columns = column_lines(roles)
    optional = {key: why for key, why in reasons.items() if key in OPTIONAL}
    if len(reasons) > len(optional) or (optional and options.ask):
        raise UnansweredError(reasons, columns)
    notes = tuple(f"{why}; {OPTIONAL[key]}: {_flag(key)}" for key, why in optional.items())
    notes += tuple(f"left out: {error}" for error in unread.values())
    others = tuple(path.name for path in listed if path not in channels and path not in unread)
    return Survey(tuple(files), others, columns, notes)


def _tables_among(listed: Sequence[Path]) -> tuple[dict[Path, list[FileChannel]], dict[Path, DataError]]:
    """Return the channels of files without a known ending, and the errors of those without a table."""
    channels, unread = {}, {}
    for path in filter(format_of, listed):
        try:
            channels[path] = list_channels(path)
        except DataError as error:
            unread[path] = error
    return channels, unread


def _refuse_unknown(options: DraftOptions, channels: Mapping[Path, Sequence[FileChannel]]) -> None:
    """Refuse given columns that are in no file."""
    known = [[channel.name for channel in each] for each in channels.values()]
    wanted = [columns for each in options.signals.values() for columns in each]
    for columns in (*wanted, *([(options.time,)] if options.time else [])):
        if not any(_columns_in(columns, names) for names in known):
            missing = next((c for c in columns if not any(_columns_in((c,), names) for names in known)), columns[0])
            names = dict.fromkeys(chain.from_iterable(known))
            raise UsageError(
                f"{options.folder}: no file has the channels {', '.join(columns)}; {nearest(missing, names)}"
            )


def _given(options: DraftOptions, channels: Sequence[FileChannel]) -> tuple[dict[str, tuple[str, ...]], str | None]:
    """Return the given columns of each signal, and of the time, as far as a file has them."""
    names = [channel.name for channel in channels]
    given: dict[str, tuple[str, ...]] = {}
    for signal, entries in options.signals.items():
        columns_in_file = next((columns for entry in entries if (columns := _columns_in(entry, names))), None)
        if columns_in_file or not entries:
            given[signal] = columns_in_file or ()
    time = _columns_in((options.time,), names) if options.time else None
    return given, time[0] if time else None


def _columns_in(columns: Sequence[str], names: Sequence[str]) -> tuple[str, ...] | None:
    """Return the names of columns in a file: as given, or with the name of a structure before them."""
    matches = [name if name in names else [n for n in names if n.endswith(f".{name}")] for name in columns]
    single = tuple(
        each if isinstance(each, str) else each[0] for each in matches if isinstance(each, str) or len(each) == 1
    )
    return single if len(single) == len(columns) else None


def _measured(
    path: Path,
    channels: Sequence[FileChannel],
    roles: Roles,
    usual: Mapping[str, str],
    options: DraftOptions,
    reasons: dict[str, str],
) -> MeasuredFile:
    """Return a file with the units that its mapping states, as given or as in the other files; add what is open."""
    names = ", ".join(channel.name for channel in channels)
    for signal in _ORDER:
        needed = signal in ("u", "p") or (roles.has_unknown and signal not in options.signals)
        if signal not in roles.signals and needed:
            reasons.setdefault(signal, f"{path}: its channels do not show which are {signal}: {names}")
    if roles.time is None and options.sample_time_s is None:
        reasons.setdefault("time", f"{path}: no column rises evenly as a time does")
    stated = {channel.name for channel in channels if channel.unit}
    units = {}
    for signal in dict.fromkeys((*roles.signals, "u", "p")):
        columns = roles.signals.get(signal)
        if stated.intersection(columns or [name for name, (taken, _) in roles.columns.items() if not taken]):
            continue
        is_angle = signal == "phi"
        unit = usual.get(signal, "") if is_angle else options.unit or usual.get(signal)
        if unit is None:
            reasons.setdefault("unit", f"{path}: the file states no unit of {signal}")
        elif columns:
            if unit:
                conversion_factor(unit, "rad" if is_angle else "m")
            units[signal] = unit
    return MeasuredFile(path, roles.time, roles.signals, units)


# ---- Operating point and kind of recordings from the names of their files.

_COMMA = re.compile(r"(?<=\d),(?=\d)")
_TOKEN = re.compile(r"\d+(?:\.\d+)?|[^\W\d_]+|[\W_]")
_BESIDE = {  # words before and after the number
    "pressure_bar": ({"p", "druck", "pressure", "press"}, {"bar"}),
    "speed_rpm": (
        {"n", "drehzahl", "speed", "rpm", "omega"},
        {"rpm", "upm", "u", "umin", "umdr", "umdrmin", "umdrehungen", "min", "rev", "revs"},
    ),
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
    """
    names = _names(options, files)
    files, angles = _angle_units(options, files)
    recordings = [_import(options, file, _conditions(options, names, file.path)) for file in files]
    part, notes = _part(options, recordings)
    notes += angles
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


def _import(options: DraftOptions, file: MeasuredFile, conditions: Mapping[str, float | None]) -> Recording:
    clock = {"sample_time_s": options.sample_time_s} if options.sample_time_s else {"time": file.time}
    units = {name: {"unit": unit} for name, unit in file.units.items()}
    signals = {name: {"columns": list(names), **units.get(name, {})} for name, names in file.signals.items()}
    return repair_overloads(import_recording(file.path, {**clock, "signals": signals, "conditions": conditions}))


def _angle_units(options: DraftOptions, files: Sequence[MeasuredFile]) -> tuple[list[MeasuredFile], list[str]]:
    """Return the files with a unit of the shaft angle where they state none, by the range of its numbers, and a note.

    Degrees when an angle that falls back once a turn reaches beyond one turn in radians.
    """
    unstated = [file for file in files if file.units.get("phi") == ""]
    if not unstated:
        return list(files), []
    largest = 0.0
    for file in unstated:
        alone = replace(file, signals={"phi": file.signals["phi"]}, units={"phi": "rad"})
        phi = _import(options, alone, {}).signal("phi")[:, 0]
        if np.ptp(phi) < 2 * np.ptp(np.diff(phi)):  # it falls back by nearly its whole range
            largest = max(largest, float(np.abs(phi).max()))
    unit = "deg" if 1.1 * 2 * np.pi < largest < 1.1 * 360 else "rad"
    known = [replace(file, units={**file.units, "phi": unit}) if file in unstated else file for file in files]
    return known, [
        f"{len(unstated)} files state no unit of phi: its numbers reach {largest:g}, so it is read in {unit}"
    ]


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


def _conditions(options: DraftOptions, names: NamesRead | None, path: Path) -> dict[str, float | None]:
    """Return the operating point of a file: as given, or by the pattern, whatever the ending, or by its name alone.

    None where the name does not contain it.
    """
    fields = names.read(f"{path.stem}.{names.pattern.text.rpartition('.')[2]}") if names else None
    if not fields:
        alone = read_names([path.name])
        fields = (alone.read(path.name) if alone else None) or {}
    conditions: dict[str, float | None] = {}
    for key in POINT:
        given = getattr(options, key)
        value = fields.get(key) if given is None else given
        conditions[key] = None if value is None else float(value)
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
    columns : tuple of str
        Lines of a table of all columns and what they are taken as.
    """

    text: str
    notes: tuple[str, ...]
    columns: tuple[str, ...]


def draft_experiment(
    options: DraftOptions, target: Path, complete: Callable[[MachineData], MachineData] | None = None
) -> Draft:
    """Return an experiment for a gas bearing with the recordings of a folder.

    Columns, units, operating points, kinds of recordings, the part with a constant speed and the harmonics of run-out
    are found in the files and their names, unless they are given.

    Parameters
    ----------
    options : DraftOptions
        The folder, and what is given.
    target : pathlib.Path
        Folder that the experiment will be written to.
    complete : callable, optional
        Asks for the numbers of the machine that are not given; called when everything else is known.

    Raises
    ------
    UnansweredError
        When something is neither found nor given.
    UsageError
        When what is given does not fit the files.
    DataError
        When a file cannot be read.
    """
    surveyed = survey(options)
    data = read_data(options, surveyed.files)
    text = draft_text(target, options, data)
    if complete is not None:
        options = replace(options, machine=complete(options.machine))
        text = draft_text(target, options, data)
    left_out = (f"left out, of a kind that is not imported: {', '.join(surveyed.others)}",) if surveyed.others else ()
    return Draft(text, (*data.notes, *surveyed.notes, *left_out, *_unknown(options)), surveyed.columns)


_NEEDED = {
    "moving_mass_kg": ("--moving-mass KG", "the response to an impact (rows disc, stack and decay)"),
    "piezo_travel_m": ("--travel UM", "limits of the stacks in the control chain in C"),
    "clearance_m": ("--clearance UM", "the limit of the disc in the control chain in C"),
}
"""Numbers of a machine by their key: the option that gives each, and what is left out without it."""


def _unknown(options: DraftOptions) -> list[str]:
    """Return a line on the numbers of the machine that are not given."""
    missing = [words for key, words in _NEEDED.items() if getattr(options.machine, key) is None]
    if not missing:
        return []
    what, flags = "; ".join(what for _, what in missing), ", ".join(flag for flag, _ in missing)
    return [f"not known, so left out: {what}. Give {flags}, or the section machine of the YAML"]


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
        machine={key: getattr(options.machine, key) for key in _NEEDED},
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
