"""Problems of an experiment file, all reported at once."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from types import UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from pydantic import BaseModel

from gbid.errors import UsageError

Location = tuple[str | int, ...]
"""Keys and list positions that lead to a value of the YAML."""
Found = Iterator[tuple[Location, str]]
"""Result of a check: location in the YAML and text of each problem."""
_LISTED, _FIRST = 30, 8  # longest list of names that is shown in full; number of names shown of a longer one


@dataclass(frozen=True)
class Problem:
    """Problem of an experiment file.

    Attributes
    ----------
    position : str
        ``file:line:col``.
    key : str
        Path of keys, e.g. ``fits.bearing.window``; empty when the problem concerns the whole file.
    text : str
        What is wrong and what to do.
    """

    position: str
    key: str
    text: str

    def __str__(self) -> str:
        return f"{self.position}: {self.key}: {self.text}" if self.key else f"{self.position}: {self.text}"


class ExperimentError(UsageError):
    """Error for an experiment file; `problems` contains all its problems."""

    def __init__(self, problems: Iterable[Problem]) -> None:
        self.problems = tuple(problems)
        super().__init__("\n".join(str(problem) for problem in self.problems))


def in_file_order(problems: Iterable[Problem]) -> list[Problem]:
    """Return the problems sorted by line and column."""

    def place(problem: Problem) -> tuple[int, int]:
        line, column = problem.position.split(":")[-2:]
        return int(line), int(column)

    return sorted(problems, key=place)


def dotted(location: Location) -> str:
    """Return a location as text, e.g. ``fits.bearing.bounds.tau_x[1]``."""
    text = ""
    for key in location:
        text += f"[{key}]" if isinstance(key, int) else f".{key}"
    return text.lstrip(".")


def nearest(name: str, known: Iterable[str]) -> str:
    """Return a hint with the most similar known name and the known names; of many, only the first ones."""
    known = list(known)
    close = difflib.get_close_matches(name, known, n=1)
    meant = f"did you mean {close[0]!r}? " if close else ""
    listed, more = (known, 0) if len(known) <= _LISTED else (known[:_FIRST], len(known) - _FIRST)
    return f"{meant}there is {', '.join(listed) or 'nothing'}{f' and {more} more' if more else ''}"


def schema_text(model: type[BaseModel], error: Any) -> tuple[Location, str]:
    """Return location and text of a pydantic error, in plain words for the author of the YAML."""
    given: Location = tuple(error["loc"])
    location, _ = _walk(model, given)
    kind, found, context = error["type"], error["input"], error.get("ctx", {})
    if location and location[-1] == "[key]":
        location = location[:-1]
    if kind == "extra_forbidden":
        return location, f"unknown key; {nearest(str(location[-1]), _keys_at(model, given[:-1]))}"
    if kind == "missing":
        return location, "is missing; add it"
    if kind == "value_error":
        return location, str(context.get("error", error["msg"]))
    if kind == "literal_error":
        return location, f"expected {context['expected']}, found {_short(found)}"
    if kind == "string_pattern_mismatch":
        return location, (
            f"{_short(found)} cannot be a name; use letters, digits, '_', '-', '+' or '.', "
            "and begin with a letter or digit"
        )
    words = _EXPECTED.get(kind)
    if words is not None:
        hint = "; write a number without unit; the key names the unit" if _starts_as_number(kind, found) else ""
        return location, f"expected {words}, found {_short(found)}{hint}"
    for relation, sign in (("gt", "above"), ("ge", "at least"), ("lt", "below"), ("le", "at most")):
        if relation in context:
            return location, f"must be {sign} {context[relation]:g}, found {_short(found)}"
    return location, f"{error['msg'][:1].lower()}{error['msg'][1:]}, found {_short(found)}"


_EXPECTED = {
    "float_type": "a number",
    "finite_number": "a finite number",
    "int_type": "a whole number",
    "int_from_float": "a whole number",
    "string_type": "text (put quotes around a word that looks like a number or date)",
    "string_too_short": "some text",
    "bool_type": "true or false",
    "tuple_type": "a list",
    "dict_type": "a block of keys",
    "model_type": "a block of keys",
    "too_short": "at least one entry",
}


def _starts_as_number(kind: str, found: object) -> bool:
    number = kind in ("float_type", "int_type")
    return number and isinstance(found, str) and found.strip()[:1] in tuple("+-.0123456789")


def _short(value: object) -> str:
    if value is None:
        return "nothing"
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def _keys_at(model: type[BaseModel], location: Location) -> list[str]:
    """Return the keys that the schema allows at a location of pydantic."""
    kind = _inner_type(_walk(model, location)[1])
    if isinstance(kind, type) and issubclass(kind, BaseModel):
        return [field.alias or name for name, field in kind.model_fields.items()]
    return []


def _walk(model: type[BaseModel], location: Location) -> tuple[Location, Any]:
    """Return the location in the YAML and the type there; pydantic adds the tag of a section that has several kinds."""
    kind: Any = model
    found: list[str | int] = []
    for key in location:
        tagged = _by_tag(kind)
        if key in tagged:
            kind = tagged[str(key)]
            continue
        found.append(key)
        kind = _inner_type(kind)
        if isinstance(kind, type) and issubclass(kind, BaseModel):
            fields = {field.alias or name: field.annotation for name, field in kind.model_fields.items()}
            kind = fields.get(str(key))
        elif get_origin(kind) in (dict, tuple):
            kind = get_args(kind)[1 if get_origin(kind) is dict else 0]
    return tuple(found), kind


def _by_tag(kind: Any) -> dict[str, Any]:
    """Return the sections of a union of several kinds of sections, by the word that tells them apart."""
    while get_origin(kind) is Annotated:
        kind = get_args(kind)[0]
    if get_origin(kind) not in (Union, UnionType):
        return {}
    sections = [arg for arg in get_args(kind) if isinstance(arg, type) and issubclass(arg, BaseModel)]
    return {
        str(tag): section
        for section in sections
        for field in section.model_fields.values()
        if get_origin(field.annotation) is Literal
        for tag in get_args(field.annotation)
        if len(get_args(field.annotation)) == 1
    }


def _inner_type(kind: Any) -> Any:
    """Return a type without ``Annotated[...]`` and ``... | None``."""
    while get_origin(kind) is not None and get_origin(kind) not in (dict, tuple):
        kind = next(arg for arg in get_args(kind) if arg is not type(None))
    return kind
