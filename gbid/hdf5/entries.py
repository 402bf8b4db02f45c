"""Single entries of an HDF5 file: annotated datasets and attributes, checked when they are read."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt

from gbid.errors import DataError

TEXT = h5py.string_dtype()
_ONE = h5py.h5s.create(h5py.h5s.SCALAR)


class DamagedError(DataError):
    """An entry that is missing or of the wrong type; `gbid.hdf5.reading` adds the file and what to do."""


def add_dataset(
    group: h5py.Group, name: str, values: npt.ArrayLike, unit: str, long_name: str, **options: Any
) -> h5py.Dataset:
    """Write one dataset with its unit and its name in words."""
    dataset = group.create_dataset(name, data=values, **options)
    add_attribute(dataset, "units", np.array(unit, dtype=object))
    add_attribute(dataset, "long_name", np.array(long_name, dtype=object))
    return dataset


def add_attribute(item: h5py.HLObject, name: str, values: npt.NDArray[Any]) -> None:
    """Write numbers or texts as an attribute that is not there yet; twice as fast as by ``item.attrs``."""
    text = values.dtype.kind == "O"
    values = np.asarray(values, dtype=TEXT) if text else values
    kind = h5py.h5t.py_create(values.dtype, logical=True)
    space = h5py.h5s.create_simple(values.shape) if values.ndim else _ONE
    h5py.h5a.create(item.id, name.encode(), kind, space).write(values)


def add_texts(item: h5py.HLObject, name: str, texts: Iterable[str]) -> None:
    """Write texts as an attribute that is not there yet."""
    add_attribute(item, name, np.array(list(texts), dtype=object))


def read_dataset(group: h5py.Group, name: str, texts: bool = False) -> npt.NDArray[Any]:
    """Values of one dataset, any shape.

    Parameters
    ----------
    group : h5py.Group
    name : str
        May be a path.
    texts : bool
        Whether it holds texts; else numbers.

    Raises
    ------
    DamagedError
        When there is no dataset of that name, or it holds something else.
    """
    try:
        found = group[name]
    except KeyError:
        raise DamagedError(f"{where(group, name)} is missing") from None
    if not isinstance(found, h5py.Dataset):
        raise DamagedError(f"{where(group, name)} is a group, not a dataset")
    is_text = texts and h5py.check_string_dtype(found.dtype) is not None
    values = np.asarray(found.asstr()[()] if is_text else found[()])
    if texts != is_text or (not texts and values.dtype.kind not in "fiub"):
        raise DamagedError(f"{where(group, name)} holds {found.dtype}, not {'texts' if texts else 'numbers'}")
    return values


def read_attribute(item: h5py.HLObject, name: str) -> Any:
    """Value of one attribute of a file, group or dataset.

    Raises
    ------
    DamagedError
        When it is missing.
    """
    try:
        return item.attrs[name]
    except KeyError:
        raise DamagedError(f"{item.name} has no attribute {name!r}") from None


def read_text(item: h5py.HLObject, name: str) -> str:
    """Text of one attribute.

    Raises
    ------
    DamagedError
        When it is missing or holds no text.
    """
    found = read_attribute(item, name)
    if not isinstance(found, str):
        raise DamagedError(f"attribute {name!r} of {item.name} holds no text")
    return found


def read_texts(item: h5py.HLObject, name: str) -> tuple[str, ...]:
    """Texts of one attribute.

    Raises
    ------
    DamagedError
        When it is missing or holds no texts.
    """
    found = np.atleast_1d(read_attribute(item, name))
    if found.ndim != 1 or not all(isinstance(text, str) for text in found):
        raise DamagedError(f"attribute {name!r} of {item.name} holds no list of texts")
    return tuple(map(str, found))


def read_group(group: h5py.Group, name: str) -> h5py.Group:
    """Group of that name.

    Raises
    ------
    DamagedError
        When there is none.
    """
    found = group.get(name)
    if not isinstance(found, h5py.Group):
        raise DamagedError(f"group {where(group, name)} is {'missing' if found is None else 'a dataset'}")
    return found


def where(group: h5py.Group, name: str) -> str:
    """Path of an entry within its file."""
    return f"{group.name.rstrip('/')}/{name}"
