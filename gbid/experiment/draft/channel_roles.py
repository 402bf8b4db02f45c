"""Roles of the channels of a file by their names: time, reference, piezo position, disc position, shaft angle."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from gbid.errors import UsageError
from gbid.recording.importers.file_format import FileChannel
from gbid.recording.importers.mapping import nearest

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
