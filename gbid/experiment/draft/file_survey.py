"""Survey of a folder of measured files: their channels, how they are read, and what their names say."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from gbid.errors import UsageError
from gbid.experiment.draft.channel_roles import ChannelRoles, find_roles
from gbid.experiment.draft.draft_options import DraftOptions, UnansweredError
from gbid.experiment.stages.importing.folders import by_count
from gbid.recording.importers.file_format import FileChannel
from gbid.recording.importers.formats import file_formats
from gbid.recording.importers.peek import list_channels
from gbid.units import conversion_factor

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
