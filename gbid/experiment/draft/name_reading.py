"""Operating point and kind of recordings from the names of their files."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

from gbid.experiment.stages.importing.file_names import NamePattern, name_pattern

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
    for field, (left, right) in (("pressure_bar", _PRESSURE), ("speed_rpm", _SPEED)):
        if after in right and (direct == after or not direct.isalnum()):
            return field
        if before in left:
            return field
    return "nr"
