"""Tables in text files: encoding, delimiter, decimal sign, header, units, and columns of numbers."""

from __future__ import annotations

import codecs
import csv
import math
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from gbid.core.apart import usable_memory
from gbid.core.arrays import FloatArray
from gbid.core.errors import DataError, UsageError, nearest
from gbid.core.files import refuse_special
from gbid.core.tables import file_size
from gbid.core.units import conversion_factor, is_unit
from gbid.recording.mapping import DECIMALS, DELIMITERS, TextOptions

_MARKS = ((codecs.BOM_UTF8, "utf-8-sig"), (codecs.BOM_UTF16_LE, "utf-16"), (codecs.BOM_UTF16_BE, "utf-16"))
_CONTROL = frozenset(map(chr, range(32))) - set("\t\n\r\x0b\x0c\x1a")  # characters that no text has


_END = 1 << 20  # bytes that are read at each end of a file that is only looked at
_BLOCK = 1 << 24
_MEMORY_PER_BYTE = 9  # of a file that is read as a whole: text, lines, numbers; 8.4 with 26 bytes a row


class FileText(NamedTuple):
    """Text of a file.

    Attributes
    ----------
    text : str
        The text, or both its ends.
    encoding : str
        Its encoding.
    gap_after : int
        Number of the line after which lines were left out; 0 where none were.
    lines_left_out, rows_left_out : int
        Their number, and how many are neither empty nor comments.
    """

    text: str
    encoding: str
    gap_after: int = 0
    lines_left_out: int = 0
    rows_left_out: int = 0


def read_text(path: Path, encoding: str | None = None, *, ends: bool = False) -> FileText:
    """Return the text of a file.

    A byte order mark states the encoding. Without one it is UTF-16 when every other byte is zero, UTF-8 when the bytes
    are valid UTF-8, and otherwise cp1252, the encoding of Windows in western Europe.

    Parameters
    ----------
    path : pathlib.Path
        The file.
    encoding : str, optional
        The encoding when it is known.
    ends : bool
        Whether the first and the last megabyte are enough. Of UTF-16 all is read.

    Raises
    ------
    DataError
        When the bytes are not text in this encoding, or not text at all, when the path is that of a device or a pipe,
        or when the file needs more memory than there is.
    OSError
        When the file cannot be read.
    """
    refuse_special(path)
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(_END)
        head = head[: head.rfind(b"\n") + 1]
        if ends and size > 2 * _END and head and not _is_wide(encoding or _encoding(head)):
            file.seek(size - _END)
            file.readline()  # the rest of a line
            end, tail = file.tell(), file.read()
            codec = encoding or _encoding(head + tail)
            file.seek(len(head))
            first = _decoded(path, head, codec)
            return FileText(first + _decoded(path, tail, codec), codec, first.count("\n"), *_count_lines(file, end))
    if size * _MEMORY_PER_BYTE > usable_memory():
        raise DataError(
            f"{path}: {file_size(size)} of text take {file_size(size * _MEMORY_PER_BYTE)} of memory, of which this "
            f"process can use {file_size(usable_memory())}; cut it into several files, or save it as Parquet or HDF5"
        )
    data = path.read_bytes()
    codec = encoding or _encoding(data)
    return FileText(_decoded(path, data, codec), codec)


def _is_wide(codec: str) -> bool:
    return codec.lower().replace("_", "-").startswith(("utf-16", "utf-32", "u16", "u32"))


def _count_lines(file: BinaryIO, end: int) -> tuple[int, int]:
    """Return the number of lines from here to a place, and of those that are neither empty nor comments."""
    lines = rows = 0
    while (left := end - file.tell()) > 0:
        block = file.read(min(_BLOCK, left))
        block += file.readline() if not block.endswith(b"\n") else b""
        count = block.count(b"\n")
        others = (b"\n\n", b"\n\r\n", *(b"\n" + mark.encode() for mark in COMMENTS))
        lines, rows = lines + count, rows + count - sum((b"\n" + block).count(other) for other in others)
    return lines, rows


def _decoded(path: Path, data: bytes, codec: str) -> str:
    try:
        text = data.decode(codec)
    except UnicodeDecodeError as error:
        raise DataError(
            f"{path}: not text in {codec} (byte {error.start}): give its encoding (encoding: ...), or export it as csv "
            "in UTF-8"
        ) from None
    strange = _CONTROL.intersection(text[:100_000])
    if strange:
        raise DataError(
            f"{path}: not a text file in {codec}: it holds the character {min(strange)!r}; give its encoding "
            "(encoding: ...), or export it as csv"
        )
    return text.replace("\r\n", "\n").replace("\r", "\n").rstrip("\x1a")


def _encoding(data: bytes) -> str:
    for mark, name in _MARKS:
        if data.startswith(mark):
            return name
    head = data[:2000]
    if len(head) > 3 and not any(head[1::2]):
        return "utf-16-le"
    if len(head) > 3 and not any(head[::2]):
        return "utf-16-be"
    try:
        data.decode("utf-8")
    except UnicodeDecodeError:
        return "cp1252"
    return "utf-8"


# ---- Units of the columns of a file: what file and mapping say about them, and their factors.

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
    """Return the spelling of gbid for a unit that a file states, e.g. ``um`` for ``µm``."""
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


# ---- Layout of a table in a text file: delimiter, decimal sign, the lines of names and units, and the first row.

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
    """Line of a text file and its number, counted from 1."""

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
    try:
        cells = next(csv.reader([text], delimiter=delimiter, skipinitialspace=True), [])
    except csv.Error:  # a cell longer than the reader takes; `TextTable.cells` names its line
        cells = text.split(delimiter)
    return [cell.strip() for cell in cells]


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
        numeric = len(self.numeric)
        self.rank = (bool(numeric), alike >= _MOST * len(tail), numeric - others if numeric else self.count, numbers)

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


