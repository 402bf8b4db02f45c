"""Layout of a table in a text file: delimiter, decimal sign, the lines of names and units, and the first row."""

from __future__ import annotations

import csv
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from gbid.recording.importers.file_units import is_file_unit
from gbid.recording.importers.text.text_options import DECIMALS, DELIMITERS, TextOptions

COMMENTS = ("#", "%", "//")
"""Beginnings of lines that are comments."""
_TAIL, _SPREAD = 20, 300  # lines at the end that show the columns; lines over the whole file that show the decimal sign
_DESCRIBED = 4  # largest number of lines below the names within which a line of units is looked for
_MOST = 0.75  # share of the cells of a column that are numbers, where the column is one of numbers
_DIGITS = {  # digits are not given back (++): else a long cell that is no number takes the square of its length
    ".": re.compile(r"[-+]?(?:\d++\.?\d*+|\.\d++)(?:[eEdD][-+]?\d++)?|[-+]?(?:nan|inf|infinity)", re.IGNORECASE),
    ",": re.compile(r"[-+]?(?:\d++,?\d*+|,\d++)(?:[eEdD][-+]?\d++)?|[-+]?(?:nan|inf|infinity)", re.IGNORECASE),
}


class NumberedLine(NamedTuple):
    """NumberedLine of a file with its number, counted from 1."""

    number: int
    text: str


@dataclass(frozen=True)
class TextLayout:
    """Layout of a table in a text file.

    Attributes
    ----------
    encoding : str
        Encoding of the file.
    delimiter : str
        Character between the cells; a blank stands for any number of blanks.
    decimal : str
        Decimal sign.
    header : NumberedLine or None
        NumberedLine with the names; None when there is none.
    unit_line : NumberedLine or None
        NumberedLine with the units below it.
    rows_from : int
        Number of the line of the first row.
    """

    encoding: str
    delimiter: str
    decimal: str
    header: NumberedLine | None
    unit_line: NumberedLine | None
    rows_from: int

    def stated(self) -> dict[str, str | int | None]:
        """Return the layout as plain values."""
        return {
            "encoding": self.encoding,
            "delimiter": self.delimiter,
            "decimal": self.decimal,
            "header_line": self.header.number if self.header else None,
            "unit_line": self.unit_line.number if self.unit_line else None,
            "first_row_in_line": self.rows_from,
        }


def is_comment(text: str) -> bool:
    """Return whether a line is a comment."""
    return text.lstrip().startswith(COMMENTS)


def is_number(cell: str, decimal: str) -> bool:
    """Return whether a cell is a number with this decimal sign."""
    return bool(_DIGITS[decimal].fullmatch(cell.strip()))


def split_cells(text: str, delimiter: str) -> list[str]:
    """Return the cells of one line, without blanks around them."""
    if delimiter == " ":
        return text.split()
    return [cell.strip() for cell in next(csv.reader([text], delimiter=delimiter, skipinitialspace=True), [])]


def find_layout(lines: Sequence[NumberedLine], encoding: str, options: TextOptions) -> TextLayout:
    """Return the layout of a table.

    The last lines show the columns: delimiter and decimal sign are those that give the most columns of numbers, beside
    the fewest others. The rows begin at the first line with such numbers. The names are in the first complete line of
    text directly above, or in a comment above when no other line has them. A line of units may follow the names.

    Parameters
    ----------
    lines : sequence of NumberedLine
        Lines that are not empty, comments included.
    encoding : str
        Encoding of the file.
    options : TextOptions
        What is known of the layout.
    """
    content = [line for line in lines if not is_comment(line.text)]
    pairs = [
        (delimiter, decimal)
        for delimiter in ([options.delimiter] if options.delimiter else DELIMITERS)
        for decimal in ([options.decimal] if options.decimal else DECIMALS)
    ]
    tried = sorted((_Candidate(content, *pair) for pair in pairs), key=lambda each: each.rank, reverse=True)
    sensible = [columns for columns in tried if columns.numeric] or tried[:1]
    layouts = (_with_header(columns, lines, content, encoding, options) for columns in sensible)
    return next((each for each in layouts if each.header), _with_header(tried[0], lines, content, encoding, options))


