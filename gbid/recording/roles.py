"""Roles of a file's columns, from their names: references, piezos, positions, shaft angle and time."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from gbid.recording.columns import TIME_WORDS, words_of
from gbid.recording.readers import FileChannel

ROLES = ("r", "u", "p", "phi")
"""Signals of a gas bearing: references and positions of the piezos, position of the disc, shaft angle."""
_WORDS = {
    "r": {"r", "ref", "cmd", "command", "demand", "set", "target", "rif", "mando"},
    "u": {"u", "stack", "stellweg", "stellgröße", "stellgroesse", "act"},
    "phi": {"phi", "angle", "theta", "resolver", "enc"},
    "p": {
        *("p", "pos", "weg", "wege", "disp", "displacement", "disc", "disk", "gap", "probe", "prox", "shaft", "rotor"),
        *("rotore", "albero", "disco", "sonda", "arbre", "disque", "sonde", "eje"),
    },
}
_STEMS = {  # first letters of words, for compounds such as Sollwert and Winkelgeber, and for other languages
    "r": ("soll", "refer", "référ", "rifer", "setpoint", "führung", "fuehrung", "consign", "comand"),
    "u": ("piezo", "piézo", "aktor", "aktuator", "actuat", "actuad", "actionn", "attuat"),
    "phi": ("winkel", "drehwinkel", "drehgeber", "encoder", "angol", "angul", "ángul", "codeur", "codificador"),
    "p": (
        *("spalt", "position", "lage", "wegsensor", "wegaufnehmer", "scheibe", "auslenkung", "welle", "proximity"),
        *("spost", "posiz", "distanz", "traferro", "déplac", "deplac", "entrefer", "desplaz", "posici", "entrehierro"),
    ),
}
_OTHER = re.compile(
    "drehzahl|speed|rpm|umin|velo|vitesse|giri|tours?$|druck|press|presi|temp|kraft|force|forza|fuerza|effort|strom"
    "|current|corrente|courant|corriente|spannung|voltage|tension|tensi[oó]n|trigger|moment|coppia|drehmoment|torque"
)
_AXES = {
    **dict.fromkeys(("x", "a", "h", "hor", "horizontal", "waagerecht", "left", "links"), 0),
    **dict.fromkeys(("horizontale", "orizzontale", "sinistra", "sinistro", "gauche", "izquierda", "izquierdo"), 0),
    **dict.fromkeys(("y", "b", "v", "ver", "vert", "vertical", "vertikal", "senkrecht", "right", "rechts"), 1),
    **dict.fromkeys(("verticale", "destra", "destro", "droite", "droit", "derecha", "derecho"), 1),
}
_SHORT = re.compile(r"(r|u|p)([xyabhv12])")
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
    def open_roles(self) -> tuple[str, ...]:
        """Missing roles that an unused column may have, judged by its name."""
        unused = [reason for taken, reason in self.columns.values() if not taken]
        missing = [role for role in ROLES if role not in self.signals]
        return tuple(q for q in missing if any(why.startswith((_UNKNOWN, f"{q} by ")) for why in unused))


def find_roles(channels: Sequence[FileChannel], given: Mapping[str, tuple[str, ...]], time: str | None) -> Roles:
    """Return the roles of a file's channels: given roles, then roles found by name.

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
        named = [name for name in rising if TIME_WORDS & set(words_of(name))]
        time = named[0] if named else rising[0] if len(rising) == 1 else None
    axes: dict[str, dict[int, str]] = {role: {} for role in ROLES}
    for name in usable:
        role, axis, why = _role(name)
        first = axes[role].setdefault(axis, name) if role and name != time else name
        why = f"{role} by {why}" if role else why
        reasons[name] = ("", why if first == name else f"{why}, as {first!r} before it")
    pairs = {role: tuple(name for _, name in sorted(names.items())) for role, names in axes.items()}
    complete = {role: names for role, names in pairs.items() if len(names) == (1 if role == "phi" else 2)}
    complete = {role: names for role, names in (complete | dict(given)).items() if names}
    for role, names in complete.items():
        for letter, name in zip(("x", "y"), names, strict=False):
            why = "given" if given.get(role) else reasons[name][1].removeprefix(f"{role} by ")
            reasons[name] = (role if role == "phi" else f"{role} {letter}", why)
    if time is not None:
        reasons[time] = ("time", "given" if was_given else "rises evenly")
    return Roles(time, {role: complete[role] for role in ROLES if role in complete}, reasons)


def _role(name: str) -> tuple[str | None, int, str]:
    """Return a channel's role and axis number from its name, with the reason."""
    tokens = words_of(name)
    if short := _SHORT.fullmatch("".join(tokens)):
        tokens = [short[1], short[2]]
    if tokens in (["x"], ["y"]):
        return "p", _AXES[tokens[0]], f"axis {tokens[0]} alone"
    for word in tokens:
        if _OTHER.match(word):
            return None, 0, f"{word!r} is none of r, u, p and phi"
    for role in _WORDS:
        if word := next((w for w in tokens if w in _WORDS[role] or w.startswith(_STEMS[role])), ""):
            if role == "phi":
                return role, 0, f"{word!r}"
            axis = tokens[-1] if tokens[-1].isdecimal() else next((w for w in reversed(tokens) if w in _AXES), "")
            number = int(axis) if axis.isdecimal() else _AXES.get(axis, 0)
            return role, number, f"{word!r}, axis {axis}" if axis else f"{word!r}, no axis"
    return None, 0, _UNKNOWN


def column_lines(roles: Mapping[Path, Roles]) -> tuple[str, ...]:
    """Return table lines with all columns and their roles, once for files with equal columns."""
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