# ---- Columns of a file: their values and units, their names, and the notation ``name[3]`` for one column of an array.

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
    remark : str
        What was left out of the file; empty where nothing was.
    """

    values: FloatArray
    unit: str | None = None
    sample_time: float | None = None
    remark: str = ""


def split_reference(reference: str) -> tuple[str, int | None]:
    """Return the name and the column index of a reference like ``"noise[3]"``; without brackets the index is None."""
    match = _INDEXED.fullmatch(reference)
    return (match["name"], int(match["index"])) if match else (reference, None)


def pick_column(path: Path, reference: str, value: object) -> FloatArray:
    """Return the column of a variable that a reference names, shape (n_samples,).

    Parameters
    ----------
    path : path
        The file, for messages.
    reference : str
        ``"name"`` or ``"name[index]"``.
    value : object
        The variable of that name. Arrays are never transposed.

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
        if value.ndim == 2 and shape[1] != 1:
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


def short_names(headings: Sequence[str]) -> list[str]:
    """Return the headings without their units, except where several columns would have one name."""
    names = [name_and_unit(heading)[0] for heading in headings]
    return [name if names.count(name) == 1 else heading for name, heading in zip(names, headings, strict=True)]


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
    indices = [i for i, name in enumerate(names) if name == reference]
    if len(indices) > 1:
        cells = ", ".join(repr(headings[i]) for i in indices)
        raise DataError(f"{path}: column {reference!r} may be any of {cells}; give the whole heading")
    if not indices:
        raise DataError(f"{path}: no column {reference!r}; {nearest(reference, [n for n in names if n])}")
    return indices[0]


def seconds(times: np.ndarray[Any, Any]) -> FloatArray:
    """Return durations (numpy.timedelta64) in seconds, and dates (numpy.datetime64) in seconds from the first."""
    if times.dtype.kind == "M" and times.size:
        times = times - times.flat[0]
    return np.asarray(times / np.timedelta64(1, "s"), dtype=float)


# ---- Table in a text file: its headings, its units, and its columns as numbers.


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
    is_cut : bool
        Whether the last row has all its cells, but is the only line without line break: if the file was cut there, its
        last number is a part of one.
    n_first, n_left_out : int
        Of a file whose ends were read: number of rows in the first part, and of rows between it and the second one.
    """

    path: Path
    layout: TextLayout
    headings: tuple[str, ...]
    units: tuple[str | None, ...]
    rows: tuple[NumberedLine, ...]
    is_cut: bool = False
    n_first: int = 0
    n_left_out: int = 0

    @cached_property
    def cells(self) -> list[list[str]]:
        """Cells of the rows.

        Raises
        ------
        DataError
            When a row is not readable, or has another number of cells than there are headings.
        """
        if self.layout.delimiter == " ":
            rows = [line.text.split() for line in self.rows]
        else:
            lines, delimiter = (line.text for line in self.rows), self.layout.delimiter
            reader = csv.reader(lines, delimiter=delimiter, skipinitialspace=True, strict=True)
            try:
                rows = list(reader)
            except csv.Error as error:
                number = self.rows[reader.line_num - 1].number
                raise DataError(f"{self.path}: line {number}: not readable as csv: {error}") from None
        n = len(self.headings)
        for i, (line, row) in enumerate(zip(self.rows, rows, strict=False)):
            if len(row) == n + 1 and not row[-1].strip():
                rows[i] = row[:-1]
            elif len(row) != n:
                raise DataError(
                    f"{self.path}: line {line.number} has {len(row)} cells, the header line has {n}; is the file "
                    "truncated, or the delimiter another one?"
                )
        return rows

    def columns(self, indices: Sequence[int]) -> FloatArray:
        """Return columns as numbers, (n_rows, n_columns).

        Raises
        ------
        DataError
            As for `cells`; also when a cell is neither a number nor empty; an empty one is a missing sample, NaN.
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
            if cell.strip() and not is_number(cell, decimal):
                raise self._not_a_number(line, index, cell)
        cells = (cell.replace(decimal, ".").lower().replace("d", "e") if cell.strip() else "nan" for cell in column)
        return np.array([float(cell) for cell in cells])

    def _not_a_number(self, line: NumberedLine, index: int, cell: str) -> DataError:
        where = f"{self.path}: line {line.number}, column {self.headings[index]!r}:"
        other = "," if self.layout.decimal == "." else "."
        hint = f"; the decimal sign is {self.layout.decimal!r} here (decimal: ...)" if is_number(cell, other) else ""
        return DataError(f"{where} {cell!r} is not a number{hint}")


def read_table(path: Path, options: TextOptions | None = None, *, ends: bool = False) -> TextTable:
    """Return the table in a text file, with its layout as given or as found; of a large file the ends if asked for.

    Raises
    ------
    DataError
        When the file is not text, when it has no line with names or no rows, or when a name occurs twice.
    OSError
        When the file cannot be read.
    """
    options = options or TextOptions()
    text, encoding, gap_after, lines_left_out, rows_left_out = read_text(path, options.encoding, ends=ends)
    numbered = enumerate(text.split("\n"), start=1)
    lines = [NumberedLine(i + lines_left_out * (i > gap_after), line) for i, line in numbered if line.strip()]
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
    is_open = len(rows) > 1 and not text.endswith("\n") and rows[-1] == lines[-1]
    is_cut = is_open and len(split_cells(rows[-1].text, layout.delimiter)) >= len(headings)  # fewer cells are an error
    n_first = sum(line.number <= gap_after for line in rows) if gap_after else len(rows)
    return TextTable(path, layout, tuple(headings), tuple(units), rows, is_cut, n_first, rows_left_out)