class _Candidate:
    """Columns of a table as one delimiter and one decimal sign show them."""

    def __init__(self, content: Sequence[NumberedLine], delimiter: str, decimal: str) -> None:
        self.delimiter, self.decimal = delimiter, decimal
        last = max(2, min(_TAIL, len(content) // 3))
        tail = [split_cells(line.text, delimiter) for line in content[1:][-last:] or content]
        self.count, alike = Counter(len(row) for row in tail).most_common(1)[0] if tail else (0, 0)
        rows = [row for row in tail if len(row) == self.count]
        self.numeric = [i for i in range(self.count) if self._is_numeric([row[i] for row in rows])]
        self.open_end = bool(rows) and self.count > 1 and not any(row[-1] for row in rows)
        others = sum(any(row[i] for row in rows) for i in range(self.count)) - len(self.numeric)
        spread = content[1 :: max(1, len(content) // _SPREAD)]
        numbers = sum(is_number(cell, decimal) for line in spread for cell in split_cells(line.text, delimiter))
        found = len(self.numeric)
        self.rank = (bool(found), alike >= _MOST * len(tail), found - others if found else self.count, numbers)

    def _is_numeric(self, cells: list[str]) -> bool:
        filled = [cell for cell in cells if cell]
        return bool(filled) and sum(is_number(c, self.decimal) for c in filled) >= _MOST * len(filled)

    def cells(self, text: str) -> list[str] | None:
        """Return the cells of a line, without an empty last one when all rows have it; None for another number."""
        row = split_cells(text, self.delimiter)
        if self.open_end and len(row) == self.count and not row[-1]:
            row = row[:-1]
        return row if len(row) == self.count - self.open_end else None

    def is_row(self, text: str) -> bool:
        """Return whether a line has numbers in the columns of numbers."""
        row = self.cells(text)
        if row is None or not self.numeric:
            return False
        filled = [row[i] for i in self.numeric if row[i]]
        return bool(filled) and all(is_number(cell, self.decimal) for cell in filled)

    def is_names(self, text: str) -> bool:
        """Return whether a line may hold the names of the columns."""
        row = self.cells(text)
        return row is not None and all(row) and not any(is_number(cell, self.decimal) for cell in row)

    def is_units(self, text: str) -> bool:
        """Return whether a line may hold the units of the columns."""
        row = self.cells(text)
        return row is not None and any(row) and all(is_file_unit(cell) for cell in row)


def _with_header(
    columns: _Candidate,
    lines: Sequence[NumberedLine],
    content: Sequence[NumberedLine],
    encoding: str,
    options: TextOptions,
) -> TextLayout:
    def layout(header: NumberedLine | None, unit_line: NumberedLine | None, rows_from: int) -> TextLayout:
        return TextLayout(encoding, columns.delimiter, columns.decimal, header, unit_line, rows_from)

    first = next((i for i, line in enumerate(content) if columns.is_row(line.text)), len(content))
    if options.header_line is not None:
        header = next((line for line in lines if line.number == options.header_line), None)
        return layout(header, *_below(columns, [line for line in content if line.number > options.header_line]))
    start = first
    while start > 0 and columns.cells(content[start - 1].text) is not None:
        start -= 1
    at = next((i for i in range(start, first) if columns.is_names(content[i].text)), None)
    if at is not None:
        return layout(content[at], *_below(columns, content[at + 1 :]))
    rows_from = content[first].number if first < len(content) else 0
    above = [line for line in lines if line.number < rows_from and is_comment(line.text)]
    header = next((line for line in reversed(above) if columns.is_names(without_mark(line.text))), None)
    return layout(header, None, rows_from)


def without_mark(text: str) -> str:
    """Return the text of a line without the mark of a comment."""
    text = text.lstrip()
    return text.lstrip("#%/").lstrip() if is_comment(text) else text


def _below(columns: _Candidate, below: Sequence[NumberedLine]) -> tuple[NumberedLine | None, int]:
    """Return the line of units, which may follow the names and their descriptions, and the number of the first row."""
    for i, line in enumerate(below[:_DESCRIBED]):
        if columns.is_row(line.text):
            break
        if columns.is_units(line.text):
            return line, below[i + 1].number if i + 1 < len(below) else 0
    return None, below[0].number if below else 0
