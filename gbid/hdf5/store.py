"""Dataclasses in HDF5 files: each field is stored by its type, see `gbid.hdf5.Stored`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

import h5py

from gbid.hdf5.by_type import record
from gbid.hdf5.file import FileKind, reading, writing

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
    record(type(value)).put(group, value, units or {})


def read_fields(group: h5py.Group, made: type[T], **given: Any) -> T:
    """Return the dataclass in a group of `write_fields`.

    Parameters
    ----------
    group : h5py.Group
        Group of a file opened by `gbid.hdf5.reading`, which converts errors to `gbid.errors.DataError`.
    made : type
        The dataclass.
    **given
        Fields that are not stored.

    Returns
    -------
    dataclass
        The value, of type `made`.
    """
    found: T = record(made).get(group, given)
    return found


def save(value: Any, path: str | Path, kind: FileKind, overwrite: bool = False, **attributes: Any) -> None:
    """Write a dataclass to a file of its own, with further attributes of the root.

    Raises
    ------
    UsageError
        When the file exists and `overwrite` is not set.
    DataError
        When the file cannot be written.
    """
    with writing(path, kind, overwrite) as file:
        write_fields(file, value)
        file.attrs.update(attributes)


def load(path: str | Path, kind: FileKind, made: type[T]) -> T:
    """Return the dataclass in a file of `save`.

    Raises
    ------
    DataError
        When the file is missing, damaged, incomplete or of another kind.
    """
    with reading(path, kind) as file:
        return read_fields(file, made)
