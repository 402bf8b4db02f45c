"""Columns of a file: values, units (stated by file or mapping), and names."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from gbid.core.arrays import FloatArray
from gbid.core.errors import DataError, UsageError, nearest
from gbid.core.units import conversion_factor, is_ambiguous, is_speed_unit, is_unit


def written_unit(word: str) -> str:
    """Return a stated unit without blanks around it; all spellings of revolutions per minute become ``rpm``."""
    return "rpm" if is_speed_unit(word) else "" if word.strip() == "-" else word.strip()


def is_file_unit(cell: str) -> bool:
    """Return whether a cell may be a unit, with or without brackets."""
    return is_unit(written_unit(cell.strip().strip("[]()")))


def file_unit(path: Path, what: str, mapped: str | None, given: str | None) -> str | None:
    """Return the unit of the numbers in a column; None if neither file nor mapping states a unit.

    The mapping wins over a word of the file that is no unit, or is one of several.

    Raises
    ------
    DataError
        When file and mapping give different units.
    """
    mapped, given = (None if unit is None else written_unit(unit) for unit in (mapped, given))
    if mapped is None or given is None or mapped == given or not is_unit(given) or is_ambiguous(given):
        return given if mapped is None else mapped
    try:
        same = math.isclose(conversion_factor(given, mapped), 1.0, rel_tol=1e-9)
    except UsageError:
        same = False
    if not same:
        raise DataError(f"{path}: {what}: the header says {given!r}, the mapping {mapped!r}; correct one of them")
    return mapped


def unit_factor(path: Path, what: str, unit: str, target: str) -> float:
    """Return the conversion factor from one unit to another.

    Raises
    ------
    UsageError
        When the units measure different quantities; the text names file and column.
    """
    try:
        return conversion_factor(unit, target)
    except UsageError as error:
        raise UsageError(f"{path}: {what}: {error}") from None


_INDEXED = re.compile(r"(?P<name>.+)\[\s*(?P<index>\d+)\s*\]")
_NAME_UNIT = re.compile(r"(?P<name>.*?)\s*(?:\[(?P<square>[^][]*)\]|\((?P<round>[^()]*)\))")


class FileColumn(NamedTuple):
    """One column of a file, with unit and clock.

    Attributes
    ----------
    values : (n_samples,) array
        Numbers as in the file.
    unit : str or None
        Unit given by the file; None when the file gives none.
    sample_time : float or None
        Time between samples that the file states for this column [s]; None when it states none.
    remark : str
        What was left out of the file; empty where nothing was.
    first : int or None
        Number of the first sample of `values`, where the file was read in part.
    clock : int or None
        Number of the clock of the column, where a file has several; columns of one clock share their times.
    start_ns : int or None
        Time of the first sample of the whole column [ns], on a scale that all columns of the file share.
    unscaled : str
        Scale that the file states and that was not applied to the values, in words; empty where there is none.
    """

    values: FloatArray
    unit: str | None = None
    sample_time: float | None = None
    remark: str = ""
    first: int | None = None
    clock: int | None = None
    start_ns: int | None = None
    unscaled: str = ""


def split_reference(reference: str) -> tuple[str, int | None]:
    """Return name and column index of a reference like ``"noise[3]"``; the index is None without brackets."""
    match = _INDEXED.fullmatch(reference)
    return (match["name"], int(match["index"])) if match else (reference, None)


def pick_column(path: Path, reference: str, value: object, axis: int = 0, *, is_part: bool = False) -> FloatArray:
    """Return the column of a variable selected by a reference, shape (n_samples,).

    Parameters
    ----------
    path : path
        The file, for messages.
    reference : str
        ``"name"`` or ``"name[index]"``.
    value : object
        The variable of that name.
    axis : int
        Axis of time where it has two dimensions, which must not be the shorter one.
    is_part : bool
        Whether these are some of its samples only.

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
    if axis and value.ndim == 2:
        value, shape = value.T, shape[::-1]
    if index is None:
        if value.ndim == 2 and shape[1] != 1:
            raise DataError(f"{where} {name} has shape {shape}; name one of its columns, e.g. {name}[0]")
        return np.asarray(value, dtype=float).reshape(-1)
    if value.ndim == 1:
        raise DataError(f"{where} {name} has one dimension; leave the index out: {name}")
    if shape[0] < shape[1] and not is_part:
        raise DataError(
            f"{where} {name}: {shape[0]} samples of {shape[1]} channels along axis {axis}; fewer samples than "
            f"channels: give axis: {1 - axis} if the channels lie along axis {1 - axis}"
        )
    if index >= shape[1]:
        raise DataError(f"{where} {name} has shape {shape}; columns count from 0 to {shape[1] - 1}")
    return np.array(value[:, index], dtype=float)


