"""Dataclasses in HDF5 files: each field is written and read by its type, see `gbid.hdf5.Stored`."""

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
    value : dataclass
    units : dict of str to str, optional
        Units that only the value knows, by the word that its fields declare.

    Raises
    ------
    ValueError
        When a field has another shape than it declares.
    """
    record(type(value)).put(group, value, units or {})


def read_fields(group: h5py.Group, made: type[T], **given: Any) -> T:
    """Read a dataclass from the group that `write_fields` wrote.

    Parameters
    ----------
    group : h5py.Group
        Of a file that `gbid.hdf5.reading` opened, which turns what is wrong into a `gbid.errors.DataError`.
    made : type
        The dataclass.
    **given
        Fields that are not stored.
    """
    found: T = record(made).get(group, given)
    return found


def save(value: Any, path: str | Path, kind: FileKind, overwrite: bool = False, **attributes: Any) -> None:
    """Write a dataclass to a file of its own, with further attributes of its root.

    Raises
    ------
    UsageError
        When the file exists and `overwrite` is not set.
    DataError
        When it cannot be written.
    """
    with writing(path, kind, overwrite) as file:
        write_fields(file, value)
        file.attrs.update(attributes)


def load(path: str | Path, kind: FileKind, made: type[T]) -> T:
    """Read what `save` stored.

    Raises
    ------
    DataError
        When the file is missing, damaged, incomplete or of another kind.
    """
    with reading(path, kind) as file:
        return read_fields(file, made)
