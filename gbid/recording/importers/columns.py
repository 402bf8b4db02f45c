"""Columns of a file: their values and units, their names, and the notation ``name[3]`` for one column of an array."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from gbid.arrays import FloatArray
from gbid.errors import DataError
from gbid.recording.importers.file_units import written_unit
from gbid.recording.importers.mapping import nearest

_INDEXED = re.compile(r"(?P<name>.+)\[\s*(?P<index>\d+)\s*\]")
_NAME_UNIT = re.compile(r"(?P<name>.*?)\s*(?:\[(?P<square>[^][]*)\]|\((?P<round>[^()]*)\))")


class FileColumn(NamedTuple):
    """One column of a file.

    Attributes
    ----------
    values : (n_samples,) array
        Numbers as in the file.
    unit : str or None
        Unit given by the file; None when the file gives none.
    sample_time : float or None
        Time between samples that the file states for this column [s]; None when it states none.
    """

    values: FloatArray
    unit: str | None = None
    sample_time: float | None = None


def split_reference(reference: str) -> tuple[str, int | None]:
    """Return the name and the column index of a reference like ``"noise[3]"``; without brackets the index is None."""
    match = _INDEXED.fullmatch(reference)
    return (match["name"], int(match["index"])) if match else (reference, None)


def pick_column(path: Path, reference: str, value: object, row_vectors: bool = False) -> FloatArray:
    """Return the column of a variable that a reference names, shape (n_samples,).

    Parameters
    ----------
    path : path
        The file, for messages.
    reference : str
        ``"name"`` or ``"name[index]"``.
    value : object
        The variable of that name.
    row_vectors : bool
        Whether a (1, n_samples) array named without index is a vector, as MATLAB stores one. Larger arrays are never
        transposed.

    Returns
    -------
    (n_samples,) array
        Numbers of the column.

    Raises
    ------
    DataError
        When the variable is not an array of real numbers, or when the reference does not name one column of it.
    """
    name, index = split_reference(reference)
    where = f"{path}: column {reference!r}:"
    if not isinstance(value, np.ndarray) or value.dtype.kind not in "fiub":
        kind = f"an array of {value.dtype}" if isinstance(value, np.ndarray) else f"a {type(value).__name__}"
        raise DataError(f"{where} {name} is {kind}, not an array of real numbers; save it as plain numbers")
    shape = value.shape
    if value.size == 0:
        raise DataError(f"{where} {name} is empty: shape {shape}")
    if value.ndim not in (1, 2) or value.size == 1:
        raise DataError(f"{where} {name} has shape {shape}; expected (n_samples,) or (n_samples, n_channels)")
    if index is None:
        if value.ndim == 2 and not (shape[1] == 1 or (row_vectors and shape[0] == 1)):
            raise DataError(f"{where} {name} has shape {shape}; name one of its columns, e.g. {name}[0]")
        return np.asarray(value, dtype=float).reshape(-1)
    if value.ndim == 1:
        raise DataError(f"{where} {name} has one dimension; leave the index out: {name}")
    if shape[0] < shape[1]:
        raise DataError(
            f"{where} {name} has shape {shape}: more columns than rows; arrays are (n_samples, n_channels), "
            "transpose it yourself if it is stored the other way"
        )
    if index >= shape[1]:
        raise DataError(f"{where} {name} has shape {shape}; columns count from 0 to {shape[1] - 1}")
    return np.array(value[:, index], dtype=float)


def name_and_unit(heading: str) -> tuple[str, str | None]:
    """Return name and unit of a heading like ``u_x [um]`` or ``u_x (um)``; without brackets the unit is None."""
    match = _NAME_UNIT.fullmatch(heading)
    if not match:
        return heading, None
    return match["name"], written_unit(match["square"] if match["square"] is not None else match["round"])


def find_heading(path: Path, headings: Sequence[str], reference: str) -> int:
    """Return the index of a column, named by its whole heading or by its name without unit.

    Raises
    ------
    DataError
        When there is no such column, or when several have this name.
    """
    if reference in headings:
        return headings.index(reference)
    names = [name_and_unit(heading)[0] for heading in headings]
    found = [i for i, name in enumerate(names) if name == reference]
    if len(found) > 1:
        cells = ", ".join(repr(headings[i]) for i in found)
        raise DataError(f"{path}: column {reference!r} may be any of {cells}; give the whole heading")
    if not found:
        raise DataError(f"{path}: no column {reference!r}; {nearest(reference, [n for n in names if n])}")
    return found[0]


def seconds(times: np.ndarray[Any, Any]) -> FloatArray:
    """Return durations (numpy.timedelta64) in seconds, and dates (numpy.datetime64) in seconds from the first."""
    if times.dtype.kind == "M" and times.size:
        times = times - times.flat[0]
    return np.asarray(times / np.timedelta64(1, "s"), dtype=float)
