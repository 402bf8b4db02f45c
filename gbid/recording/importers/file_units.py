"""Units of the columns of a file: what file and mapping say about them, and their factors."""

from __future__ import annotations

import math
from pathlib import Path

from gbid.errors import DataError, UsageError
from gbid.units import conversion_factor, is_unit

_OTHER_WORDS = {
    "Grad": "deg",  # pint reads it as gigaradian
    "grd": "deg",
    "U/min": "rpm",
    "min^-1": "rpm",
    "1/min": "rpm",
    "Sek": "s",
    "Sek.": "s",
    "sec": "s",
    "-": "",
}
"""Words for units in files of loggers, and how gbid writes them."""


def written_unit(word: str) -> str:
    """Return a unit of a file as gbid writes it."""
    word = word.strip()
    return _OTHER_WORDS.get(word, word)


def is_file_unit(cell: str) -> bool:
    """Return whether a cell of a file may be a unit, alone or in brackets."""
    return is_unit(written_unit(cell.strip().strip("[]()")))


def file_unit(path: Path, what: str, mapped: str | None, given: str | None) -> str | None:
    """Return the unit of the numbers in the file; None when neither file nor mapping gives one.

    Raises
    ------
    DataError
        When file and mapping give different units.
    """
    if mapped is None or given is None or mapped == given:
        return given if mapped is None else mapped
    try:
        same = math.isclose(conversion_factor(given, mapped), 1.0, rel_tol=1e-9)
    except UsageError:
        same = False
    if not same:
        raise DataError(f"{path}: {what}: the header says {given!r}, the mapping {mapped!r}; correct one of them")
    return mapped


def unit_factor(path: Path, what: str, unit: str, target: str) -> float:
    """Return the factor from one unit to another.

    Raises
    ------
    UsageError
        When the units measure different quantities; the text names file and column.
    """
    try:
        return conversion_factor(unit, target)
    except UsageError as error:
        raise UsageError(f"{path}: {what}: {error}") from None
