"""Reader of csv files: tables in text files with names, and often units, above the numbers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from gbid.core.arrays import FloatArray
from gbid.core.errors import DataError
from gbid.recording.mapping import TextOptions
from gbid.recording.readers import FileChannel, FileFormat, with_values
from gbid.recording.text_files import FileColumn, TextTable, find_heading, name_and_unit, read_table

SHOWN_FIRST = 200
"""Number of first rows that are read to judge a file."""


def read_csv(path: Path, references: Sequence[str], options: TextOptions | None = None) -> dict[str, FileColumn]:
    """Return the named columns of a csv file.

    Encoding, delimiter, decimal sign and the lines of names and units are found in the file, or given. A cell such as
    ``u_x [um]`` or ``u_x (um)`` gives name and unit. A column can be named with or without its unit.

    Raises
    ------
    DataError
        When the file is not text, when it has no header line or rows of different length, when a column is
        missing or occurs twice, or when a cell of a requested column is not a number.
    """
    return _columns(read_table(path, options), references)


def peek_csv(
    path: Path, references: Sequence[str], options: TextOptions | None = None
) -> tuple[int, dict[str, FileColumn]]:
    """Return the number of rows of a csv file, and its columns in the first rows and the last one only.

    Returns
    -------
    int
        Number of rows.
    dict of str to FileColumn
        The values of each requested column.

    Raises
    ------
    DataError
        As for `read_csv`, as far as these rows show it.
    """
    table = read_table(path, options)
    if len(table.rows) < 2:
        raise DataError(f"{path}: expected a header line and rows of numbers, found one row; record longer")
    ends = replace(table, rows=(*table.rows[: min(SHOWN_FIRST, len(table.rows) - 1)], table.rows[-1]))
    return len(table.rows), _columns(ends, references)


def csv_channels(path: Path, options: TextOptions | None = None) -> list[FileChannel]:
    """Return the columns of a csv file, with their units and first numbers.

    Raises
    ------
    DataError
        When the file is not text, or when it has no header line or no rows.
    """
    table = read_table(path, options)
    names = [name_and_unit(heading)[0] for heading in table.headings]
    channels = []
    for i, (heading, values) in enumerate(zip(table.headings, _listed(table), strict=True)):
        channel = FileChannel(names[i] if names.count(names[i]) == 1 else heading, len(table.rows), table.units[i])
        if values is None:
            channels.append(replace(channel, remark="not all cells are numbers"))
        else:
            channels.append(with_values(channel, values))
    return channels


def _listed(table: TextTable) -> list[FloatArray | None]:
    """Return each column as numbers; None where not all cells are numbers."""
    try:
        return list(table.columns(range(len(table.headings))).T)
    except DataError:
        _ = table.cells  # a damaged row is an error, a column of text is none
    found: list[FloatArray | None] = []
    for i in range(len(table.headings)):
        try:
            found.append(table.columns([i])[:, 0])
        except DataError:
            found.append(None)
    return found


def csv_layout(path: Path, options: TextOptions | None = None) -> dict[str, Any]:
    """Return the layout of a csv file as it is given or found, as plain values."""
    return read_table(path, options).layout.stated()


def _columns(table: TextTable, references: Sequence[str]) -> dict[str, FileColumn]:
    indices = [find_heading(table.path, table.headings, reference) for reference in references]
    values = table.columns(indices) if indices else np.zeros((len(table.rows), 0))
    return {
        reference: FileColumn(np.ascontiguousarray(values[:, k]), table.units[i])
        for k, (reference, i) in enumerate(zip(references, indices, strict=True))
    }


FORMAT = FileFormat((".csv",), read_csv, csv_channels, peek_csv, layout=csv_layout)
