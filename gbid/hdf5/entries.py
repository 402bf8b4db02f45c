"""Entries of an HDF5 file: datasets and attributes with units and long names, checked when they are read."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt

from gbid.errors import DataError

TEXT = h5py.string_dtype()
_ROOM, _EXPANSION = 1 << 20, 1032  # most bytes of a dataset: deflate makes 1032 of one
_ONE = h5py.h5s.create(h5py.h5s.SCALAR)


class DamagedError(DataError):
    """Error for an entry that is missing or of the wrong type; `gbid.hdf5.reading` adds the file and what to do."""


def add_dataset(
    group: h5py.Group, name: str, values: npt.ArrayLike, unit: str, long_name: str, **options: Any
) -> h5py.Dataset:
    """Write one dataset with its unit and its long name; return it."""
    dataset = group.create_dataset(name, data=values, **options)
    add_attribute(dataset, "units", np.array(unit, dtype=object))
    add_attribute(dataset, "long_name", np.array(long_name, dtype=object))
    return dataset


def add_attribute(item: h5py.HLObject, name: str, values: npt.NDArray[Any]) -> None:
    """Write numbers or texts as a new attribute; low-level calls take half the time of ``item.attrs``."""
    text = values.dtype.kind == "O"
    values = np.asarray(values, dtype=TEXT) if text else values
    kind = h5py.h5t.py_create(values.dtype, logical=True)
    space = h5py.h5s.create_simple(values.shape) if values.ndim else _ONE
    h5py.h5a.create(item.id, name.encode(), kind, space).write(values)


def add_texts(item: h5py.HLObject, name: str, texts: Iterable[str]) -> None:
    """Write texts as a new attribute."""
    add_attribute(item, name, np.array(list(texts), dtype=object))


def read_dataset(group: h5py.Group, name: str, texts: bool = False) -> npt.NDArray[Any]:
    """Return the values of one dataset of any shape.

    Parameters
    ----------
    group : h5py.Group
        Group of the dataset.
    name : str
        Name or path below the group.
    texts : bool
        Whether the values are texts; else numbers.

    Returns
    -------
    array
        The values.

    Raises
    ------
    DamagedError
        When there is no dataset of that name, or its values have another type.
    """
    try:
        found = group[name]
    except KeyError:
        raise DamagedError(f"{where(group, name)} is missing") from None
    if not isinstance(found, h5py.Dataset):
        raise DamagedError(f"{where(group, name)} is a group, not a dataset")
    if found.shape is None:
        raise DamagedError(f"{where(group, name)} holds nothing, not {'texts' if texts else 'numbers'}")
    if found.nbytes > _ROOM + _EXPANSION * group.file.id.get_filesize():
        raise DamagedError(f"{where(group, name)} declares more values than the file can contain")
    if texts != (h5py.check_string_dtype(found.dtype) is not None) or (not texts and found.dtype.kind not in "fiub"):
        raise DamagedError(f"{where(group, name)} holds {found.dtype}, not {'texts' if texts else 'numbers'}")
    return np.asarray(found.asstr()[()] if texts else found[()])


def read_attribute(item: h5py.HLObject, name: str) -> Any:
    """Return the value of one attribute of a file, group or dataset.

    Raises
    ------
    DamagedError
        When the attribute is missing.
    """
    try:
        return item.attrs[name]
    except KeyError:
        raise DamagedError(f"{item.name} has no attribute {name!r}") from None


def read_text(item: h5py.HLObject, name: str) -> str:
    """Return the text of one attribute.

    Raises
    ------
    DamagedError
        When the attribute is missing or not a text.
    """
    found = read_attribute(item, name)
    if not isinstance(found, str):
        raise DamagedError(f"attribute {name!r} of {item.name} is not a text")
    return found


def read_texts(item: h5py.HLObject, name: str) -> tuple[str, ...]:
    """Return the texts of one attribute.

    Raises
    ------
    DamagedError
        When the attribute is missing or not a list of texts.
    """
    found = np.atleast_1d(read_attribute(item, name))
    if found.ndim != 1 or not all(isinstance(text, str) for text in found):
        raise DamagedError(f"attribute {name!r} of {item.name} is not a list of texts")
    return tuple(map(str, found))


def read_group(group: h5py.Group, name: str) -> h5py.Group:
    """Return the subgroup of that name.

    Raises
    ------
    DamagedError
        When there is no such group.
    """
    found = group.get(name)
    if not isinstance(found, h5py.Group):
        raise DamagedError(f"group {where(group, name)} is {'missing' if found is None else 'a dataset'}")
    return found


def where(group: h5py.Group, name: str) -> str:
    """Return the path of an entry within its file."""
    return f"{group.name.rstrip('/')}/{name}"
