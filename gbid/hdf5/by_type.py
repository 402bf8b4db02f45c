"""Codecs of fields, chosen by their types."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass, replace
from enum import Enum
from functools import cache
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, NamedTuple, Union, get_args, get_origin, get_type_hints

import numpy as np

from gbid.hdf5.leaf import Leaf
from gbid.hdf5.nest import Attributes, Codec, Columns, DataclassGroup, Keyed, Numbered, OneOf
from gbid.hdf5.stored import NOT_STORED, Stored

_SCALARS: dict[Any, str] = {float: "f", int: "i", bool: "b", str: "U"}
_LINES = tuple[tuple[str, ...], ...]


def record(made: type) -> DataclassGroup:
    """Return the codec of a dataclass or named tuple, from the annotations of its fields.

    Raises
    ------
    TypeError
        When a field has a type that cannot be stored.
    """
    hashable: Any = made
    return _record(hashable)


@cache
def _record(made: Any) -> DataclassGroup:
    names = [field.name for field in fields(made)] if is_dataclass(made) else list(getattr(made, "_fields"))  # noqa: B009
    hints = get_type_hints(made, include_extras=True)
    codecs = []
    for name in names:
        plain, stored = _taken_apart(hints[name])
        if stored is not NOT_STORED:
            try:
                codecs.append((name, (stored and stored.at) or name, _codec(plain, stored)))
            except TypeError as error:
                raise TypeError(f"{made.__name__}.{name}: {error}") from None
    return DataclassGroup(made, tuple(codecs))


def _taken_apart(hint: Any) -> tuple[Any, Stored | None]:
    if get_origin(hint) is not Annotated:
        return hint, None
    plain, *marks = get_args(hint)
    return plain, next((mark for mark in marks if isinstance(mark, Stored)), None)


def _codec(hint: Any, stored: Stored | None) -> Codec:
    origin, args = get_origin(hint), get_args(hint)
    if origin in (Union, UnionType):
        return OneOf(tuple(_codec(arg, stored) for arg in args if arg is not NoneType), NoneType in args)
    if _is_record(hint):
        return record(hint)
    if leaf := _leaf(hint, stored):
        return leaf
    if origin is tuple and len(args) == 2 and args[1] is ...:
        return _columns(record(args[0])) if _is_record(args[0]) else Numbered(_codec(args[0], stored), named=False)
    if isinstance(origin, type) and issubclass(origin, Mapping):
        return _mapping(hint, args[1], stored)
    raise TypeError(f"{hint} cannot be stored")


def _is_record(hint: Any) -> bool:
    return isinstance(hint, type) and (is_dataclass(hint) or hasattr(hint, "_fields"))


def _columns(rows: DataclassGroup) -> Codec:
    """Return columns when each field is a number, a text or an array of declared shape; else one group per row."""
    columns = []
    for name, _, leaf in rows.fields:
        if not isinstance(leaf, Leaf) or leaf.shape is None or (leaf.shape and leaf.kind == "U"):
            return Numbered(rows, named=False)
        columns.append((name, replace(leaf, shape=("rows", *leaf.shape), is_dataset=leaf.kind != "U")))
    return Columns(rows.made, tuple(columns))


def _mapping(hint: Any, to: Any, stored: Stored | None) -> Codec:
    each = _leaf(to, None)
    if each and each.shape == () and stored:
        shape = tuple(stored.shape.split()) or ("*",)
        return Keyed(replace(each, shape=shape, is_dataset=each.kind != "U", stored=stored), stored.keys)
    if each and each.shape == () and each.kind != "U":
        return Attributes(each)
    if _is_plain(hint):
        return Leaf("U", lambda text: _checked(json.loads(text), hint), (), False, Stored(), _as_json)
    return Numbered(_codec(to, stored), named=True)


def _is_plain(hint: Any) -> bool:
    """Return whether a type is text, or a mapping to such types."""
    return hint is str or (bool(get_args(hint)) and get_origin(hint) is Mapping and _is_plain(get_args(hint)[1]))


def _as_json(value: Any) -> str:
    return json.dumps(value, default=dict)


def _checked(value: Any, hint: Any) -> Any:
    """Return a value read from JSON; refuse one that does not have the type."""
    if hint is str and isinstance(value, str):
        return value
    if hint is not str and isinstance(value, dict):
        return {key: _checked(item, get_args(hint)[1]) for key, item in value.items()}
    raise ValueError(f"expected {'a text' if hint is str else 'a mapping'}, found {value!r}")


class _ArrayCodec(NamedTuple):
    kind: str
    build: Callable[[Any], Any]
    shape: tuple[str, ...] | None
    encode: Callable[[Any], Any]


def _leaf(hint: Any, stored: Stored | None) -> Leaf | None:
    if hint == _LINES:
        found: _ArrayCodec | None = _ArrayCodec("U", _split, ("*",), lambda texts: list(map(_lines, texts)))
    else:
        found = _values(hint)
    if found is None:
        return None
    shape = tuple(stored.shape.split()) if stored and stored.shape else found.shape
    is_array = found.shape is None or hint == _LINES or (found.kind != "U" and bool(found.shape or stored))
    is_dataset = is_array and not (stored and "@" in stored.at)
    return Leaf(found.kind, found.build, shape, is_dataset, stored or Stored(), found.encode)


def _values(hint: Any) -> _ArrayCodec | None:
    """Return how values of a type are converted to arrays and back; None when they cannot be."""
    origin, args = get_origin(hint), get_args(hint)
    if hint in _SCALARS:
        return _ArrayCodec(_SCALARS[hint], hint, (), _same)
    if isinstance(hint, type) and issubclass(hint, Enum):
        return _ArrayCodec(_SCALARS[type(next(iter(hint)).value)], hint, (), lambda member: member.value)
    if origin is Literal:
        return _ArrayCodec(_SCALARS[type(args[0])], lambda value: _one_of(value, args), (), _same)
    if origin is np.ndarray:
        kind = np.dtype(get_args(args[1])[0]).kind
        return _ArrayCodec(kind, _text_array if kind == "U" else _same, None, _same)
    if origin is not tuple or not args:
        return None
    every = args[1:] == (...,)
    inner = [_values(arg) for arg in (args[:1] if every else args)]
    first = inner[0]
    if first is None or first.shape is None or any(v is None or v.shape != first.shape for v in inner):
        return None
    items = [v for v in inner if v is not None]
    if len({v.kind == "U" for v in items}) > 1:
        return None
    kind = next(kind for kind in "Ufib" if any(v.kind == kind for v in items))
    shape = ("*" if every else str(len(items)), *first.shape)
    if every:
        return _ArrayCodec(kind, lambda a: tuple(map(first.build, a)), shape, lambda t: list(map(first.encode, t)))
    return _ArrayCodec(
        kind,
        lambda array: tuple(v.build(item) for v, item in zip(items, array, strict=True)),
        shape,
        lambda value: [v.encode(item) for v, item in zip(items, value, strict=True)],
    )


def _same(value: Any) -> Any:
    return value


def _one_of(value: Any, allowed: tuple[Any, ...]) -> Any:
    if value not in allowed:
        raise ValueError(f"{value!r} is not one of {', '.join(map(repr, allowed))}")
    return value


def _text_array(texts: Any) -> Any:
    return np.array(list(texts), dtype=str)


def _lines(texts: tuple[str, ...]) -> str:
    """Write texts one a line; a line break within a text becomes two characters, as in many languages."""
    return "\n".join(text.replace("\\", "\\\\").replace("\n", "\\n") for text in texts)


def _split(texts: Any) -> tuple[tuple[str, ...], ...]:
    return tuple(tuple(map(_one_text, text.split("\n"))) if text else () for text in texts)


def _one_text(line: str) -> str:
    return re.sub(r"\\([\\n])", lambda found: "\n" if found[1] == "n" else "\\", line)
