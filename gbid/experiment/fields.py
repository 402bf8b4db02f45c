"""Base classes and types of the experiment YAML, its problems, and content keys of result files."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, fields, is_dataclass
from functools import cached_property
from pathlib import Path
from types import MappingProxyType, NoneType, UnionType
from typing import Annotated, Any, TypeVar, Union, get_args, get_origin

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    Strict,
    Tag,
    TypeAdapter,
    ValidationError,
    WithJsonSchema,
)
from pydantic_core import ErrorDetails
from pydantic_core.core_schema import no_info_plain_validator_function

from gbid._version import __version__
from gbid.core.errors import DataError, GbidError, UsageError, nearest
from gbid.core.files import add_text_checksum, atomic_path, checked_end, is_changed, sha256_of
from gbid.core.hdf5 import KEY, opened, with_origin
from gbid.core.index import known
from gbid.core.names import given_path
from gbid.core.option_types import Finite
from gbid.discretise import Hold

T = TypeVar("T")


def _as_list(value: Any) -> Any:
    return [value] if isinstance(value, str) else value


def _one_or_several(kind: dict[str, Any], fewest: int = 1) -> WithJsonSchema:
    """Return a JSON schema that allows a single value in place of a list."""
    return WithJsonSchema({"anyOf": [kind, {"type": "array", "items": kind, "minItems": fewest}]})


_TEXT = {"type": "string", "minLength": 1}
Switch = Annotated[bool, Strict()]
Text = Annotated[str, Field(min_length=1), AfterValidator(lambda text: given_path(text) and text)]
"""Text; it may name a file or a thing that is stored under this name."""
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.+-]*$")]
"""Name that is also used in file names."""
Names = Annotated[tuple[Text, ...], BeforeValidator(_as_list), Field(min_length=1), _one_or_several(_TEXT)]
"""One or several names; a single name needs no list."""
NamesOrNone = Annotated[tuple[Text, ...], BeforeValidator(_as_list), _one_or_several(_TEXT, fewest=0)]
"""As `Names`, or an empty list."""
Pair = tuple[Finite, Finite]
Holds = Annotated[
    tuple[Hold, ...], BeforeValidator(_as_list), Field(min_length=1), _one_or_several({"enum": list(get_args(Hold))})
]


class Section(BaseModel):
    """Section of the YAML: unknown keys are refused, and values are constant."""

    model_config = ConfigDict(extra="forbid", frozen=True, protected_namespaces=(), defer_build=True)


class OptionsSection(BaseModel, frozen=True):
    """Section whose keys are the fields of a dataclass of options, with their types and defaults."""

    model_config = Section.model_config


def needed(section: T | None, name: str) -> T:
    """Return a section of the YAML; refuse an experiment without the section.

    Raises
    ------
    UsageError
        When there is no such section.
    """
    if section is None:
        raise UsageError(f"no section {name!r}; add one")
    return section


def given(value: Any) -> Any:
    """Return a value; refuse a key with an empty value."""
    if value is None:
        raise ValueError("is empty; write {} for the defaults, or leave the key out")
    return value


@dataclass(frozen=True)
class Deferred:
    """Marker for a YAML type whose checks are imported at the first value, because the import is slow.

    Attributes
    ----------
    form : callable
        Function that returns the type.
    """

    form: Callable[[], Any]

    @cached_property
    def _adapter(self) -> TypeAdapter[Any]:
        return TypeAdapter(self.form())

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        """Return the pydantic schema: a function that checks a value against the type."""
        return no_info_plain_validator_function(lambda value: self._adapter.validate_python(value))

    def __get_pydantic_json_schema__(self, _: Any, handler: Callable[[Any], Any]) -> Any:
        """Return the JSON schema of the type."""
        return handler(self._adapter.core_schema)


# ---- Problems of an experiment file, all reported at once.

Location = tuple[str | int, ...]
"""Keys and list positions that lead to a value of the YAML."""
Found = Iterator[tuple[Location, str]]
"""Result of a check: location in the YAML and text of each problem."""


@dataclass(frozen=True)
class Problem:
    """Problem of an experiment file with its position.

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
    """Error with all `problems` of an experiment file."""

    def __init__(self, problems: Iterable[Problem]) -> None:
        self.problems = tuple(problems)
        super().__init__("\n".join(str(problem) for problem in self.problems))


