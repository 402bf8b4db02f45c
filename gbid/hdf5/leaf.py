"""Codec of a field of numbers or texts, stored as an attribute or a dataset."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt

from gbid.hdf5.entries import TEXT, DamagedError, add_attribute, add_dataset, read_attribute, read_dataset, where
from gbid.hdf5.stored import Stored

_DTYPES = {"f": np.float64, "i": np.int64, "b": np.bool_}
_TAKEN = {"f": "fiu", "i": "iu", "b": "b"}  # accepted kinds of arrays: whole numbers are numbers, too
_WORDS = {"f": "numbers", "i": "whole numbers", "b": "true or false", "U": "texts"}
_COMPRESSED = 10_000  # smallest number of values in a compressed dataset


@dataclass
class Context:
    """State shared by the fields of one value while it is written or read.

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
        """Refuse a shape that differs from the declared one, or from lengths found before."""
        if expected is None:
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
        """Write values that are encoded already."""
        array = np.array(values, dtype=object) if self.kind == "U" else np.asarray(values)
        array = self._typed(array, lambda: where(group, name))
        if not array.size and self.shape:
            array = array.reshape((*array.shape, *(0,) * (len(self.shape) - array.ndim)))
        context.check(array.shape, self.shape, lambda: where(group, name))
        if self.is_dataset:
            unit, words = self.stored.unit, self.stored.long_name or name.replace("_", " ")
            options: dict[str, Any] = {"dtype": TEXT} if self.kind == "U" else {}
            if self.kind != "U" and array.size >= _COMPRESSED:
                options = {"compression": "gzip", "shuffle": True}
            add_dataset(group, name, array, context.units.get(unit, unit), words, **options)
            return
        path, attribute = attribute_of(name)
        item = group.require_group(path) if path else group
        add_attribute(item, attribute, array)

    def read(self, group: h5py.Group, name: str, context: Context) -> Any:
        """Return the value of a field."""
        return self.build(self.get(group, name, context))

    def get(self, group: h5py.Group, name: str, context: Context) -> Any:
        """Return the array from which the value is built; a single number or text for the shape ()."""
        if self.is_dataset:
            array = read_dataset(group, name, texts=self.kind == "U")
        else:
            path, attribute = attribute_of(name)
            item = group[path] if path else group
            array = np.asarray(read_attribute(item, attribute))
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
    """Return path and attribute of a place such as ``"parameters@units"`` or ``"status"``."""
    path, at, attribute = place.partition("@")
    return (path, attribute) if at else ("", place)
