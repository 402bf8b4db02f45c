"""Reader of MATLAB files: up to v7.2 by scipy, v7.3 (HDF5) by pymatreader."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from gbid.errors import DataError
from gbid.recording.importers.columns import FileColumn, pick_column, split_reference
from gbid.recording.importers.file_format import FileFormat
from gbid.recording.importers.mapping import nearest


def read_mat(path: Path, references: Sequence[str]) -> dict[str, FileColumn]:
    """Return the named columns of a MATLAB file of any version.

    Arrays have the shape that MATLAB shows. This also holds for v7.3 files, which store arrays transposed.

    Raises
    ------
    DataError
        When the file is damaged or not a MATLAB file, when a variable or field is missing, or when it is not an array
        of numbers with that column.
    """
    paths = {reference: split_reference(reference)[0].split(".") for reference in references}
    roots = sorted({parts[0] for parts in paths.values()})
    with path.open("rb") as handle:
        hdf5 = handle.read(10) == b"MATLAB 7.3" or h5py.is_hdf5(path)
    try:
        with warnings.catch_warnings():
            # Both readers warn of MATLAB objects and return another type; pick_column refuses it.
            warnings.simplefilter("ignore")
            variables, names = (_load_v73 if hdf5 else _load_v5)(path, roots)
    except Exception as error:  # a damaged file can raise any kind of error in the readers
        raise DataError(f"{path}: not a readable MATLAB file (truncated or of another format): {error}") from None
    columns = {}
    for reference, parts in paths.items():
        if parts[0] not in variables:
            raise DataError(f"{path}: no variable {parts[0]!r}; {nearest(parts[0], names)}")
        value = _walk(path, reference, variables[parts[0]], parts)
        columns[reference] = FileColumn(pick_column(path, reference, value, row_vectors=True))
    return columns


def _walk(path: Path, reference: str, value: Any, parts: list[str]) -> Any:
    """Return the field of nested structs that the dots of a reference name."""
    for depth, part in enumerate(parts[1:], start=1):
        struct = ".".join(parts[:depth])
        if not isinstance(value, Mapping):
            raise DataError(f"{path}: column {reference!r}: {struct} is not a struct with fields")
        if part not in value:
            raise DataError(f"{path}: column {reference!r}: {struct} has no field {part!r}; {nearest(part, value)}")
        value = value[part]
    return value


def _load_v5(path: Path, roots: list[str]) -> tuple[dict[str, Any], list[str]]:
    """Return the variables read by scipy, with structs as dicts, and the names of all variables."""
    from scipy.io import loadmat, whosmat  # imported here, because the import takes a quarter of a second

    loaded = loadmat(path, appendmat=False, variable_names=roots)
    names = [name for name, *_ in whosmat(path, appendmat=False)]
    return {name: _fields(loaded[name]) for name in roots if name in names}, names


def _fields(value: Any) -> Any:
    """Return the record array of one struct as a dict; arrays of structs stay as they are."""
    if isinstance(value, np.ndarray) and value.dtype.names and value.size == 1:
        return {name: _fields(value[name].flat[0]) for name in value.dtype.names}
    return value


def _load_v73(path: Path, roots: list[str]) -> tuple[dict[str, Any], list[str]]:
    """Return the variables read by pymatreader, with structs as dicts, and the names of all variables."""
    from pymatreader import read_mat as read

    with h5py.File(path, "r") as file:
        names = [name for name in file if not name.startswith("#")]
        wanted = [name for name in roots if name in names]
        loaded = read(path, variable_names=wanted) if wanted else {}
        return {name: _shaped(loaded[name], file[name]) for name in wanted}, names


def _shaped(value: Any, stored: h5py.Group | h5py.Dataset) -> Any:
    """Return arrays with the dimensions of length one that pymatreader drops."""
    if isinstance(value, dict) and isinstance(stored, h5py.Group):
        return {name: _shaped(entry, stored[name]) for name, entry in value.items()}
    number = isinstance(value, np.ndarray | int | float) and isinstance(stored, h5py.Dataset)
    if number and stored.dtype.kind in "fiu" and np.size(value) == stored.size:
        return np.reshape(value, stored.shape[::-1])
    return value


FORMAT = FileFormat((".mat",), read_mat)
