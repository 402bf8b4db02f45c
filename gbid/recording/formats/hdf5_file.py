"""Reader of HDF5 files of other programs: datasets and fields of tables by their paths."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from gbid.core.errors import DataError
from gbid.recording.mapping import nearest
from gbid.recording.readers import FileChannel, FileFormat, array_channels
from gbid.recording.text_files import FileColumn, pick_column, split_reference

_UNIT_ATTRIBUTES = ("units", "unit", "Units", "Unit", "Unit_string", "unit_string")


def read_hdf5(path: Path, references: Sequence[str]) -> dict[str, FileColumn]:
    """Return the named columns of an HDF5 file.

    A column is the path of a dataset, ``run1/p_x`` or ``run1/p[0]``, or the path of a table with one of its fields,
    ``run1/table/p_x``. The unit is that of the attribute ``units`` or ``unit``.

    Raises
    ------
    DataError
        When the file is damaged or not HDF5, when a dataset is missing, or when it is not an array of numbers with
        that column.
    """
    columns = {}
    with _opened(path) as file:
        for reference in references:
            name, _ = split_reference(reference)
            dataset, field = _find(path, file, name)
            columns[reference] = FileColumn(
                pick_column(path, reference, _values(path, dataset, field)), _unit(dataset, field)
            )
    return columns


def hdf5_channels(path: Path) -> list[FileChannel]:
    """Return the channels of an HDF5 file: its datasets, and the fields of its tables.

    Raises
    ------
    DataError
        When the file is damaged or not HDF5.
    """
    channels: list[FileChannel] = []

    def visit(name: str, entry: Any) -> None:
        if isinstance(entry, h5py.Dataset):
            for field in entry.dtype.names or (None,):
                value = _values(path, entry, field) if entry.shape is not None else np.zeros(0)
                full = name if field is None else f"{name}/{field}"
                channels.extend(array_channels(full, value, unit=_unit(entry, field)))

    with _opened(path) as file:
        file.visititems(visit)
    return channels


def _opened(path: Path) -> h5py.File:
    with path.open("rb"):  # the library wraps the error of a file that is not there
        pass
    try:
        return h5py.File(path, "r")
    except OSError as error:
        raise DataError(f"{path}: not a readable HDF5 file (truncated or of another format): {error}") from None


def _find(path: Path, file: h5py.File, name: str) -> tuple[Any, str | None]:
    """Return the dataset of a path, and the field of it that the last part of the path names."""
    parent, _, last = name.strip("/").rpartition("/")
    if name.strip("/") and isinstance(file.get(name), h5py.Dataset):
        return file[name], None
    table = file.get(parent) if parent else None
    if isinstance(table, h5py.Dataset) and last in (table.dtype.names or ()):
        return table, last
    known: list[str] = []

    def visit(here: str, entry: Any) -> None:
        if isinstance(entry, h5py.Dataset):
            known.extend(f"{here}/{field}" for field in entry.dtype.names or ())
            known.extend([] if entry.dtype.names else [here])

    file.visititems(visit)
    raise DataError(f"{path}: no dataset {name!r}; {nearest(name, known)}")


def _values(path: Path, dataset: Any, field: str | None) -> Any:
    """Return a dataset, or one field of it, as an array."""
    try:
        values = dataset[()] if field is None else dataset.fields(field)[()]
    except (OSError, TypeError) as error:
        raise DataError(f"{path}: dataset {dataset.name}: cannot be read: {error}") from None
    return np.asarray(values)


def _unit(dataset: Any, field: str | None) -> str | None:
    """Return the unit in the attributes of a dataset; a table has one for all its fields, or none."""
    for key in (f"{field}_units", f"{field}_unit", *(() if field else _UNIT_ATTRIBUTES)):
        value = dataset.attrs.get(key)
        if isinstance(value, bytes | np.bytes_):
            return value.decode("utf-8", "replace")
        if isinstance(value, str):
            return value
    return None


FORMAT = FileFormat((".h5", ".hdf5"), read_hdf5, hdf5_channels, may_crash=True)
