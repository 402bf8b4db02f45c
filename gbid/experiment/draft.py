"""Draft of an experiment from a folder of measured files: channels, names, kinds, operating points, YAML."""

from __future__ import annotations

import json
import math
import os
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined

from gbid.core.arrays import FloatArray, point_label
from gbid.core.errors import DataError, GbidError, UsageError, nearest
from gbid.core.units import conversion_factor, is_ambiguous, is_speed_unit, is_unit
from gbid.experiment.experiment import POINT, by_count
from gbid.experiment.schema import (
    KINDS,
    Kind,
    NamesRead,
    factor_or_zero,
    name_of,
    name_pattern,
    read_names,
    tokens_of,
)
from gbid.lpv import MachineData
from gbid.lpv.estimates import order_words, possible_order
from gbid.prefilter.filtering import repair_overloads
from gbid.prefilter.runout import running_median
from gbid.prefilter.runout_identification import compare_runout
from gbid.recording import Recording
from gbid.recording.formats import file_formats, format_of, format_of_ending
from gbid.recording.importing import import_recording, list_channels
from gbid.recording.mapping import Calibration, TextOptions
from gbid.recording.quality import BLOCK, FEW_LEVELS, speed_change, turning_increments
from gbid.recording.readers import FileChannel
from gbid.recording.roles import ROLES, Roles, column_lines, find_roles

# ---- Answers of the user about a folder of measured files, and the open questions.