def in_file_order(problems: Iterable[Problem]) -> list[Problem]:
    """Return the problems sorted by line and column."""
    return sorted(problems, key=lambda problem: [int(number) for number in problem.position.split(":")[-2:]])


def dotted(location: Location) -> str:
    """Return a location as text, such as ``fits.bearing.bounds.tau_x[1]``."""
    text = ""
    for key in location:
        text += f"[{key}]" if isinstance(key, int) else f".{key}"
    return text.lstrip(".")


@contextmanager
def about(key: str) -> Iterator[None]:
    """Return a context that adds a key to errors that name no key."""
    try:
        yield
    except GbidError as error:
        error.key = error.key or key
        raise


def refusal(where: Location, made: Callable[[], object], key: str = "") -> Found:
    """Yield the error of a function call as a problem at the key that it names, else at a given location."""
    try:
        made()
    except GbidError as error:
        named = error.key or key
        yield (*where, named) if named else where, str(error)


def schema_faults(model: type[BaseModel], data: Any, error: ValidationError) -> dict[Location, str]:
    """Return the text of each pydantic fault in the YAML, by location, in plain words.

    A value that has none of several forms is one fault. A list with faulty entries is reported by its entries; that
    pydantic then finds it too short is not reported.
    """
    texts: dict[Location, list[str]] = {}
    for fault in error.errors(include_url=False):
        if fault["type"] != "too_short" or len(fault["input"]) < fault["ctx"]["min_length"]:
            texts.setdefault(_location(data, fault), []).append(_fault_text(model, fault))
    return {location: _either(list(dict.fromkeys(forms))) for location, forms in texts.items()}


def _either(forms: list[str]) -> str:
    """Return one text for a value that matches none of several forms."""
    ending = forms[-1][forms[-1].rfind(", found ") :]
    first, *others = (text.removesuffix(ending) for text in forms)
    return " or ".join([first, *(text.removeprefix("expected ") for text in others)]) + ending


def _fault_text(model: type[BaseModel], fault: ErrorDetails) -> str:
    kind, value, context = fault["type"], fault["input"], fault.get("ctx", {})
    if kind == "extra_forbidden":
        return f"unknown key; {nearest(str(fault['loc'][-1]), _keys_at(model, fault['loc'][:-1]))}"
    if kind == "missing":
        return "is missing; add it"
    if kind == "value_error":
        return str(context["error"])
    text = "nothing" if value is None else repr(value)
    shown = text if len(text) <= 60 else f"{text[:57]}..."
    if kind == "literal_error":
        return f"expected {context['expected']}, found {shown}"
    if kind == "string_pattern_mismatch":
        allowed = "letters, digits, '_', '-', '+' or '.', and begin with a letter or digit"
        return f"{shown} cannot be a name; use {allowed}"
    if kind in _EXPECTED:
        starts_as_number = isinstance(value, str) and value.strip()[:1] in tuple("+-.0123456789")
        with_unit = starts_as_number and kind in ("float_type", "int_type")
        hint = "; write a number without unit; the key names the unit" if with_unit else ""
        return f"expected {_EXPECTED[kind]}, found {shown}{hint}"
    for relation, sign in (("gt", "above"), ("ge", "at least"), ("lt", "below"), ("le", "at most")):
        if relation in context:
            return f"must be {sign} {context[relation]:g}, found {shown}"
    return f"{fault['msg'][:1].lower()}{fault['msg'][1:]}, found {shown}"


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


def _location(data: Any, fault: ErrorDetails) -> Location:
    """Return the location of a fault in the YAML: the pydantic location without names of union branches.

    Such a word (of a branch of a union, of a key itself) may be a key of the YAML, too. The right location is that of
    the value that pydantic found faulty, which is the same object unless a validator made another one of it.
    """
    is_missing = fault["type"] == "missing"  # the value is then what lacks the key
    keys = fault["loc"][:-1] if is_missing else fault["loc"]
    location, _ = max(_ways(data, keys), key=lambda way: (way[1] is fault["input"], len(way[0])))
    return (*location, fault["loc"][-1]) if is_missing else location