TIME_WORDS = {"t", "time", "zeit", "tempo", "temps", "tiempo", "timestamp", "zeitstempel", "sekunden", "seconds"}
"""Words in names of columns of sample times."""
_CAMEL = re.compile(r"(?<=[a-zäöüß])(?=[A-ZÄÖÜ])")


def words_of(name: str) -> list[str]:
    """Return the words and numbers in a column name, in lower case."""
    return re.findall(r"[^\W\d_]+|\d+", _CAMEL.sub(" ", name).lower())


def name_and_unit(heading: str) -> tuple[str, str | None]:
    """Return name and unit of a heading like ``u_x [um]`` or ``u_x (um)``; the unit is None without brackets.

    ``Y[0]`` is a name with an index; ``ratio [1]`` has the unit 1.
    """
    match = _NAME_UNIT.fullmatch(heading)
    if not match or _INDEXED.fullmatch(heading.replace(" [", "(")):
        return heading, None
    return match["name"], written_unit(match["square"] if match["square"] is not None else match["round"])


def numbered_twins(headings: Sequence[str]) -> tuple[str, ...]:
    """Return the headings; repeated ones become ``Time #1``, ``Time #2``, without their unit."""
    count, seen = Counter(headings), Counter[str]()
    names = []
    for heading in headings:
        seen[heading] += 1
        is_twin = heading and count[heading] > 1
        names.append(f"{name_and_unit(heading)[0]} #{seen[heading]}" if is_twin else heading)
    return tuple(names)


def short_names(headings: Sequence[str]) -> list[str]:
    """Return the headings without units, unless several columns would get one name."""
    names = [name_and_unit(heading)[0] for heading in headings]
    count = Counter(names)
    return [name if count[name] == 1 else heading for name, heading in zip(names, headings, strict=True)]


def find_heading(path: Path, headings: Sequence[str], reference: str) -> int:
    """Return the index of a column, given by its full heading or by its name without unit.

    Raises
    ------
    DataError
        When there is no such column, or when several have this name.
    """
    if reference in headings:
        return headings.index(reference)
    names = [name_and_unit(heading)[0] for heading in headings]
    indices = [i for i, name in enumerate(names) if name == reference]
    if len(indices) > 1:
        cells = ", ".join(repr(headings[i]) for i in indices)
        raise DataError(f"{path}: column {reference!r} may be any of {cells}; give the whole heading")
    if not indices:
        raise DataError(f"{path}: no column {reference!r}; {nearest(reference, [n for n in names if n])}")
    return indices[0]


def seconds(times: np.ndarray[Any, Any]) -> FloatArray:
    """Return durations (numpy.timedelta64) in seconds, and dates (numpy.datetime64) in seconds since the first."""
    if times.dtype.kind == "M":
        known = times[~np.isnat(times)]
        times = times - (known[0] if known.size else np.datetime64(0, "s"))
    return np.asarray(times / np.timedelta64(1, "s"), dtype=float)


def twin_name(heading: str) -> str:
    """Return the name in a numbered heading such as ``Time #2``; empty for other headings."""
    match = re.fullmatch(r"(.+) #\d+", heading)
    return match[1] if match else ""
