"""Table in a text file: its headings, its units, and its columns as numbers."""

from __future__ import annotations

import csv
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from gbid.arrays import FloatArray
from gbid.errors import DataError
from gbid.recording.importers.columns import name_and_unit
from gbid.recording.importers.file_units import written_unit
from gbid.recording.importers.text.decoding import read_text
from gbid.recording.importers.text.text_layout import (
    NumberedLine,
    TextLayout,
    find_layout,
    is_comment,
    is_number,
    split_cells,
    without_mark,
)
from gbid.recording.importers.text.text_options import TextOptions


@dataclass(frozen=True)
class TextTable:
    """Table in a text file.

    Attributes
    ----------
    path : pathlib.Path
        The file, for messages.
    layout : TextLayout
        Layout, found or given.
    headings : tuple of str
        Names of the columns as they stand in the file.
    units : tuple of (str or None)
        Unit of each column, from its heading or from the line of units.
    rows : tuple of NumberedLine
        Lines of the rows.
    """

    path: Path
    layout: TextLayout
    headings: tuple[str, ...]
    units: tuple[str | None, ...]
    rows: tuple[NumberedLine, ...]

    @cached_property
    def cells(self) -> list[list[str]]:
        """Cells of the rows.

        Raises
        ------
        DataError
            When a row is not readable, or has another number of cells than there are headings.
        """
        if self.layout.delimiter == " ":
            found = [line.text.split() for line in self.rows]
        else:
            lines, delimiter = (line.text for line in self.rows), self.layout.delimiter
            reader = csv.reader(lines, delimiter=delimiter, skipinitialspace=True, strict=True)
            try:
                found = list(reader)
            except csv.Error as error:
                number = self.rows[reader.line_num - 1].number
                raise DataError(f"{self.path}: line {number}: not readable as csv: {error}") from None
        n = len(self.headings)
        for i, (line, row) in enumerate(zip(self.rows, found, strict=False)):
            if len(row) == n + 1 and not row[-1].strip():
                found[i] = row[:-1]
            elif len(row) != n:
                raise DataError(
                    f"{self.path}: line {line.number} has {len(row)} cells, the header line has {n}; is the file "
                    "truncated, or the delimiter another one?"
                )
        return found

    def columns(self, indices: Sequence[int]) -> FloatArray:
        """Return columns as numbers, (n_rows, n_columns).

        Raises
        ------
        DataError
            As for `cells`; also when a cell is not a number.
        """
        fast = self._fast(indices)
        return np.column_stack([self._numbers(i) for i in indices]) if fast is None else fast

    def _fast(self, indices: Sequence[int]) -> FloatArray | None:
        """Return the columns by numpy's reader; None where the rows need a closer look."""
        delimiter, lines = self.layout.delimiter, [line.text for line in self.rows]
        if delimiter == " " or any('"' in line for line in lines) or self.layout.decimal == delimiter:
            return None
        between = {line.count(delimiter) for line in lines}
        if between != {len(self.headings) - 1}:
            return None
        if self.layout.decimal == ",":
            if any("." in line for line in lines):  # a date, a point for thousands, or a mistake
                return None
            lines = "\n".join(lines).replace(",", ".").split("\n")
        try:
            return np.loadtxt(lines, delimiter=delimiter, comments=None, usecols=list(indices), ndmin=2)
        except ValueError:
            return None

    def _numbers(self, index: int) -> FloatArray:
        decimal, column = self.layout.decimal, [row[index] for row in self.cells]
        for line, cell in zip(self.rows, column, strict=False):
            if not is_number(cell, decimal):
                raise self._not_a_number(line, index, cell)
        return np.array([float(cell.replace(decimal, ".").lower().replace("d", "e")) for cell in column])

    def _not_a_number(self, line: NumberedLine, index: int, cell: str) -> DataError:
        where = f"{self.path}: line {line.number}, column {self.headings[index]!r}:"
        if not cell.strip():
            return DataError(f"{where} the cell is empty; leave those samples out or repair them")
        other = "," if self.layout.decimal == "." else "."
        hint = f"; the decimal sign is {self.layout.decimal!r} here (decimal: ...)" if is_number(cell, other) else ""
        return DataError(f"{where} {cell!r} is not a number{hint}")


def read_table(path: Path, options: TextOptions | None = None) -> TextTable:
    """Return the table in a text file, with its layout as given or as found.

    Raises
    ------
    DataError
        When the file is not text, when it has no line with names or no rows, or when a name occurs twice.
    OSError
        When the file cannot be read.
    """
    options = options or TextOptions()
    text, encoding = read_text(path, options.encoding)
    lines = [NumberedLine(i, line) for i, line in enumerate(text.split("\n"), start=1) if line.strip()]
    layout = find_layout(lines, encoding, options)
    rows = tuple(q for q in lines if q.number >= layout.rows_from > 0 and not is_comment(q.text))
    if layout.header is None and options.header_line is not None:
        raise DataError(f"{path}: header_line: line {options.header_line} is empty or beyond the end of the file")
    if layout.header is None and rows:
        raise DataError(
            f"{path}: no header line: no line above the numbers has a name for each column; add a line with the "
            "column names, or name it with header_line"
        )
    if layout.header is None or not rows:
        count = sum(not is_comment(line.text) for line in lines)
        raise DataError(f"{path}: expected a header line and rows of numbers, found {count} lines")
    headings = split_cells(without_mark(layout.header.text), layout.delimiter)
    if headings and not headings[-1]:
        headings = headings[:-1]  # a delimiter at the end of the line
    twice = [name for name, count in Counter(headings).items() if name and count > 1]
    if twice:
        raise DataError(f"{path}: the header line has column {twice[0]!r} more than once; rename one")
    below = split_cells(layout.unit_line.text, layout.delimiter) if layout.unit_line else []
    units: list[str | None] = [name_and_unit(heading)[1] for heading in headings]
    for i, cell in enumerate(below[: len(headings)]):
        if units[i] is None and cell:
            units[i] = written_unit(cell.strip("[]() "))
    return TextTable(path, layout, tuple(headings), tuple(units), rows)
