"""Dataclasses in HDF5 files: a codec for each type of field, and values that save and load whole files."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, fields, is_dataclass, replace
from enum import Enum
from functools import cache, partial
from pathlib import Path
from types import NoneType, UnionType
from typing import (
    Annotated,
    Any,
    ClassVar,
    Literal,
    NamedTuple,
    Protocol,
    Self,
    TypeVar,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

import h5py
import numpy as np
import numpy.typing as npt

from gbid.core.errors import DataError
from gbid.core.hdf5.file import (
    DamagedError,
    FileKind,
    add_attribute,
    add_dataset,
    add_texts,
    read_attribute,
    read_dataset,
    read_group,
    read_texts,
    reading,
    where,
    writing,
)
from gbid.core.option_types import plain, type_parts


@dataclass(frozen=True)
class Stored:
    """Unit, long name, shape and place of a field: ``mean: Annotated[FloatArray, Stored("m", "mean position")]``.

    Numbers with a declaration are stored in a dataset, single numbers without one in an attribute.

    Attributes
    ----------
    unit : str
        Attribute ``units`` of the dataset; "1" for ratios, "" when the structure determines the unit.
    long_name : str
        Attribute ``long_name``: meaning in words; by default the name of the field.
    shape : str
        Lengths, e.g. ``"n 2"``; a word stands for the same length in all fields of the dataclass.
    at : str
        Place below the group of the dataclass, e.g. ``"parameters/estimate"``, or ``"parameters@units"`` for an
        attribute; by default the name of the field.
    keys : str
        For a mapping, the attribute with its keys; mappings with the same attribute share their keys. By default the
        attribute ``names`` of the dataset.
    late : bool
        Whether older files lack the field, which then has its default.
    """

    unit: str = ""
    long_name: str = ""
    shape: str = ""
    at: str = ""
    keys: str = ""
    late: bool = False


NOT_STORED = Stored(at="nowhere")
"""Mark of a field that is not stored; the reader passes it, or it has a default."""
AS_JSON = Stored(long_name="JSON")
"""Mark of a dataclass of plain values, such as options, that is stored as one text of JSON."""
INLINE = Stored(long_name="inline")
"""Mark of a dataclass whose fields are stored beside those of the value that contains it."""


_DTYPES = {"f": np.float64, "i": np.int64, "b": np.bool_}
_TAKEN = {"f": "fiu", "i": "iu", "b": "b"}  # accepted kinds of arrays: whole numbers are numbers, too
_WORDS = {"f": "numbers", "i": "whole numbers", "b": "true or false", "U": "texts"}


@dataclass
class Context:
    """Units, lengths and keys shared by the fields of one value while it is written or read.

    Attributes
    ----------
    units : dict of str to str
        Units that depend on the value, by the word that its fields declare.
    lengths : dict of str to int
        Lengths found so far, by the word that stands for them.
    keys : dict of str to tuple of str
        Keys of mappings found so far, by the attribute that contains them.
    """

    units: Mapping[str, str] = field(default_factory=dict)
    lengths: dict[str, int] = field(default_factory=dict)
    keys: dict[str, tuple[str, ...]] = field(default_factory=dict)

    def check(self, shape: tuple[int, ...], expected: tuple[str, ...] | None, what: Callable[[], str]) -> None:
        """Refuse an array whose shape differs from the declaration, or from lengths of earlier fields."""
        if expected is None or not (shape or expected):
            return
        if len(shape) == len(expected) and shape[:1] == (0,):  # an empty array has no further lengths
            shape, expected = shape[:1], expected[:1]
        if len(shape) == len(expected):
            for word, length in zip(expected, shape, strict=True):
                if word != "*" and not word.isdigit():
                    self.lengths.setdefault(word, length)
        lengths = [int(word) if word.isdigit() else self.lengths.get(word, word) for word in expected]
        if len(shape) != len(lengths) or any(a not in (b, "*") for a, b in zip(lengths, shape, strict=True)):
            raise ValueError(f"{what()} has shape {shape}, expected ({', '.join(map(str, lengths))})")


@dataclass(frozen=True)
class Leaf:
    """Codec of a field of numbers or texts.

    Attributes
    ----------
    kind : {"f", "i", "b", "U"}
        Numbers, whole numbers, booleans or texts.
    build : callable
        Function from the array to the value of the field.
    shape : tuple of str, optional
        Lengths, words that stand for lengths, or "*" for any length; None for any shape.
    is_dataset : bool
        Whether it is stored as a dataset; else as an attribute.
    stored : Stored
        Declaration of the field.
    encode : callable
        Function from the value of the field to values for an array.
    """

    kind: str
    build: Callable[[Any], Any]
    shape: tuple[str, ...] | None
    is_dataset: bool
    stored: Stored
    encode: Callable[[Any], Any] = lambda value: value

    def write(self, group: h5py.Group, name: str, value: Any, context: Context) -> None:
        """Write the value of a field."""
        self.put(group, name, self.encode(value), context)

    def put(self, group: h5py.Group, name: str, values: Any, context: Context) -> None:
        """Write values that are already encoded as numbers or texts."""
        array = np.array(values, dtype=object) if self.kind == "U" else np.asarray(values)
        array = self._typed(array, lambda: where(group, name))
        if not array.size and self.shape:
            array = array.reshape((*array.shape, *(0,) * (len(self.shape) - array.ndim)))
        context.check(array.shape, self.shape, lambda: where(group, name))
        if self.is_dataset:
            unit, long_name = self.stored.unit, self.stored.long_name or name.replace("_", " ")
            add_dataset(group, name, array, context.units.get(unit, unit), long_name, self.kind != "U")
            return
        path, attribute = attribute_of(name)
        item = group if path == "." else group.require_group(path)
        add_attribute(item, attribute, array)

    def read(self, group: h5py.Group, name: str, context: Context) -> Any:
        """Return the value of a field."""
        return self.build(self.get(group, name, context))

    def get(self, group: h5py.Group, name: str, context: Context) -> Any:
        """Return the stored array that the field is decoded from; a single number or text for the shape ()."""
        if self.is_dataset:
            array = read_dataset(group, name, texts=self.kind == "U")
        else:
            path, attribute = attribute_of(name)
            array = np.asarray(read_attribute(group, attribute, path))
        array = self._typed(array, lambda: where(group, name))
        context.check(array.shape, self.shape, lambda: where(group, name))
        return array if self.shape != () else array.item()

    def _typed(self, array: npt.NDArray[Any], what: Callable[[], str]) -> npt.NDArray[Any]:
        if self.kind == "U":
            if array.dtype.kind == "U" or (array.dtype.kind == "O" and all(isinstance(t, str) for t in array.flat)):
                return array.astype(object)
        elif array.dtype.kind in _TAKEN[self.kind] or not array.size:
            return array.astype(_DTYPES[self.kind], copy=False)
        raise DamagedError(f"{what()} holds {array.dtype}, not {_WORDS[self.kind]}")


def attribute_of(place: str) -> tuple[str, str]:
    """Return path and attribute name of a place such as ``"parameters@units"``; the path "." is the group itself."""
    path, at, attribute = place.partition("@")
    return (path or ".", attribute) if at else (".", place)


class Codec(Protocol):
    """Protocol of a codec: it writes and reads one field of a dataclass in a group."""

    def write(self, group: h5py.Group, name: str, value: Any, context: Context, /) -> None:
        """Write the value of the field `name`."""

    def read(self, group: h5py.Group, name: str, context: Context, /) -> Any:
        """Return the value of the field `name`."""


@dataclass(frozen=True)
class DataclassGroup:
    """Codec of a dataclass, stored as a group."""

    kind: type
    fields: tuple[tuple[str, str, Codec], ...]  # name, place, codec
    late: tuple[str, ...] = ()

    def write(self, group: h5py.Group, name: str, value: Any, context: Context) -> None:
        """Write the value to a new group."""
        if not isinstance(value, self.kind):
            raise TypeError(f"{name}: {value!r} is no {self.kind.__name__}")
        self.put(group.create_group(name), value, Context(context.units))

    def put(self, group: h5py.Group, value: Any, context: Context) -> None:
        """Write the fields of the value to a group."""
        for name, place, codec in self.fields:
            codec.write(group, place, getattr(value, name), context)

    def read(self, group: h5py.Group, name: str, _context: Context) -> Any:
        """Return the value from its group."""
        return self.get(read_group(group, name), {}, Context())

    def get(self, group: h5py.Group, given: Mapping[str, Any], context: Context) -> Any:
        """Return the dataclass from the fields of a group; `given` are values of fields that are not stored."""
        known = [field for field in self.fields if field[0] not in self.late or _contains(group, field[1])]
        return self.kind(**{name: codec.read(group, place, context) for name, place, codec in known}, **given)


@dataclass(frozen=True)
class Inline:
    """Codec of a nested dataclass whose fields are stored in the group of the outer value."""

    record: DataclassGroup

    def write(self, group: h5py.Group, _name: str, value: Any, context: Context) -> None:
        """Write the fields of the value to the group of the outer value."""
        self.record.put(group, value, context)

    def read(self, group: h5py.Group, _name: str, context: Context) -> Any:
        """Return the value from its fields in the group of the outer value."""
        return self.record.get(group, {}, context)


@dataclass(frozen=True)
class Columns:
    """Codec of a tuple of dataclasses of numbers, texts and arrays: a group with a column for each field."""

    kind: type
    fields: tuple[tuple[str, Leaf], ...]

    def write(self, group: h5py.Group, name: str, value: Iterable[Any], context: Context) -> None:
        """Write the columns to a new group."""
        table, rows = group.create_group(name), tuple(value)
        context.lengths["rows"] = len(rows)
        for key, leaf in self.fields:
            leaf.put(table, key, [leaf.encode(getattr(row, key)) for row in rows], context)

    def read(self, group: h5py.Group, name: str, context: Context) -> tuple[Any, ...]:
        """Return the values from the columns."""
        table = read_group(group, name)
        context.lengths.pop("rows", None)
        columns = ([leaf.build(value) for value in leaf.get(table, key, context)] for key, leaf in self.fields)
        names = [key for key, _ in self.fields]
        return tuple(self.kind(**dict(zip(names, row, strict=True))) for row in zip(*columns, strict=True))


@dataclass(frozen=True)
class Numbered:
    """Codec of a tuple, or of a mapping to values: entries 0000, 0001 and so on in a group."""

    each: Codec
    named: bool

    def write(self, group: h5py.Group, name: str, value: Any, context: Context) -> None:
        """Write the entries to a new group."""
        entries = group.create_group(name)
        add_attribute(entries, "count", np.array(len(value)))
        if self.named:
            add_texts(entries, "names", value)
        for i, item in enumerate(value.values() if self.named else value):
            self.each.write(entries, f"{i:04d}", item, context)

    def read(self, group: h5py.Group, name: str, context: Context) -> Any:
        """Return the entries in their order."""
        entries = read_group(group, name)
        count = read_attribute(entries, "count")
        if len(entries) != count:
            raise ValueError(f"{entries.name} has {len(entries)} entries, expected {count}")
        values = tuple(
            self.each.read(entries, key, context) for key in sorted(entries, key=lambda key: (len(key), key))
        )
        return dict(zip(read_texts(entries, "names"), values, strict=True)) if self.named else values


@dataclass(frozen=True)
class Keyed:
    """Codec of a mapping to numbers or texts: one array, with the keys in an attribute."""

    values: Leaf
    keys: str

    def write(self, group: h5py.Group, name: str, value: Mapping[str, Any], context: Context) -> None:
        """Write the values in the order of the keys."""
        path, keys = self._keys(name)
        known = context.keys.get(f"{path}@{keys}")
        self.values.put(group, name, [value[key] for key in (value if known is None else known)], context)
        if known is None:
            context.keys[f"{path}@{keys}"] = tuple(value)
            add_texts(group[path], keys, value)

    def read(self, group: h5py.Group, name: str, context: Context) -> dict[str, Any]:
        """Return the mapping."""
        path, keys = self._keys(name)
        array = self.values.get(group, name, context)
        if f"{path}@{keys}" not in context.keys:
            context.keys[f"{path}@{keys}"] = read_texts(group, keys, path)
        names = context.keys[f"{path}@{keys}"]
        if len(names) != len(array):
            raise ValueError(f"{where(group, name)} has {len(array)} entries, its attribute {keys!r} {len(names)}")
        return dict(zip(names, map(self.values.build, array), strict=True))

    def _keys(self, name: str) -> tuple[str, str]:
        return attribute_of(self.keys or f"{name}@names")


@dataclass(frozen=True)
class Attributes:
    """Codec of a mapping to numbers: attributes of a group."""

    each: Leaf

    def write(self, group: h5py.Group, name: str, value: Mapping[str, Any], context: Context) -> None:
        """Write the attributes to a new group."""
        item = group.create_group(name)
        for key, number in value.items():
            self.each.write(item, f"@{key}", number, context)

    def read(self, group: h5py.Group, name: str, context: Context) -> dict[str, Any]:
        """Return the mapping."""
        item = read_group(group, name)
        return {key: self.each.read(item, f"@{key}", context) for key in item.attrs}


@dataclass(frozen=True)
class OneOf:
    """Codec of a value whose type is one of several (a union)."""

    codecs: tuple[Codec, ...]
    may_be_absent: bool

    def write(self, group: h5py.Group, name: str, value: Any, context: Context) -> None:
        """Write the value with the first codec that accepts it; nothing for None."""
        if value is None and self.may_be_absent:
            return
        self._first(lambda codec: codec.write(group, name, value, context))

    def read(self, group: h5py.Group, name: str, context: Context) -> Any:
        """Return the value of the first codec that accepts the entry; None when the entry is absent."""
        if self.may_be_absent and not _contains(group, name):
            return None
        records = [codec for codec in self.codecs if isinstance(codec, DataclassGroup)]
        if len(records) == len(self.codecs) > 1:  # the one of which the group contains the most fields
            item = read_group(group, name)
            codec = max(records, key=lambda each: sum(_contains(item, place) for _, place, _ in each.fields))
            return codec.read(group, name, context)
        return self._first(lambda codec: codec.read(group, name, context))

    def _first(self, act: Callable[[Codec], Any]) -> Any:
        *others, last = self.codecs
        for codec in others:
            try:
                return act(codec)
            except (DataError, TypeError, ValueError):
                continue
        return act(last)


def _contains(group: h5py.Group, place: str) -> bool:
    path, attribute = attribute_of(place)
    return place in group or (path in group and attribute in group[path].attrs)


_SCALARS: dict[Any, str] = {float: "f", int: "i", bool: "b", str: "U"}
_LINES = tuple[tuple[str, ...], ...]


def _record(kind: Any) -> DataclassGroup:
    """Return the codec of a dataclass or named tuple, from the annotations of its fields.

    Raises
    ------
    TypeError
        When a field has a type that cannot be stored.
    """
    names = [field.name for field in fields(kind)] if is_dataclass(kind) else list(getattr(kind, "_fields"))  # noqa: B009
    hints = get_type_hints(kind, include_extras=True)
    codecs, late = [], []
    for name in names:
        hint, *marks = get_args(hints[name]) if get_origin(hints[name]) is Annotated else (hints[name],)
        stored = next((mark for mark in marks if isinstance(mark, Stored)), None)
        if stored is not NOT_STORED:
            try:
                codecs.append((name, (stored and stored.at) or name, _codec(hint, stored)))
            except TypeError as error:
                raise TypeError(f"{kind.__name__}.{name}: {error}") from None
            late += [name] if stored and stored.late else []
    return DataclassGroup(kind, tuple(codecs), tuple(late))


record: Callable[[Any], DataclassGroup] = cache(_record)


def _codec(hint: Any, stored: Stored | None) -> Codec:
    if get_origin(hint) is Annotated:  # a type with its range inside a union
        hint = get_args(hint)[0]
    origin, args = type_parts(hint)
    if origin in (Union, UnionType):
        return OneOf(tuple(_codec(arg, stored) for arg in args if arg is not NoneType), NoneType in args)
    if stored is AS_JSON:
        return Leaf(
            "U", lambda text: hint(**plain(json.loads(text))), (), False, Stored(), lambda v: json.dumps(vars(v))
        )
    if _is_record(hint):
        return Inline(record(hint)) if stored is INLINE else record(hint)
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
    """Return a codec by columns if each field is a number, a text or an array of declared shape; else by rows."""
    columns = []
    for name, _, leaf in rows.fields:
        if not isinstance(leaf, Leaf) or leaf.shape is None or (leaf.shape and leaf.kind == "U"):
            return Numbered(rows, named=False)
        columns.append((name, replace(leaf, shape=("rows", *leaf.shape), is_dataset=leaf.kind != "U")))
    return Columns(rows.kind, tuple(columns))


def _mapping(hint: Any, to: Any, stored: Stored | None) -> Codec:
    each = _leaf(to, None)
    if each and each.shape == () and stored:
        shape = tuple(stored.shape.split()) or ("*",)
        return Keyed(replace(each, shape=shape, is_dataset=each.kind != "U", stored=stored), stored.keys)
    if each and each.shape == () and each.kind != "U":
        return Attributes(each)
    if _is_plain(hint):
        return Leaf("U", lambda text: _checked(json.loads(text), hint), (), False, Stored(), _plain_json)
    return Numbered(_codec(to, stored), named=True)


_plain_json = partial(json.dumps, default=dict)


def _is_plain(hint: Any) -> bool:
    """Return whether a type is text, or a mapping whose values are plain in turn."""
    return hint is str or (bool(get_args(hint)) and get_origin(hint) is Mapping and _is_plain(get_args(hint)[1]))


def _checked(value: Any, hint: Any) -> Any:
    """Return a value read from JSON; refuse a value of another type."""
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
    lines = _ArrayCodec("U", _split, ("*",), lambda texts: list(map(_lines, texts)))
    codec = lines if hint == _LINES else _values(hint)
    if codec is None:
        return None
    shape = tuple(stored.shape.split()) if stored and stored.shape else codec.shape
    is_array = codec.shape is None or hint == _LINES or (codec.kind != "U" and bool(codec.shape or stored))
    is_dataset = is_array and not (stored and "@" in stored.at)
    return Leaf(codec.kind, codec.build, shape, is_dataset, stored or Stored(), codec.encode)


def _values(hint: Any) -> _ArrayCodec | None:
    """Return the functions that convert values of a type to arrays and back; None for other types."""
    origin, args = type_parts(hint)
    if hint in _SCALARS:
        return _ArrayCodec(_SCALARS[hint], hint, (), _same)
    if isinstance(hint, type) and issubclass(hint, Enum):
        return _ArrayCodec(_SCALARS[type(next(iter(hint)).value)], hint, (), lambda member: member.value)
    if origin is Literal:
        return _ArrayCodec(_SCALARS[type(args[0])], lambda value: _one_of(value, args), (), _same)
    if origin is np.ndarray:
        kind = np.dtype(type_parts(args[1])[1][0]).kind
        return _ArrayCodec(kind, partial(np.array, dtype=str) if kind == "U" else _same, None, _same)
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


def _lines(texts: tuple[str, ...]) -> str:
    """Write texts as lines of one text; a line break within a text is escaped by two characters."""
    return "\n".join(text.replace("\\", "\\\\").replace("\n", "\\n") for text in texts)


def _split(texts: Any) -> tuple[tuple[str, ...], ...]:
    return tuple(tuple(map(_one_text, text.split("\n"))) if text else () for text in texts)


def _one_text(line: str) -> str:
    return re.sub(r"\\([\\n])", lambda match: "\n" if match[1] == "n" else "\\", line)


T = TypeVar("T")


def write_fields(group: h5py.Group, value: Any, units: Mapping[str, str] | None = None) -> None:
    """Write the fields of a dataclass to a group.

    Parameters
    ----------
    group : h5py.Group
        The group.
    value : dataclass
        The value.
    units : dict of str to str, optional
        Units that depend on the value, by the word that its fields declare.

    Raises
    ------
    ValueError
        When the shape of a field differs from the declared one.
    """
    record(type(value)).put(group, value, Context(units or {}))


def read_fields(group: h5py.Group, made: type[T], **given: Any) -> T:
    """Return the dataclass in a group written by `write_fields`.

    Parameters
    ----------
    group : h5py.Group
        Group of a file opened by `gbid.core.hdf5.reading`, which converts errors to `gbid.core.errors.DataError`.
    made : type
        The dataclass.
    **given
        Fields that are not stored.

    Returns
    -------
    dataclass
        The value, of type `made`.
    """
    value: T = record(made).get(group, given, Context())
    return value


# ---- Values that are saved in an HDF5 file and loaded from it.


class InFile:
    """Base of dataclasses that `save` writes to an HDF5 file and `load` reads.

    Their fields are stored by their types. A value that is stored in another way overrides both methods.
    """

    FILE: ClassVar[FileKind]

    def to_hdf5(self, group: h5py.Group) -> None:
        """Write this value to the empty `group`."""
        write_fields(group, self)

    def write_beside(self, path: Path, overwrite: bool) -> None:
        """Write the companion file in another format beside `path`; `overwrite` as for `save`."""

    @classmethod
    def from_hdf5(cls, group: h5py.Group) -> Self:
        """Return the value in a `group` written by `to_hdf5`."""
        return read_fields(group, cls)


F = TypeVar("F", bound=InFile)
DOCUMENT = "document"
"""Dataset of the plain values that pages show of a value."""


def save(value: InFile, path: str | Path, overwrite: bool = False, document: Any = None, **attributes: Any) -> None:
    """Write a value to an HDF5 file, which appears under its name when it is complete.

    Parameters
    ----------
    value : Recording, FitResult, FitTable or another value with a file of its own
        The value.
    path : path
        The file; missing folders are made.
    overwrite : bool
        Whether an existing file may be replaced.
    document : plain values, optional
        What pages show of the value, for `read_document`: a fraction of the time to read the value.
    **attributes
        Further attributes of the root.

    Raises
    ------
    UsageError
        When the file exists and `overwrite` is not set.
    DataError
        When the file cannot be written.
    """
    with writing(path, value.FILE, overwrite) as file:
        value.write_beside(Path(path), overwrite)
        value.to_hdf5(file)
        file.attrs.update(attributes)
        if document is not None:
            text = np.frombuffer(_plain_json(document).encode(), np.uint8)
            add_dataset(file, DOCUMENT, text, "", "what pages show, JSON in UTF-8", compress=True)


def read_document(path: Path, kind: FileKind) -> Any:
    """Return the plain values (JSON) that `save` stored with a value.

    Raises
    ------
    DataError
        When the file cannot be read, is of another kind, or was written without them.
    """
    with reading(path, kind) as file:
        return document_in(file)


def document_in(file: h5py.File) -> Any:
    """Return the JSON document that `save` stored beside the fields of a value, from an open file."""
    return json.loads(read_dataset(file, DOCUMENT).tobytes())


def load(path: str | Path, kind: type[F], *, apart: bool = False) -> F:
    """Return the value of a kind from an HDF5 file written by `save`; errors as for `gbid.load`, `apart` for `reading`.

    Results of a run are read without `apart`.
    """
    with reading(path, kind.FILE, apart=apart) as file:
        return kind.from_hdf5(file)