def _ways(data: Any, keys: Location) -> Iterator[tuple[Location, Any]]:
    """Yield location and value of entries of nested data at the keys, in order; keys without an entry are skipped."""
    if not keys:
        yield (), data
        return
    key, rest = keys[0], keys[1:]
    if key in (range(len(data)) if isinstance(data, list) else data if isinstance(data, dict) else ()):
        for location, value in _ways(data[key], rest):
            yield (key, *location), value
    yield from _ways(data, rest)


def _keys_at(kind: Any, location: Location) -> list[str]:
    """Return the allowed keys at a pydantic location, in which tags name the form of a value."""
    for key in location:
        kind, forms = _inner_type(kind), get_args(_inner_type(kind))
        if get_origin(kind) in (dict, list, tuple):
            kind = forms[1 if get_origin(kind) is dict else 0]
        elif forms:
            kind = next((form for form in forms if Tag(str(key)) in getattr(form, "__metadata__", ())), None)
        else:
            kind = {field.alias or name: field.annotation for name, field in kind.model_fields.items()}.get(str(key))
    fields_there = getattr(_inner_type(kind), "model_fields", {})
    return [field.alias or name for name, field in fields_there.items()]


def _inner_type(kind: Any) -> Any:
    """Return a type with ``Annotated[...]`` and ``... | None`` removed."""
    if get_origin(kind) is Annotated:
        deferred = next((mark for mark in kind.__metadata__ if isinstance(mark, Deferred)), None)
        return _inner_type(deferred.form() if deferred else get_args(kind)[0])
    forms = [form for form in get_args(kind) if form is not NoneType]
    return _inner_type(forms[0]) if len(forms) == 1 and get_origin(kind) in (Union, UnionType) else kind


# ---- Content keys: a result is current while its settings and sources are unchanged.

_KEYED_TEXT = (".csv", ".txt", ".yaml")
_KEY = re.compile(rb"content_key: ([0-9a-f]{64})")  # in a text file a comment, in an HDF5 file before the checksum


_CONTENTS = 2
"""Raised when results hold more than before under the same settings, as the documents of fits and recordings."""


def content_key(stage: str, settings: Mapping[str, Any], sources: Iterable[str] = ()) -> str:
    """Return the content key of a result: sha256 over the settings of a stage and the keys of its sources.

    Parameters
    ----------
    stage : str
        Name of the stage.
    settings : dict
        Settings as plain values; of arrays, mappings and dataclasses all values count.
    sources : iterable of str
        Content keys of the files that the stage reads.

    Returns
    -------
    str
        64 hexadecimal digits.
    """
    document = {
        "stage": stage,
        "gbid": __version__,
        "contents": _CONTENTS,
        "settings": settings,
        "sources": list(sources),
    }
    text = json.dumps(document, sort_keys=True, separators=(",", ":"), default=_plain)
    return hashlib.sha256(text.encode()).hexdigest()


class InputError(DataError):
    """Error for a missing or outdated input of a task; the task itself is not at fault."""


_VERBS = {"prefilter": "fit", "ringdown": "impact", "recording": "cycle"}  # of stages without their own verb


@dataclass(frozen=True)
class Item:
    """Subject of one result of a stage; as text ``bearing/p5_n6000_prbs1``, ``map p5_n6000`` or ``bearing.csv``.

    Attributes
    ----------
    stage : str
        Name of the stage, for example ``"fit"``.
    section : str
        Name of its section in the YAML, of its recording, or of its operating point.
    model : str
        Model of a fit; empty for other items.
    form : str
        How its last name is written, such as ``"map {}"``.
    round : str
        Round of the cycle, such as ``"round1"``; empty outside of it.
    """

    stage: str
    section: str
    model: str = ""
    form: str = "{}"
    round: str = ""

    @property
    def names(self) -> tuple[str, ...]:
        """Names in the text of the item, as used for folders and file."""
        *above, last = filter(None, (self.round, self.section, self.model))
        return (*above, self.form.format(last))

    def __str__(self) -> str:
        return "/".join(self.names)


