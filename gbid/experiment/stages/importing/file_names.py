"""Patterns of file names with conditions, such as ``p{pressure_bar:g}_n{speed_rpm:d}_{kind}.mat``."""

from __future__ import annotations

import re
import unicodedata
from dataclasses import dataclass

from gbid.errors import UsageError

_SPELT = str.maketrans({"ä": "ae", "ö": "oe", "ü": "ue", "Ä": "Ae", "Ö": "Oe", "Ü": "Ue", "ß": "ss"})
_FIELD = re.compile(r"\{(?P<name>[^{}:]*)(?::(?P<kind>[^{}]*))?\}")
_NUMBER = r"[-+]?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?"
_FORMS = {"g": _NUMBER, "d": r"[-+]?\d+", "": r"[^/]+?"}


def name_of(text: str) -> str:
    """Return a text of a file name as the name of a recording: blanks and other signs become ``_``."""
    plain = unicodedata.normalize("NFKD", unicodedata.normalize("NFC", text).translate(_SPELT))
    word = re.sub(r"[^A-Za-z0-9_.+-]+", "_", plain.encode("ascii", "ignore").decode()).strip("_")
    return word if word[:1].isalnum() else f"r{word}"


@dataclass(frozen=True)
class NamePattern:
    """Pattern of file names.

    Attributes
    ----------
    text : str
        The pattern as written.
    fields : tuple of str
        Names of the fields.
    numbers : tuple of str
        Names of the fields that are numbers; these are conditions.
    regex : re.Pattern
        The pattern as a regular expression.
    """

    text: str
    fields: tuple[str, ...]
    numbers: tuple[str, ...]
    regex: re.Pattern[str]

    def read(self, path: str) -> dict[str, str | float] | None:
        """Return the fields of a file name; None when it does not match.

        Parameters
        ----------
        path : str
            Relative path, with ``/``.

        Returns
        -------
        dict of str to str or float
            Values by field.
        """
        match = self.regex.fullmatch(path)
        if match is None:
            return None
        found = match.groupdict()
        return {name: float(found[name]) if name in self.numbers else found[name] for name in self.fields}


def name_pattern(text: str) -> NamePattern:
    """Return the pattern of a text.

    Raises
    ------
    UsageError
        When a field has no name, an unknown form, or occurs twice, or when a brace has no partner.
    """
    parts, fields, numbers, end = [], [], [], 0
    for match in _FIELD.finditer(text):
        name, form = match["name"], match["kind"] or ""
        parts.append(_literal(text, text[end : match.start()]))
        end = match.end()
        if not name.isidentifier():
            raise UsageError(f"{text!r}: {match[0]} names no field; write {{name}}, {{kind}} or {{pressure_bar:g}}")
        if form not in _FORMS:
            raise UsageError(f"{text!r}: {match[0]}: unknown form {form!r}; write :g for a number, :d for a whole one")
        if name in fields:
            raise UsageError(f"{text!r}: field {name!r} occurs twice; rename or remove one")
        if form and name in ("name", "kind"):
            raise UsageError(f"{text!r}: {name} is a word, not a number; write {{{name}}}")
        if not form and name in ("pressure_bar", "speed_rpm"):
            raise UsageError(f"{text!r}: {name} is a number; write {{{name}:g}}")
        fields.append(name)
        if form:
            numbers.append(name)
        parts.append(f"(?P<{name}>{_FORMS[form]})")
    parts.append(_literal(text, text[end:]))
    return NamePattern(text, tuple(fields), tuple(numbers), re.compile("".join(parts)))


def _literal(text: str, part: str) -> str:
    if "{" in part or "}" in part:
        raise UsageError(f"{text!r}: a brace has no partner; write fields as {{name}}")
    return re.escape(part)