QUESTIONS = {
    "u": "columns of the piezo positions, x then y, with a comma between",
    "p": "columns of the disc position, x then y, with a comma between",
    "r": "columns of the references of the piezos, x then y, with a comma between; nothing for none",
    "phi": "column of the shaft angle; nothing for none",
    "time": "column of the sample times",
    "unit": "unit of the positions in the files, such as um",
    "calibration": "numbers in the file and values of a column, with their unit, such as X=0:0 10:125 um",
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
    """Error with the questions that the files leave open.

    Parameters
    ----------
    reasons : dict of str to str
        Why each option is open.
    columns : sequence of str
        Lines of the table of columns.
    broken : sequence of str
        Lines on files that cannot be read.
    """

    def __init__(self, reasons: Mapping[str, str], columns: Sequence[str], broken: Sequence[str] = ()) -> None:
        self.reasons = {option: reasons[option] for option in QUESTIONS if option in reasons}
        self.columns = tuple(columns)
        texts = [f"{why}; give the {QUESTIONS[option]}: {_flag(option)}" for option, why in self.reasons.items()]
        super().__init__("\n".join([*texts, *broken]))


def _flag(option: str) -> str:
    if option in ROLES:
        return f"--signal {option}={'X' if option == 'phi' else 'X,Y'}"
    return "--calibration 'X=0:0 10:125 um'" if option == "calibration" else f"--{option.split('_')[0]} ..."


def calibration_of(text: str) -> tuple[str, tuple[Calibration, str]]:
    """Return column, calibration and unit from a text such as ``X=0:0 10:125 um``.

    Raises
    ------
    UsageError
        When the text has another form.
    """
    column, _, sheet = text.rpartition("=")
    *pairs, unit = sheet.split() or [""]
    try:
        points = tuple((float(a), float(b)) for a, b in (pair.replace(",", ".").split(":") for pair in pairs))
        known = Calibration(points) if column and is_unit(unit) and not unit[:1].isdigit() else None
    except ValueError as error:
        raise UsageError(f"--calibration: {text!r}: {error}") from None
    if known is None:
        raise UsageError(
            f"--calibration: expected a column with its points and their unit, X=0:0 10:125 um; found {text!r}"
        )
    return column.strip(), (known, unit)


@dataclass(frozen=True)
class DraftOptions:
    """Answers of the user about a folder of measured files; everything else is read from the files.

    Attributes
    ----------
    folder : pathlib.Path
        Folder of the files.
    signals : dict of str to tuple of tuple of str
        Columns of ``r``, ``u``, ``p`` and ``phi``. Files with other names need more than one entry of a signal; a
        signal without any is in no file.
    time : str or None
        Column of the sample times.
    sample_time : float or None
        Time between samples [s].
    unit : str or None
        Unit of positions in files that state none.
    units : dict of str to str
        Units by signal.
    calibrations : dict of str to (Calibration, str)
        Calibrations by column, with the unit of the calibrated values.
    time_unit : str or None
        Unit of the time column.
    text : TextOptions
        Layout of text files.
    pattern : str or None
        Pattern of the file names.
    from_s, to_s : float or None
        Part of each file to use [s].
    pressure_bar, speed_rpm : float or None
        Operating point of all files, where the names do not contain it.
    kinds : dict of str to str
        Kinds of recordings by words in the names of their files; the kind of others is found in their signals.
    skip_broken : bool
        Whether files that cannot be read or have a dead channel are left out.
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
    sample_time: float | None = None
    unit: str | None = None
    units: Mapping[str, str] = field(default_factory=dict)
    calibrations: Mapping[str, tuple[Calibration, str]] = field(default_factory=dict)
    time_unit: str | None = None
    text: TextOptions = field(default_factory=TextOptions)
    pattern: str | None = None
    from_s: float | None = None
    to_s: float | None = None
    pressure_bar: float | None = None
    speed_rpm: float | None = None
    kinds: Mapping[str, Kind] = field(default_factory=dict)
    skip_broken: bool = False
    controller: str = "P"
    machine: MachineData = field(default_factory=MachineData)
    ask: bool = False

    def answered(self, option: str, text: str) -> DraftOptions:
        """Return these options with one more answer.

        Raises
        ------
        UsageError
            When a number was expected.
        """
        value: Any = text.strip()
        if option in ROLES:
            names = tuple(name for word in text.split(",") if (name := word.strip()))
            if len(names) not in ({0, 1} if option == "phi" else {0, 2} if option in OPTIONAL else {2}):
                raise UsageError(f"{option}: expected the {QUESTIONS[option]}; found {text!r}")
            added = (*self.signals.get(option, ()), names) if names else ()
            option, value = "signals", {**self.signals, option: added}
        elif option == "unit" and "=" in text:
            signal, _, unit = text.partition("=")
            option, value = "units", {**self.units, signal.strip(): unit.strip()}
        elif option == "calibration":
            option, value = "calibrations", {**self.calibrations, **dict([calibration_of(text)])}
        elif option in POINT:
            try:
                value = float(text.replace(",", "."))
            except ValueError:
                raise UsageError(f"{option}: expected a number, found {text!r}") from None
        return replace(self, **{option: value})

    def text_of(self, path: Path) -> TextOptions | None:
        """Return the given layout of a text file; None for other kinds of files."""
        kind = format_of(path)
        return self.text if kind is not None and kind.layout is not None else None


# ---- Survey of a folder of measured files: channels and mappings.


@dataclass(frozen=True, eq=False)
class MeasuredFile:
    """Measured file with its channels and mapping.

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
    calibrations : dict of str to tuple of Calibration
        Calibration of each column, by signal.
    sources : dict of str to str
        Columns that measure the operating point, as far as the name of the file does not contain it.
    """

    path: Path
    time: str | None
    signals: Mapping[str, tuple[str, ...]]
    units: Mapping[str, str]
    calibrations: Mapping[str, tuple[Calibration, ...]]
    sources: Mapping[str, str]


@dataclass(frozen=True, eq=False)
class FolderContent:
    """Files of a folder, and the channels of the files that can be imported.

    Attributes
    ----------
    channels : dict of pathlib.Path to list of FileChannel
        Channels by file.
    unread : dict of pathlib.Path to DataError
        Errors of text files without a table.
    broken : dict of pathlib.Path to DataError
        Errors of files with the ending of a format.
    others : tuple of str
        Names of files of other kinds, and of those that macOS writes beside files (``._name``).
    """

    channels: Mapping[Path, Sequence[FileChannel]]
    unread: Mapping[Path, DataError]
    broken: Mapping[Path, DataError]
    others: tuple[str, ...]


def list_folder(options: DraftOptions) -> FolderContent:
    """Return the files of a folder with their channels.

    Raises
    ------
    UsageError
        When the folder holds no file that can be imported.
    DataError
        When no file can be read.
    """
    folder = options.folder
    if not folder.is_dir():
        raise UsageError(f"no folder {folder}; name the folder of the measured files")
    measured = measured_files(folder)
    known = any(format_of_ending(path.suffix.lower()) for path in measured)
    channels, errors = {}, {}
    for path in measured:
        try:
            channels[path] = list_channels(path, options.text_of(path))
        except DataError as error:
            errors[path] = error
    if not channels and errors:
        raise DataError("\n".join(_in_options(str(error)) for error in errors.values()))
    if not channels:
        raise UsageError(f"{folder} holds no file that can be imported; expected {', '.join(file_formats())}")
    others = tuple(path.name for path in _files(folder) if path not in channels and path not in errors)
    return FolderContent(channels, {} if known else errors, errors if known else {}, others)


def measured_files(folder: Path) -> list[Path]:
    """Return the files of a folder with the ending of a format; without any, those that may be text."""
    measured = [path for path in _files(folder) if not path.name.startswith("._")]
    known = [path for path in measured if format_of_ending(path.suffix.lower())]
    return known or [*filter(format_of, measured)]


def _files(folder: Path) -> list[Path]:
    return sorted((p for p in folder.iterdir() if p.is_file()), key=lambda p: by_count(p.name))


def _in_options(text: str) -> str:
    """Return a message in which options of `gbid init` replace keys of the YAML."""
    keys = r"\b(decimal|encoding|delimiter|header_line|time_unit): "
    text = re.sub(keys, lambda key: f"--{key[1].replace('_', '-')} ", text)
    return re.sub("(?<!-)header_line", "--header-line", text).replace("sample_time_s", "--sample-time")


def _broken_in_words(errors: Mapping[Path, GbidError]) -> list[str]:
    """Return a line for each unusable file, and a line on the option that skips these files."""
    lines = [_in_options(str(error)) for error in errors.values()]
    count = sum(isinstance(error, DataError) for error in errors.values())
    return [*lines, f"{count} of these files can be left out: --skip-broken"] if count else lines


@dataclass(frozen=True, eq=False)
class Survey:
    """Roles and units of columns according to headings and file names of a folder.

    Attributes
    ----------
    files : tuple of MeasuredFile
        The measured files.
    columns : tuple of str
        Lines of the table of columns.
    notes : tuple of str
        Signals that no column is taken as, though there are columns that are not used; files that cannot be read.
    """

    files: tuple[MeasuredFile, ...]
    columns: tuple[str, ...]
    notes: tuple[str, ...]


def survey(options: DraftOptions, content: FolderContent) -> Survey:
    """Return the measured files of a folder with the roles of their columns.

    Raises
    ------
    UsageError
        When a given channel is in no file.
    UnansweredError
        With all that must be given: columns of u and p, time, unit, and operating point.
    """
    channels = content.channels
    _refuse_unknown(options, channels)
    roles = {path: find_roles(each, *_given(options, each)) for path, each in channels.items()}
    units: dict[str, str] = {}  # of each signal in the first file that states one
    for path, each in channels.items():
        stated = {channel.name: channel.unit for channel in each if channel.unit and is_unit(channel.unit)}
        units = {s: stated[columns[0]] for s, columns in roles[path].signals.items() if columns[0] in stated} | units
    reasons: dict[str, str] = {}
    files = []
    for path, each in channels.items():
        role, listed = roles[path], ", ".join(channel.name for channel in each)
        for signal in ROLES:
            needed = signal in ("u", "p") or (signal in role.open_roles and signal not in options.signals)
            if signal not in role.signals and needed:
                reasons.setdefault(signal, f"{path}: its channels do not show which are {signal}: {listed}")
        if role.time is None and options.sample_time is None:
            reasons.setdefault("time", f"{path}: no column rises evenly as a time does")
        given, calibrated = _stated_units(options, path, each, role, units, reasons)
        files.append(MeasuredFile(path, role.time, role.signals, given, calibrated, {}))
    names = _names(options, files)
    for i, file in enumerate(files):
        missing = [key for key, value in _conditions(options, names, file.path).items() if value is None]
        sources = _sources(channels[file.path], roles[file.path])
        files[i] = replace(file, sources={key: sources[key] for key in missing if key in sources})
        for key in (key for key in missing if key not in sources):
            reasons.setdefault(key, f"{file.path.name}: neither the name nor a column tells {key}")
    columns = column_lines(roles)
    optional = {key: why for key, why in reasons.items() if key in OPTIONAL}
    if len(reasons) > len(optional) or (optional and options.ask):
        raise UnansweredError(reasons, columns, [] if options.skip_broken else _broken_in_words(content.broken))
    notes = tuple(f"{why}; {OPTIONAL[key]}: {_flag(key)}" for key, why in optional.items())
    notes += tuple(f"left out: {error}" for error in content.unread.values())
    return Survey(tuple(files), columns, notes)


def _sources(channels: Sequence[FileChannel], roles: Roles) -> dict[str, str]:
    """Return the columns of pressure and speed: the only column with a suitable unit, for the speed else phi."""
    unused = [channel for channel in channels if not channel.remark and not roles.columns[channel.name][0]]
    speeds = [channel.name for channel in unused if is_speed_unit(channel.unit or "")]
    pressures = [channel.name for channel in unused if factor_or_zero(channel.unit or "", "bar")]
    columns = {"pressure_bar": pressures, "speed_rpm": speeds or list(roles.signals.get("phi", ()))}
    return {key: names[0] for key, names in columns.items() if len(names) == 1}


def _stated_units(
    options: DraftOptions,
    path: Path,
    channels: Sequence[FileChannel],
    role: Roles,
    units: Mapping[str, str],
    reasons: dict[str, str],
) -> tuple[dict[str, str], dict[str, tuple[Calibration, ...]]]:
    """Return units and calibrations in a file mapping; append the missing ones to the open questions.

    Parameters
    ----------
    options : DraftOptions
        What is given.
    path : pathlib.Path
        The file.
    channels : sequence of FileChannel
        Its channels.
    role : Roles
        Roles of the channels.
    units : dict of str to str
        Units by signal in the other files.
    reasons : dict of str to str
        Why each option is open.
    """
    stated = {channel.name: channel.unit for channel in channels if channel.unit}
    names = [channel.name for channel in channels]
    sheets = {c[0]: known for name, known in options.calibrations.items() if (c := _columns_in((name,), names))}
    given: dict[str, str] = {}
    calibrated: dict[str, tuple[Calibration, ...]] = {}
    for signal in dict.fromkeys((*role.signals, "u", "p")):
        chosen, is_angle = role.signals.get(signal), signal == "phi"
        unit = options.units.get(signal, units.get(signal, "") if is_angle else options.unit or units.get(signal))
        if chosen and (sheet := next((sheets[column][1] for column in chosen if column in sheets), None)):
            given[signal] = sheet
            factors = [conversion_factor(stated.get(c, unit or ""), sheet) if c not in sheets else 1.0 for c in chosen]
            lines = [Calibration(((0.0, 0.0), (1.0, factor))) for factor in factors]
            calibrated[signal] = tuple(sheets[c][0] if c in sheets else q for c, q in zip(chosen, lines, strict=True))
            continue
        named = chosen or [name for name, (taken, _) in role.columns.items() if not taken]
        known = [column for column in named if is_unit(stated.get(column) or "?")]
        for column in known if chosen and signal not in options.units else ():
            try:
                conversion_factor(stated[column] or "", "rad" if is_angle else "m")
            except UsageError as error:
                text = f"{path}: column {column!r} of {signal}: {error}"
                is_open = is_ambiguous(stated[column] or "")
                reasons.setdefault(*(("unit", f"{text} (--unit {signal}=...)") if is_open else ("calibration", text)))
        if known and signal not in options.units:
            continue
        if unit is None:
            problems = [
                f"{column!r} states {stated[column]!r}, which is no unit" for column in named if column in stated
            ]
            reasons.setdefault("unit", f"{path}: {problems[0] if problems else f'the file states no unit of {signal}'}")
        elif chosen:
            if unit:
                conversion_factor(unit, "rad" if is_angle else "m")
            given[signal] = unit
    return given, calibrated


def _refuse_unknown(options: DraftOptions, channels: Mapping[Path, Sequence[FileChannel]]) -> None:
    """Refuse given columns that no file has."""
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
    """Return the given columns of each signal and of the time that a file contains."""
    names = [channel.name for channel in channels]
    given: dict[str, tuple[str, ...]] = {}
    for signal, entries in options.signals.items():
        columns_in_file = next((columns for entry in entries if (columns := _columns_in(entry, names))), None)
        if columns_in_file or not entries:
            given[signal] = columns_in_file or ()
    time = _columns_in((options.time,), names) if options.time else None
    return given, time[0] if time else None


def _columns_in(columns: Sequence[str], names: Sequence[str]) -> tuple[str, ...] | None:
    """Return the names of columns in a file, spelled as given or as another program writes them.

    Other programs put the name of a structure before a column, and replace signs that a variable name cannot have.
    """
    alike = {name: f".{_as_variable(name)}" for name in names}
    matches = [
        name if name in names else [n for n in names if alike[n].endswith(f".{_as_variable(name)}")] for name in columns
    ]
    single = tuple(
        each if isinstance(each, str) else each[0] for each in matches if isinstance(each, str) or len(each) == 1
    )
    return single if len(single) == len(columns) else None


def _as_variable(name: str) -> str:
    return re.sub(r"[^\w.]", "_", name)


# ---- Information in the recordings of a folder: operating points, kinds, unusable files, harmonics of run-out.

STILL = 0.5e-6
"""Largest movement of r and u at rest [m], as for `gbid.identify_runout`."""


@dataclass(frozen=True, eq=False)
class DraftedFile(MeasuredFile):
    """Measured file with the information from its name and its signals.

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
    """Measured files with the information that they have in common: name pattern, kinds, time range, notes.

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
    skipped : tuple of str
        Names of the files that are left out.
    """

    files: tuple[DraftedFile, ...]
    names: NamesRead | None
    kinds: Mapping[str, Kind]
    part: Mapping[str, float]
    harmonics: int | None
    runout: tuple[str, ...]
    notes: tuple[str, ...]
    skipped: tuple[str, ...]


def read_data(
    options: DraftOptions, files: Sequence[MeasuredFile], broken: Mapping[Path, DataError] | None = None
) -> DraftData:
    """Return operating points, kinds and conditions of measured files.

    Parameters
    ----------
    options : DraftOptions
        What is given.
    files : sequence of MeasuredFile
        The files.
    broken : dict of pathlib.Path to DataError, optional
        Errors of further files.

    Raises
    ------
    DataError
        With a line for each file that cannot be imported or has a dead channel, unless these are skipped.
    UsageError
        Likewise, when a unit that is given does not fit.
    """
    names = _names(options, files)
    files, angles = _angle_units(options, files)
    errors: dict[Path, GbidError] = dict(broken or {})
    made: dict[Path, Recording] = {}
    for file in files:
        try:
            made[file.path] = _import(options, file, _point(options, names, file))
            _refuse_dead(file, made[file.path])
        except GbidError as error:
            errors[file.path] = error
    usage = any(isinstance(error, UsageError) for error in errors.values())
    left = [file for file in files if file.path not in errors]
    if errors and (usage or not options.skip_broken or not left):
        raise (UsageError if usage else DataError)("\n".join(_broken_in_words(errors)))
    files, recordings = left, [made[file.path] for file in left]
    part, notes = _part(options, recordings)
    notes += [*angles, *_notes_on_points(files, recordings), *(f"left out: {error}" for error in errors.values())]
    drafted = []
    for file, rec in zip(files, recordings, strict=True):
        first = round(part.get("from_s", 0.0) / rec.sample_time)
        last = round(part["to_s"] / rec.sample_time) if "to_s" in part else rec.n_samples
        used = rec.slice(min(first, rec.n_samples - 1), min(last, rec.n_samples))
        tokens = [token.lower() for token in tokens_of(file.path.stem)]
        given = [kind for word, kind in options.kinds.items() if word.lower() in tokens]
        kind = given[0] if given else "excited" if _moves(used) else "stationary"
        drafted.append(DraftedFile(**vars(file), recording=used, kind=kind))
    points = {tuple(rec.conditions[key] for key in file.sources) for file, rec in zip(files, recordings, strict=True)}
    listed_alone = names is None or names.factors or len(points) > 1
    kinds = None if names is None or listed_alone else _kinds(names, drafted)
    harmonics, words = find_harmonics(drafted)
    notes += [*_remarks(recordings), *words]
    known = None if kinds is None else names
    skipped = tuple(path.name for path in errors)
    return DraftData(tuple(drafted), known, kinds or {}, part, harmonics, words, tuple(notes), skipped)


def _refuse_dead(file: MeasuredFile, rec: Recording) -> None:
    """Refuse a disc position that is constant, or at its limit for a fifth of the time."""
    for column, values in zip(file.signals["p"], rec.signal("p").T, strict=True):
        levels, counts = np.unique(values, return_counts=True)
        share = max(counts[0], counts[-1]) / len(values)
        if len(levels) == 1 or (len(levels) > FEW_LEVELS and share > _DEAD):
            level = levels[int(np.argmax(counts))]
            raise DataError(f"{file.path}: column {column!r} is dead: {share:.0%} of its samples are {level:g} m")


_DEAD = 0.2  # share of the samples at the largest or smallest value


def _import(options: DraftOptions, file: MeasuredFile, conditions: Mapping[str, float]) -> Recording:
    times: dict[str, Any] = {"sample_time_s": options.sample_time} if options.sample_time else {"time": file.time}
    times |= {"time_unit": options.time_unit} if options.time_unit and not options.sample_time else {}
    text = options.text_of(file.path)
    layout = {key: getattr(text, key) for key in text.given()} if text else {}
    signals = {}
    for name, columns in file.signals.items():
        more = {"unit": file.units[name]} if name in file.units else {}
        signals[name] = {"columns": list(columns), **more, "calibration": file.calibrations.get(name)}
    mapping = {**times, **layout, "signals": signals, "conditions": conditions}
    return repair_overloads(import_recording(file.path, mapping))


def _point(options: DraftOptions, names: NamesRead | None, file: MeasuredFile) -> dict[str, float]:
    """Return the operating point of a file: as given, from its name, or measured.

    Measured values are rounded to two digits of the pressure and three of the speed, so that repeated recordings agree.
    """
    known = {key: value for key, value in _conditions(options, names, file.path).items() if value is not None}
    if not file.sources:
        return known
    columns = {key: (column,) for key, column in file.sources.items()}
    by_angle = columns.get("speed_rpm") == file.signals.get("phi")
    signals = {"phi" if by_angle and key == "speed_rpm" else key: column for key, column in columns.items()}
    alone = replace(file, signals=signals, units=file.units if by_angle else {}, calibrations={})
    rec = _import(options, alone, {})
    first, last = (round((t or 0.0) / rec.sample_time) for t in (options.from_s, options.to_s))
    rec = rec.slice(min(first, rec.n_samples - 1), min(last, rec.n_samples) if last else rec.n_samples)
    point = {key: _plateau(rec.signal(key)[:, 0]) for key in columns if key in rec.signals}
    if by_angle:
        increments = turning_increments(rec)
        speeds = np.zeros(1) if increments is None else np.abs(increments)
        size = max(1, min(len(speeds), round(BLOCK / rec.sample_time)))
        blocks = speeds[: len(speeds) // size * size].reshape(-1, size).mean(axis=1)
        point["speed_rpm"] = 30 / np.pi / rec.sample_time * _plateau(blocks)
    return known | {key: float(f"{value:.{2 if key == 'pressure_bar' else 3}g}") for key, value in point.items()}


def _plateau(values: FloatArray) -> float:
    """Return the mean of the largest group of values within 2 %; a run-up has no such plateau."""
    ordered = np.sort(values)
    ends = np.searchsorted(ordered, ordered + _SAME_SPEED * np.abs(ordered), side="right")
    start = int(np.argmax(ends - np.arange(len(ordered))))
    return float(np.mean(ordered[start : ends[start]]))


_SAME_SPEED = 0.02


def _notes_on_points(files: Sequence[MeasuredFile], recordings: Sequence[Recording]) -> list[str]:
    """Return a note for each part of the operating point, and for each column that measures it."""
    values: dict[tuple[str, str], list[float]] = {}
    for file, rec in zip(files, recordings, strict=True):
        for key, column in file.sources.items():
            values.setdefault((key, column), []).append(rec.conditions[key])
    return [
        f"{key} of {len(each)} file{'s' * (len(each) > 1)} is measured, by column {column}: "
        f"{', '.join(f'{value:g}' for value in sorted(set(each)))}"
        for (key, column), each in values.items()
    ]


def _angle_units(options: DraftOptions, files: Sequence[MeasuredFile]) -> tuple[list[MeasuredFile], list[str]]:
    """Return the files with a unit of the shaft angle, guessed from its values if not stated, and a note on it.

    Degrees when an angle that falls back once a turn reaches beyond one turn in radians.
    """
    unstated = [file for file in files if file.units.get("phi") == ""]
    if not unstated:
        return list(files), []
    largest = 0.0
    for file in unstated:
        alone = replace(file, signals={"phi": file.signals["phi"]}, units={"phi": "rad"}, calibrations={})
        try:
            phi = _import(options, alone, {}).signal("phi")[:, 0]
        except GbidError:
            continue  # it is told of the whole file
        if np.ptp(phi) < 2 * np.ptp(np.diff(phi)):  # it falls back by nearly its whole range
            largest = max(largest, float(np.abs(phi).max()))
    unit = "deg" if 1.1 * 2 * np.pi < largest < 1.1 * 360 else "rad"
    known = [replace(file, units={**file.units, "phi": unit}) if file in unstated else file for file in files]
    return known, [
        f"{len(unstated)} files state no unit of phi: its numbers reach {largest:g}, so it is read in {unit}"
    ]


def _names(options: DraftOptions, files: Sequence[MeasuredFile]) -> NamesRead | None:
    """Return the name pattern that most files of one kind match, or the given pattern."""
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
    """Return the operating point of a file: as given, by the pattern without file ending, or by its name alone.

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
    """Return the time range used in all files, as given or with constant shaft speed, and notes on it."""
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
    note = f"the speed changes in {len(changes)} of {len(recordings)} files; of all files this part is used: {words}"
    return part, [note] if part else []


def _remarks(recordings: Sequence[Recording]) -> list[str]:
    """Return the remarks of the import; remarks that differ only in numbers are merged."""
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
    """Return the recording kind of each word in the file names; empty if gbid knows all words.

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
    """Return the number of harmonics of the run-out maps, and a text on the remainder at each operating point.

    The number is the largest one chosen at an operating point by stationary recordings on held-out data; None when no
    map can be compared.
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
    """Drafted experiment with notes.

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
    options: DraftOptions,
    target: Path,
    complete: Callable[[MachineData], MachineData] | None = None,
    content: FolderContent | None = None,
) -> Draft:
    """Return a drafted experiment for a gas bearing from the recordings of a folder.

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
    content : FolderContent, optional
        The files of the folder, where they are listed already.

    Raises
    ------
    UnansweredError
        When something is neither found nor given.
    UsageError
        When what is given does not fit the files.
    DataError
        When a file cannot be read.
    """
    content = content or list_folder(options)
    surveyed = survey(options, content)
    data = read_data(options, surveyed.files, content.broken)
    text = draft_text(target, options, data)
    if complete is not None:
        options = replace(options, machine=complete(options.machine))
        text = draft_text(target, options, data)
    left_out = (f"left out, of a kind that is not imported: {', '.join(content.others)}",) if content.others else ()
    return Draft(text, (*data.notes, *surveyed.notes, *left_out, *_unknown(options)), surveyed.columns)


_NEEDED = {
    "moving_mass_kg": ("--moving-mass KG", "the response to an impact (rows disc, stack and decay)"),
    "piezo_travel_m": ("--travel UM", "limits of the stacks in the control chain in C"),
    "clearance_m": ("--clearance UM", "the limit of the disc in the control chain in C"),
}
"""Numbers of a machine by their key: the option that gives each, and what is left out without it."""


def _unknown(options: DraftOptions) -> list[str]:
    """Return a line on missing numbers of the machine; empty if all are given."""
    missing = [words for key, words in _NEEDED.items() if getattr(options.machine, key) is None]
    if not missing:
        return []
    what, flags = "; ".join(what for _, what in missing), ", ".join(flag for flag, _ in missing)
    return [f"not known, so left out: {what}. Give {flags}, or the section machine of the YAML"]


def draft_text(target: Path, options: DraftOptions, data: DraftData) -> str:
    """Return the YAML text of an experiment from the given answers and the files.

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
    patterned = [file for file in patterned if _mapping_key(file) == _mapping_key(patterned[0])]
    mapped = {file.point for file in data.files if file.kind == "stationary"}
    environment = Environment(
        loader=PackageLoader("gbid.experiment", "."), undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters |= {"quoted": lambda text: json.dumps(str(text), ensure_ascii=False), "seconds": _seconds}
    return environment.get_template("draft.yaml.j2").render(
        name=name_of(target.name),
        data_folder=os.path.relpath(options.folder.resolve(), target.resolve()),
        options=options,
        text=lambda file: (text := options.text_of(file.path)) and {key: getattr(text, key) for key in text.given()},
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
        repeated=counts.max() > 1,
        order=order_words(possible_order(points)),
        sample_time=excited[0].recording.sample_time,
    )


def _mapping_key(file: MeasuredFile) -> tuple[object, ...]:
    return file.time, dict(file.signals), dict(file.units), dict(file.calibrations)


def _seconds(value: float) -> str:
    """Return a time as text with a decimal point, as YAML needs it for a number."""
    text = f"{value:.6g}"
    return text if "." in text else text.replace("e", ".0e") if "e" in text else f"{text}.0"
