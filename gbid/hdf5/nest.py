"""Codecs of nested fields: dataclasses, tuples of dataclasses, mappings, and optional values."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import h5py

from gbid.errors import DataError
from gbid.hdf5.entries import add_texts, read_attribute, read_group, read_texts, where
from gbid.hdf5.leaf import Context, Leaf, attribute_of


class Codec(Protocol):
    """Codec: it writes a field of a dataclass to a group and reads it back."""

    def write(self, group: h5py.Group, name: str, value: Any, context: Context, /) -> None:
        """Write the value of the field `name`."""

    def read(self, group: h5py.Group, name: str, context: Context, /) -> Any:
        """Return the value of the field `name`."""


@dataclass(frozen=True)
class DataclassGroup:
    """Codec of a dataclass: a group."""

    made: type
    fields: tuple[tuple[str, str, Codec], ...]  # name, place, codec

    def write(self, group: h5py.Group, name: str, value: Any, context: Context) -> None:
        """Write the value to a new group."""
        if not isinstance(value, self.made):
            raise TypeError(f"{name}: {value!r} is no {self.made.__name__}")
        self.put(group.create_group(name), value, context.units)

    def put(self, group: h5py.Group, value: Any, units: Mapping[str, str]) -> None:
        """Write the fields of the value to a group."""
        context = Context(units)
        for name, place, codec in self.fields:
            codec.write(group, place, getattr(value, name), context)

    def read(self, group: h5py.Group, name: str, _context: Context) -> Any:
        """Return the value from its group."""
        return self.get(read_group(group, name), {})

    def get(self, group: h5py.Group, given: Mapping[str, Any]) -> Any:
        """Return the value from the fields in a group and those in `given`."""
        context = Context()
        return self.made(**{name: codec.read(group, place, context) for name, place, codec in self.fields}, **given)


@dataclass(frozen=True)
class Columns:
    """Codec of a tuple of dataclasses of numbers, texts and arrays: a group with a column for each field."""

    made: type
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
        columns = [leaf.get(table, key, context) for key, leaf in self.fields]
        rows = zip(
            *([leaf.build(v) for v in c] for (_, leaf), c in zip(self.fields, columns, strict=True)), strict=True
        )
        return tuple(self.made(**dict(zip((key for key, _ in self.fields), row, strict=True))) for row in rows)


@dataclass(frozen=True)
class Numbered:
    """Codec of a tuple of values, or of a mapping to them: entries 0000, 0001 and so on of a group."""

    each: Codec
    named: bool

    def write(self, group: h5py.Group, name: str, value: Any, context: Context) -> None:
        """Write the entries to a new group."""
        entries = group.create_group(name)
        entries.attrs["count"] = len(value)
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
        found = tuple(self.each.read(entries, key, context) for key in sorted(entries, key=lambda key: (len(key), key)))
        return dict(zip(read_texts(entries, "names"), found, strict=True)) if self.named else found


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
            context.keys[f"{path}@{keys}"] = read_texts(group[path], keys)
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
        own = group.create_group(name)
        for key, number in value.items():
            self.each.write(own, f"@{key}", number, context)

    def read(self, group: h5py.Group, name: str, context: Context) -> dict[str, Any]:
        """Return the mapping."""
        own = read_group(group, name)
        return {key: self.each.read(own, f"@{key}", context) for key in own.attrs}


@dataclass(frozen=True)
class OneOf:
    """Codec of a value of one of several types."""

    codecs: tuple[Codec, ...]
    may_be_absent: bool

    def write(self, group: h5py.Group, name: str, value: Any, context: Context) -> None:
        """Write the value as the first type that accepts it; nothing for None."""
        if value is None and self.may_be_absent:
            return
        self._first(lambda codec: codec.write(group, name, value, context))

    def read(self, group: h5py.Group, name: str, context: Context) -> Any:
        """Return the value as the first type that accepts it; None when it is absent."""
        if self.may_be_absent and not _is_there(group, name):
            return None
        records = [codec for codec in self.codecs if isinstance(codec, DataclassGroup)]
        if len(records) == len(self.codecs) > 1:  # the one with the most of its fields there
            there = read_group(group, name)
            return max(records, key=lambda c: sum(_is_there(there, at) for _, at, _ in c.fields)).read(
                group, name, context
            )
        return self._first(lambda codec: codec.read(group, name, context))

    def _first(self, act: Callable[[Codec], Any]) -> Any:
        *others, last = self.codecs
        for codec in others:
            try:
                return act(codec)
            except (DataError, TypeError, ValueError):
                continue
        return act(last)


def _is_there(group: h5py.Group, place: str) -> bool:
    path, attribute = attribute_of(place)
    return place in group or ((path in group if path else True) and attribute in (group[path] if path else group).attrs)