@dataclass(frozen=True)
class Result:
    """Result file of a stage with its content key.

    Attributes
    ----------
    item : Item
        What the result is about.
    path : pathlib.Path
        The result file.
    key : str
        Content key of the result: of the settings of the stage and the keys of its sources.
    """

    item: Item
    path: Path
    key: str

    @property
    def is_made(self) -> bool:
        """Whether the file exists and belongs to the present settings and data."""
        return stored_key(self.path) == self.key

    def require(self) -> Path:
        """Return the path of the file after a check that it belongs to the present settings and data.

        Raises
        ------
        InputError
            When the file is missing or was made from others. Its text names the command that makes the file.
        """
        if self.is_made:
            return self.path
        command = f"gbid {_VERBS.get(self.item.stage, self.item.stage)}"
        if not self.path.is_file():
            raise InputError(f"{self.path}: file is missing; `{command}` makes it")
        foreign = "truncated or not made by an experiment"
        reason = "made from other settings or data" if stored_key(self.path) else foreign
        raise InputError(f"{self.path}: {reason}; make it again with `{command} --overwrite`")


def file_digest(path: Path) -> str:
    """Return the sha256 of the bytes of a file.

    Raises
    ------
    OSError
        When the file cannot be read.
    """
    return known(path, "sha256", sha256_of)


def stored_key(path: Path) -> str:
    """Return the content key in a result file; empty if it has none, is damaged or cannot be read."""
    try:
        return known(path, "key", _key_in)
    except OSError:
        return ""


def _key_in(path: Path) -> str:
    """Return the content key in a file, after a check of the whole file."""
    try:
        if path.suffix == ".h5":
            key = _KEY.search(checked_end(path) or b"")
            if key is None:  # an older file, or one that no experiment made
                with opened(path) as file:
                    return str(file.attrs.get(KEY, ""))
        else:
            key = _KEY.search(content := path.read_bytes())
            key = None if key and is_changed(content) else key
        return key[1].decode() if key else ""
    except (OSError, DataError):
        return ""


def is_current(path: Path, key: str, overwrite: bool) -> bool:
    """Return whether a result exists and was computed from equal settings and data.

    Raises
    ------
    UsageError
        When the result was made from other settings or data and `overwrite` is not set.
    DataError
        When the file cannot be read.
    """
    stored = stored_key(path)
    if stored == key:
        return True
    if overwrite or not path.exists():
        return False
    if not stored:
        problem = "damaged, changed after it was made, or not made by an experiment"
        raise DataError(f"{path}: {problem}; remove it or use --overwrite")
    raise UsageError(
        f"{path} was made with other settings or data, or by another version of gbid; "
        "use --overwrite to replace it, or --results to write elsewhere"
    )


@contextmanager
def writing_keyed(path: Path, key: str, origin: Mapping[str, Any] = MappingProxyType({})) -> Iterator[Path]:
    """Return a context with a path to write; at its end the file gets its content key and replaces `path`.

    An HDF5 file also gets its origin, beside the versions of the programs that wrote it.
    """
    with atomic_path(path, overwrite=True) as part:
        if path.suffix == ".h5":
            with with_origin(part, key, origin):
                yield part
        else:
            yield part
            content = part.read_bytes() if path.suffix in _KEYED_TEXT else b""  # pictures and pages state it themselves
            if content and not _KEY.search(content):
                part.write_bytes(f"# content_key: {key}\n".encode() + content)
            add_text_checksum(part, path.suffix)


def _plain(value: Any) -> Any:
    """Return arrays as lists, and models and mappings as dicts of their values."""
    if isinstance(value, Mapping):
        return dict(value)
    if is_dataclass(value):
        return {field.name: getattr(value, field.name) for field in fields(value)}
    return value.tolist()
