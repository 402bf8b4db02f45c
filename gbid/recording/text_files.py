"""Tables in text files: encoding, delimiter, decimal sign, header, units, and numeric columns."""

from __future__ import annotations

import codecs
import contextlib
import csv
import mmap
import os
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import zip_longest
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np

from gbid.core.apart import usable_memory
from gbid.core.arrays import FloatArray
from gbid.core.errors import DataError, UsageError
from gbid.core.files import refuse_special
from gbid.core.tables import file_size
from gbid.core.units import conversion_factor
from gbid.recording.clock import MAX_RESAMPLED, even_step
from gbid.recording.columns import (
    TIME_WORDS,
    find_heading,
    is_file_unit,
    name_and_unit,
    numbered_twins,
    twin_name,
    words_of,
    written_unit,
)
from gbid.recording.mapping import DECIMALS, DELIMITERS, TextOptions
from gbid.recording.stamps import StampError, date_of, is_stamp, times_of_day

_MARKS = ((codecs.BOM_UTF8, "utf-8-sig"), (codecs.BOM_UTF16_LE, "utf-16"), (codecs.BOM_UTF16_BE, "utf-16"))
_CONTROL = frozenset(map(chr, range(32))) - set("\t\n\r\x0b\x0c\x1a")  # characters that no text has


_END = 1 << 20  # bytes that are read at each end of a file that is only looked at
_BLOCK = 1 << 24
_MEMORY_PER_BYTE = 9  # of a file that is read as a whole: text, lines, numbers; 8.4 with 26 bytes a row


class FileText(NamedTuple):
    """Text of a file, with its encoding.

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


def holds_text(path: Path) -> bool:
    """Return whether a file is text, judged by its first bytes."""
    refuse_special(path)
    with path.open("rb") as file:
        head = file.read(_HEAD)
    text = head[: head.rfind(b"\n") + 1 or None].decode(_encoding(head), errors="replace")
    return not _CONTROL.intersection(text)


_HEAD = 1 << 16


def _is_wide(codec: str) -> bool:
    return codec.lower().replace("_", "-").startswith(("utf-16", "utf-32", "u16", "u32"))


def _count_lines(file: BinaryIO, end: int) -> tuple[int, int]:
    """Return the number of lines up to a position, and the number of lines that are neither empty nor comments."""
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
    if strange := _CONTROL.intersection(text[:100_000]):
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


COMMENTS = ("#", "%", "//")
"""Beginnings of lines that are comments."""
_TAIL, _SPREAD = 20, 300  # lines at the end that show the columns; lines over the whole file that show the decimal sign
_DESCRIBED = 40  # largest number of lines below the names within which a line of units is looked for
_BLOCK_LINES = 1000  # largest number of lines of a block above or below the names
_RULE = "***"  # beginning of a line that ends a block above the names: LabVIEW's ***End_of_Header***
_UNIT_WORDS = ("unit", "units", "einheit", "einheiten", "y_unit_label")  # what a line of units may begin with
_UNUSED = ("", "Comment")  # last heading of a column that rows do not have: LabVIEW's
_MOST = 0.75  # share of the cells of a column that are numbers, where the column is one of numbers
_DIGITS = {  # digits are not given back (++): else a long cell that is no number takes the square of its length
    ".": re.compile(r"[-+]?(?:\d++\.?\d*+|\.\d++)(?:[eEdD][-+]?\d++)?|[-+]?(?:nan|inf|infinity)", re.IGNORECASE),
    ",": re.compile(r"[-+]?(?:\d++,?\d*+|,\d++)(?:[eEdD][-+]?\d++)?|[-+]?(?:nan|inf|infinity)", re.IGNORECASE),
}

_GROUPED = {  # thousands signs: a point or comma, where it is not the decimal sign, an apostrophe, a narrow blank
    decimal: re.compile(
        rf"[-+]?\d{{1,3}}(?:(?P<sign>[{other}'’\u2009\u202f\xa0])\d{{3}})(?P<more>(?:(?P=sign)\d{{3}})*)"
        rf"(?P<part>\{decimal}\d*)?"
    )
    for decimal, other in ((".", ","), (",", "."))
}
_GROUPED_TWICE = re.compile(r"[-+]?[1-9]\d{0,2}[.,]\d{3}")  # a number of thousands, or of three decimals
_THOUSAND, _ROUNDING, _UNLIKELY = 1e3, 1e-6, 2  # more than two such numbers, and none of one or two decimals


class NumberedLine(NamedTuple):
    """Line of a text file with its number, counted from 1."""

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
    block : tuple of int
        Numbers of the first and the last line that were skipped between the names and the rows; empty for none.
    rows_to : int
        Number of the line of the last row, where a trailer follows; otherwise 0.
    is_decimal_given : bool
        Whether the decimal sign was given, and not found.
    segments : tuple of int
        Numbers of the lines at which the headers of further segments begin (LabVIEW), which are left out.
    """

    encoding: str
    delimiter: str
    decimal: str
    header: NumberedLine | None
    unit_line: NumberedLine | None
    rows_from: int
    block: tuple[int, ...] = ()
    rows_to: int = 0
    is_decimal_given: bool = False
    segments: tuple[int, ...] = ()

    def stated(self) -> dict[str, str | int | None]:
        """Return the layout options as plain values."""
        skipped = {"lines_skipped": " to ".join(map(str, self.block))} if self.block else {}
        return {
            "encoding": self.encoding,
            "delimiter": self.delimiter,
            "decimal": self.decimal,
            "header_line": self.header.number if self.header else None,
            "unit_line": self.unit_line.number if self.unit_line else None,
            "first_row_in_line": self.rows_from,
            **skipped,
            **({"last_row_in_line": self.rows_to} if self.rows_to else {}),
        }

    @property
    def remark(self) -> str:
        """Text on assumptions and skipped lines; empty for a plain file of names, units and rows."""
        parts = []
        if self.header is None:
            parts.append(f"no line has names: the columns are numbered, and line {self.rows_from} is the first row")
        if self.block:
            parts.append(f"{_lines_in_words(*self.block)} between names and numbers left out")
        if self.rows_to:
            parts.append(f"what follows line {self.rows_to} begins with a word and is left out")
        if self.segments:
            lines = ", ".join(map(str, self.segments))
            parts.append(
                f"{len(self.segments) + 1} segments; the headers of those after the first, lines {lines}, left out"
            )
        return "; ".join(parts)


def _lines_in_words(first: int, last: int) -> str:
    return f"line {first}" if first == last else f"lines {first} to {last}"


def is_comment(text: str) -> bool:
    """Return whether a line is a comment."""
    return text.lstrip().startswith(COMMENTS)


def is_number(cell: str, decimal: str) -> bool:
    """Return whether a cell is a number with a given decimal sign."""
    return bool(_DIGITS[decimal].fullmatch(cell.strip()))


def has_thousands(cell: str, decimal: str) -> bool:
    """Return whether a cell is certainly a number with thousands separators.

    ``1.234`` may be 1.234 or 1234, and is none. ``1.234,5``, ``1.234.567`` and ``1'234`` are.
    """
    match = _GROUPED[decimal].fullmatch(cell.strip())
    return match is not None and (match["sign"] not in ".," or bool(match["more"]) or bool(match["part"]))


def _is_value(cell: str, decimal: str) -> bool:
    return is_number(cell, decimal) or is_stamp(cell) or has_thousands(cell, decimal)


def split_cells(text: str, delimiter: str) -> list[str]:
    """Return the cells of a line, without surrounding blanks."""
    if delimiter == " ":
        return text.split()
    try:
        cells = next(csv.reader([text], delimiter=delimiter, skipinitialspace=True), [])
    except csv.Error:  # a cell longer than the reader takes; `TextTable.cells` names its line
        cells = text.split(delimiter)
    return [cell.strip() for cell in cells]


_OTHER_COMMENTS = "!;'*"  # signs that begin comments in some programs, and cells in others


def _with_comments(lines: list[NumberedLine]) -> list[NumberedLine]:
    """Return the lines with unusual comment marks at the top of the file replaced by ``#``."""
    sign = lines[0].text[:1] if lines else ""
    count = next((i for i, line in enumerate(lines) if not line.text.startswith(sign)), len(lines))
    if not sign or sign not in _OTHER_COMMENTS or count == len(lines):
        return lines
    top = [line.text.lstrip(sign) for line in lines[:count]]
    if any(line.text.startswith((sign, _RULE)) for line in lines[count:]) or lines[0].text.startswith(_RULE):
        return lines
    if any(sign in text and not text.startswith(" ") for text in top):  # a quoted name, or an empty first cell
        return lines
    return [NumberedLine(line.number, f"# {text}") for line, text in zip(lines, top, strict=False)] + lines[count:]


_COUNTED = re.compile(
    r"[#%/\s]*(?:n|no\.? of|num|number of|anzahl(?: der)?|nombre d(?:e |')|numero (?:di |de )|número de )?[\s_]*"
    r"(?:record length|samples|points|rows|records|messwerte|abtastwerte|werte|punkte|zeilen"
    r"|échantillons|mesures|points|lignes|campioni|punti|righe|muestras|puntos|filas)",
    re.IGNORECASE,
)
"""Words of a header before its number of rows."""


def _stated_count(lines: Sequence[NumberedLine]) -> tuple[NumberedLine, int] | None:
    """Return the header line that states the number of rows, and this number; None if not unique."""
    found = []
    for line in lines:
        key, *cells = (cell.strip(' "') for cell in re.split(r"[:=,;\t]", line.text))
        numbers = {cell for cell in cells if cell}
        if _COUNTED.fullmatch(key) and len(numbers) == 1 and (number := numbers.pop()).isdecimal():
            found.append((line, int(number)))
    return found[0] if len({count for _, count in found}) == 1 else None


def find_layout(lines: Sequence[NumberedLine], encoding: str, options: TextOptions) -> TextLayout:
    """Return the layout of a table, detected from its lines.

    The last lines that do not begin with a word show the columns: delimiter and decimal sign are those that give the
    most columns of numbers, beside the fewest others. The rows begin at the first line with such numbers. The names are
    in the first complete line of text directly above, else in the first complete line of text, else in a comment. A
    line of units, and a block of lines that are no rows, may follow the names. A file that begins with a row has no
    names.

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
    table = _without_trailer(content)
    tried = sorted((_Candidate(table, *pair) for pair in pairs), key=lambda each: each.rank, reverse=True)
    best = _with_header(tried[0], lines, content, encoding, options)
    if best.header is None and not (content and best.rows_from == content[0].number):
        others = (_with_header(each, lines, content, encoding, options) for each in tried[1:] if each.numeric)
        best = next((each for each in others if each.header), best)
    columns = next(each for each in tried if (each.delimiter, each.decimal) == (best.delimiter, best.decimal))
    end = next((line for line in reversed(content) if _is_number_like(line.text, columns)), None)
    if end is None or _begins_with_word(end.text) or not best.rows_from <= end.number < content[-1].number:
        return best  # where rows begin with a word, the last line may be a damaged one
    return replace(best, rows_to=end.number)


def _begins_with_word(text: str) -> bool:
    word = text.lstrip(" \t,;\"'*<[({=-")
    return word[:1].isalpha() and not _NO_VALUE.match(word)


_NO_VALUE = re.compile(
    r"(?:na?n?|n/a|inf(?:inity)?|null|none|invalid|error|fault|open|over(?:flow|range|load)?|ovf|ol)"
    r"[\"'\s]*(?:[,;\t ]|$)",
    re.IGNORECASE,
)  # what loggers write in place of a number, also where the file was cut within it


def _is_number_like(text: str, columns: _Candidate) -> bool:
    """Return whether a line is a row, or a possibly damaged row."""
    return not _begins_with_word(text) or columns.is_row(text)


def _without_trailer(content: Sequence[NumberedLine]) -> Sequence[NumberedLine]:
    """Return the lines without trailing text lines; all lines if no numbers remain."""
    end = len(content)
    while end > 0 and _begins_with_word(content[end - 1].text):
        end -= 1
    return content[:end] if end else content


_LABVIEW = "LabVIEW Measurement"  # the first line of an LVM file
_RULES = 2  # in a file with one segment: of the header of the file, and of the segment


def _in_one_segment(path: Path, lines: list[NumberedLine]) -> tuple[list[NumberedLine], tuple[int, ...]]:
    """Return the lines without the headers of later segments, and the first line number of each such header.

    Raises
    ------
    DataError
        When the segments have no times, or differ in their columns.
    """
    rules = [i for i, line in enumerate(lines) if line.text.startswith(_RULE)]
    if not (lines and lines[0].text.startswith(_LABVIEW)) or len(rules) <= _RULES:
        return lines, ()
    if any(line.text.split()[:2] == ["X_Columns", "No"] for line in lines[: rules[0]]):
        raise DataError(
            f"{path}: {len(rules) - 1} segments without times; write it with X_Columns, or one segment a file"
        )
    kept, begins, names = list(lines[: rules[1] + 2]), list[int](), lines[rules[1] + 1 : rules[1] + 2]
    for rule, following in zip(rules[1:], [*rules[2:], None], strict=True):
        if [line.text for line in lines[rule + 1 : rule + 2]] != [line.text for line in names]:
            raise DataError(
                f"{path}: line {lines[rule].number + 1}: segments with other columns; write a file for each"
            )
        rows = lines[rule + 2 : following]
        kept += rows if following is None else _without_trailer(rows)
        begins += [line.number for line in rows[len(_without_trailer(rows)) :][:1] if following is not None]
    return kept, tuple(begins)


class _Candidate:
    """Table columns under one choice of delimiter and decimal sign."""

    def __init__(self, content: Sequence[NumberedLine], delimiter: str, decimal: str) -> None:
        self.delimiter, self.decimal = delimiter, decimal
        last = max(2, min(_TAIL, len(content) // 3))
        tail = [split_cells(line.text, delimiter) for line in content[1:][-last:] or content]
        self.count, alike = Counter(len(row) for row in tail).most_common(1)[0] if tail else (0, 0)
        rows = [row for row in tail if len(row) == self.count]
        spread = [split_cells(line.text, delimiter) for line in content[1 :: max(1, len(content) // _SPREAD)]]
        full = [row for row in spread if len(row) == self.count and all(_is_value(c, decimal) for c in row if c)]
        columns = (([row[i] for row in rows if row[i]] or [row[i] for row in full]) for i in range(self.count))
        self.numeric = [i for i, cells in enumerate(columns) if self._is_numeric(cells)]  # columns may end early
        rows += full
        self.open_end = bool(rows) and self.count > 1 and not any(row[-1] for row in rows)
        self.filled = [i for i in range(self.count) if any(row[i] for row in rows)]
        self.empty = sorted(set(range(self.count)).difference(self.filled))
        others = len(self.filled) - len(self.numeric)
        numbers = sum(_is_value(cell, decimal) for row in spread for cell in row)
        numeric = len(self.numeric)
        self.rank = (bool(numeric), alike >= _MOST * len(tail), numeric - others if numeric else self.count, numbers)

    def _has_numbers(self, row: list[str]) -> bool:
        """Return whether cells in numeric columns are numbers or empty, and not all empty."""
        filled = [row[i] for i in self.numeric if row[i]]
        return bool(filled) and all(_is_value(cell, self.decimal) for cell in filled)

    def _is_numeric(self, cells: list[str]) -> bool:
        filled = [cell for cell in cells if cell]
        return bool(filled) and sum(_is_value(c, self.decimal) for c in filled) >= _MOST * len(filled)

    def cells(self, text: str) -> list[str] | None:
        """Return a line's cells (without an empty last one if all rows have it); None for a wrong number of cells."""
        row = split_cells(text, self.delimiter)
        if len(row) == self.count + 1 and row[-1] in _UNUSED:
            row = row[:-1]
        if self.open_end and len(row) == self.count:
            row = row[:-1]
        return row if len(row) == self.count - self.open_end else None

    def is_row(self, text: str) -> bool:
        """Return whether a line has numbers in the numeric columns."""
        row = self.cells(text) if self.numeric else None
        if row is None or any(row[i] for i in self.empty if i < len(row)):
            return False
        return self._has_numbers(row)

    def is_names(self, text: str) -> bool:
        """Return whether a line may contain the column names."""
        row = self.cells(text)
        names = [] if row is None else [row[i] for i in self.filled if i < len(row)]
        is_text = bool(names) and all(names) and not any(_is_value(cell, self.decimal) for cell in row or ())
        return is_text and not self.says_units(text)

    def says_units(self, text: str) -> bool:
        """Return whether a line starts with a word for units, and has no other words."""
        return split_cells(text, self.delimiter)[0].lower() in _UNIT_WORDS and self.is_units(text)

    def is_units(self, text: str) -> bool:
        """Return whether a line may contain the column units."""
        row = self.cells(text)
        if row is None:
            return False
        units = [row[i] for i in self.filled if i < len(row)]  # where rows have no cell, a line may have its kind
        units = [cell for cell in units if cell.lower() not in _UNIT_WORDS]
        return any(units) and all(is_file_unit(cell) for cell in units)

    def is_block(self, text: str) -> bool:
        """Return whether a line between names and rows is certainly no row."""
        values = any(_is_value(cell, sign) for cell in split_cells(text, self.delimiter) for sign in DECIMALS)
        return (not values or _begins_with_word(text)) and not self.is_row(text)


def _with_header(
    columns: _Candidate,
    lines: Sequence[NumberedLine],
    content: Sequence[NumberedLine],
    encoding: str,
    options: TextOptions,
) -> TextLayout:
    def layout(
        header: NumberedLine | None, unit_line: NumberedLine | None, rows_from: int, block: tuple[int, ...] = ()
    ) -> TextLayout:
        return TextLayout(encoding, columns.delimiter, columns.decimal, header, unit_line, rows_from, block, 0, given)

    given = options.decimal is not None
    first = next((i for i, line in enumerate(content) if columns.is_row(line.text)), len(content))
    rows_from = content[first].number if first < len(content) else 0
    if options.header_line == 0:
        return layout(None, None, rows_from)
    if options.header_line is not None:
        header = next((line for line in lines if line.number == options.header_line), None)
        return layout(header, *_below(columns, [line for line in content if line.number > options.header_line]))
    start, lowest = first, max(0, first - _BLOCK_LINES)
    while start > lowest and not content[start - 1].text.startswith(_RULE) and columns.cells(content[start - 1].text):
        start -= 1
    direct = [i for i in range(start, first) if columns.is_names(content[i].text)]
    named = _near_rows(columns, content, direct)
    named += [i for i in range(min(start, _BLOCK_LINES)) if columns.is_names(content[i].text)]
    above = [line for line in lines if line.number < rows_from and is_comment(line.text)]
    names = [line for line in above[::-1] if columns.is_names(without_mark(line.text))]
    described = names[:1] if len(names) > 1 and columns.is_units(without_mark(names[0].text)) else []
    header = next(iter(names[len(described) :]), None)
    cells = {i: columns.cells(content[i].text) or [] for i in named}
    sure = [i for i in named if len(set(cells[i])) == len(cells[i]) or not columns.is_units(content[i].text)]
    named = sure if sure or header else named
    at = next((i for i in named if len(set(cells[i])) > 1 or columns.count == 1), None)
    if at is None and named:
        at = named[0]
    if at is not None:
        unit_line, rows_from, block = _below(columns, content[at + 1 :])
        if unit_line is None:  # LabVIEW has it above
            unit_line = next((line for line in content[:at] if columns.says_units(line.text)), None)
        return layout(content[at], unit_line, rows_from, block)
    units = next((i for i in range(start, first) if columns.is_units(content[i].text)), None)
    if described or units is None:
        return layout(header, next(iter(described), None), rows_from)
    if header is None and units > start and _begins_with_word(content[units - 1].text):
        header = content[units - 1]  # names such as ``x-axis,1,2``
    return layout(header, content[units] if header else None, rows_from)


def _near_rows(columns: _Candidate, content: Sequence[NumberedLine], named: list[int]) -> list[int]:
    """Return the candidate lines of names that come after the last line with values.

    A block of an oscilloscope has lines such as ``Vertical Units,V,A`` above ``Vertical Offset,0,0``. If the last line
    of names alone contains a time name, it is the only candidate.
    """

    def cells(i: int) -> list[str]:
        return columns.cells(content[i].text) or []

    names = [i for i in named if not columns.is_units(content[i].text)]
    if len(names) > 1:
        values = (i for i in range(names[0], names[-1]) if any(_is_value(cell, columns.decimal) for cell in cells(i)))
        last = max(values, default=-1)
        named, names = ([i for i in each if i > last] for each in (named, names))
    with_time = [i for i in names if any(TIME_WORDS & set(words_of(cell)) for cell in cells(i))]
    return with_time if with_time == names[-1:] else named


def without_mark(text: str) -> str:
    """Return the text of a line without its comment mark."""
    return text.lstrip().lstrip("#%/").lstrip() if is_comment(text) else text  # a tab at the begin is an empty cell


def _below(columns: _Candidate, below: Sequence[NumberedLine]) -> tuple[NumberedLine | None, int, tuple[int, ...]]:
    """Return the line of units, the line number of the first row, and the range of skipped lines between them."""
    ends = next((i for i, line in enumerate(below[:_BLOCK_LINES]) if not columns.is_block(line.text)), len(below))
    at = next((i for i in range(min(ends, _DESCRIBED)) if columns.is_units(below[i].text)), None)
    skipped = [] if ends == len(below) else [line.number for i, line in enumerate(below[:ends]) if i != at]
    if ends == len(below):
        ends = 0 if at is None or at + 1 == len(below) else at + 1
    described = at is not None and all(number < below[at].number for number in skipped)
    block = () if described or not skipped else (skipped[0], skipped[-1])
    return None if at is None else below[at], below[ends].number if below else 0, block


# ---- Table in a text file: headings, units, and columns as numbers.

CUT = "left out: it has no line break, so the file may have been cut there"


@dataclass(frozen=True)
class TextTable:
    """Table read from a text file.

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
    stated : tuple of (NumberedLine, int), or None
        Line above the rows that states their number, and the number.
    """

    path: Path
    layout: TextLayout
    headings: tuple[str, ...]
    units: tuple[str | None, ...]
    rows: tuple[NumberedLine, ...]
    is_cut: bool = False
    n_first: int = 0
    n_left_out: int = 0
    stated: tuple[NumberedLine, int] | None = None

    @property
    def remark(self) -> str:
        """Text on assumptions, left-out lines, and a stated number of rows that is wrong."""
        count, parts = len(self.rows) + self.n_left_out, [self.layout.remark]
        if self.stated and self.stated[1] != count:
            line, number = self.stated
            parts.append(f"line {line.number} states {number} samples, the file has {count}")
        return "; ".join(filter(None, (*parts, f"the last line is {CUT}" if self.is_cut else "")))

    @cached_property
    def cells(self) -> list[list[str]]:
        """Cells of all rows.

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

    def index(self, reference: str) -> int:
        """Return the index of a column; equal numbered columns (``Time #1``, ``Time #2``) count as one.

        Raises
        ------
        DataError
            When there is no such column, or when several columns of this name have different numbers.
        """
        twins = [i for i, heading in enumerate(self.headings) if twin_name(heading) == reference]
        if not twins or reference in self.headings:
            return find_heading(self.path, self.headings, reference)
        if not self.are_equal(twins) and not set(twins) <= self.clocks.keys():
            raise DataError(
                f"{self.path}: column {reference!r} occurs {len(twins)} times with different numbers; name one, "
                f"{self.headings[twins[0]]!r} to {self.headings[twins[-1]]!r}"
            )
        return twins[0]

    def are_equal(self, indices: Sequence[int]) -> bool:
        """Return whether columns contain equal numbers."""
        values = self.columns(indices)
        return all(np.array_equal(values[:, 0], other, equal_nan=True) for other in values.T)

    @cached_property
    def clocks(self) -> dict[int, FloatArray]:
        """Times [s] by index of the time columns, where channels have different times; else none.

        In such files each channel, or group of channels, has its time column before it, which may end earlier than the
        others. Time columns have a common name, a word for time in their names, or a unit of time.

        Raises
        ------
        DataError
            When time stamps in different columns begin on different dates.
        """
        candidates = [i for i, heading in enumerate(self.headings) if twin_name(heading) or self._is_time(i)]
        times = dict[int, FloatArray]()
        for i in candidates if len(candidates) > 1 else ():
            with contextlib.suppress(DataError):  # texts
                column = self.columns([i])[:, 0]
                column = (self._time_factor(i) or 1.0) * column[~np.isnan(column)]
                if even_step(column[:-1], MAX_RESAMPLED):  # the last one may be that of the file
                    times[i] = column
        times = {i: each for i, each in times.items() if i + 1 not in times and i + 1 < len(self.headings)}
        if not times or all(_are_equal(times[min(times)], each) for each in times.values()):
            return {}
        row = split_cells(self.rows[0].text, self.layout.delimiter)
        dates = {i: date_of(row[i]) for i in times}
        if len(set(dates.values())) > 1:
            text = ", ".join(f"{self.headings[i]} on {date or 'no date'}" for i, date in dates.items())
            raise DataError(f"{self.path}: time columns begin on different dates: {text}; record channels together")
        return times

    def _is_time(self, index: int) -> bool:
        """Return whether a heading has a word for time or a unit of time."""
        words = words_of(name_and_unit(self.headings[index])[0])
        return bool(TIME_WORDS.intersection(words)) or self._time_factor(index) is not None

    def _time_factor(self, index: int) -> float | None:
        """Return the factor from the unit of a column to seconds; None for other units."""
        try:
            return conversion_factor(self.units[index] or "-", "s")
        except UsageError:
            return None

    def columns(self, indices: Sequence[int]) -> FloatArray:
        """Return selected columns as numbers, (n_rows, n_columns).

        Raises
        ------
        DataError
            As for `cells`; also when a cell is neither a number nor empty; an empty one is a missing sample, NaN.
        """
        fast = self._fast(indices)
        if fast is None:  # where one column has stamps, the others are numbers
            alone = ((i, self._fast([i])) for i in indices)
            fast = np.column_stack([self._numbers(i) if column is None else column for i, column in alone])
        if not self.layout.is_decimal_given:
            self._refuse_unclear(indices, fast)
        return fast

    def _fast(self, indices: Sequence[int]) -> FloatArray | None:
        """Return the columns by numpy's reader; None if the rows need the slow reader."""
        delimiter, lines = self.layout.delimiter, [line.text for line in self.rows]
        if delimiter == " " or any('"' in line for line in lines) or self.layout.decimal == delimiter:
            return None
        between = {line.count(delimiter) for line in lines}
        if between != {len(self.headings) - 1} and between != {len(self.headings)}:
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
        if column and is_stamp(column[0]):
            try:
                return times_of_day(column)
            except StampError as error:
                where = f"line {self.rows[error.row].number}, column {self.headings[index]!r}"
                raise DataError(f"{self.path}: {where}: {error}") from None
        if any(has_thousands(cell, decimal) for cell in column):
            column = [_ungrouped(cell, decimal) for cell in column]
        for line, cell in zip(self.rows, column, strict=False):
            if cell.strip() and not is_number(cell, decimal):
                raise self._not_a_number(line, index, cell)
        cells = (cell.replace(decimal, ".").lower().replace("d", "e") if cell.strip() else "nan" for cell in column)
        return np.array([float(cell) for cell in cells])

    def _refuse_unclear(self, indices: Sequence[int], values: FloatArray) -> None:
        """Refuse columns with possible thousands separators: `1.001` after `998`, always with three decimals.

        The sign of another column, such as the one of `0.25`, settles it, unless whole numbers lie far from the others.
        """
        for index, column in zip(indices, values.T, strict=True):
            size = np.abs(column[~np.isnan(column)])
            whole = size == np.floor(size)
            with np.errstate(over="ignore", invalid="ignore"):
                if whole.all() or not whole.any() or size.max() >= _THOUSAND or size[~whole].min() < 1:
                    continue
            if np.abs(1e3 * size - np.round(1e3 * size)).max() > _ROUNDING:
                continue
            cells = [row[index].strip() for row in self.cells]
            grouped = [cell for cell in cells if _GROUPED_TWICE.fullmatch(cell)]
            plain = [float(cell) for cell in cells if re.fullmatch(r"[-+]?\d{1,3}", cell)]
            if len(set(grouped)) <= _UNLIKELY or len(grouped) + len(plain) + cells.count("") < len(cells):
                continue
            near = np.array([float(cell.replace(",", ".")) for cell in grouped])
            alike = not plain or (near.min() - 1 <= min(plain) and max(plain) <= near.max() + 1)
            if not (alike and self.settles_decimal):
                raise DataError(
                    f"{self.path}: column {self.headings[index]!r}: {grouped[0]!r} may be a number of thousands; write "
                    f"it without the sign, or give decimal: {self.layout.decimal!r} if it is the decimal sign"
                )

    @cached_property
    def settles_decimal(self) -> bool:
        """Whether some cell proves the decimal sign, as ``0.5`` or ``12.25`` does."""
        sign = self.layout.decimal
        cells = (cell.strip() for row in self.cells for cell in row if sign in cell)
        return any(is_number(cell, sign) and not _GROUPED_TWICE.fullmatch(cell) for cell in cells)

    def _not_a_number(self, line: NumberedLine, index: int, cell: str) -> DataError:
        where = f"{self.path}: line {line.number}, column {self.headings[index]!r}:"
        other = "," if self.layout.decimal == "." else "."
        hint = f"; the decimal sign is {self.layout.decimal!r} here (decimal: ...)" if is_number(cell, other) else ""
        return DataError(f"{where} {cell!r} is not a number{hint}")


def _are_equal(time: FloatArray, other: FloatArray) -> bool:
    """Return whether two columns of times [s] are equal to a thousandth of a sample."""
    return len(time) == len(other) and np.allclose(time, other, rtol=0, atol=1e-3 * (time[1] - time[0]))


def _ungrouped(cell: str, decimal: str) -> str:
    match = _GROUPED[decimal].fullmatch(cell.strip())
    return cell.replace(match["sign"], "") if match else cell


def read_rows(path: Path, options: TextOptions | None, start: int, stop: int) -> TextTable:
    """Return the table in a text file with selected rows only, to save memory.

    Raises
    ------
    DataError
        As for `read_table`; also when the file has fewer rows.
    OSError
        When the file cannot be read.
    """
    table = read_table(path, options, ends=True)
    layout, rows, count = table.layout, [], 0
    with path.open(encoding=layout.encoding) as file:
        for number, text in enumerate(file, start=1):
            if count == stop or number > (layout.rows_to or number):
                break
            if number < layout.rows_from or not text.strip() or is_comment(text):
                continue
            if text.endswith("\n") or layout.rows_to:  # a last line without its end may be cut
                rows += [NumberedLine(number, text.rstrip("\n"))] * (count >= start)
                count += 1
    if count < stop:
        raise DataError(f"{path}: samples {start} to {stop} are not within its {count} samples")
    return replace(table, rows=tuple(rows), is_cut=False, stated=None)


def is_large(path: Path) -> bool:
    """Return whether a text file is so large that inspections read only its ends."""
    with path.open("rb") as file:
        if os.fstat(file.fileno()).st_size <= 2 * _END:
            return False
        if file.read(len(_LABVIEW)) != _LABVIEW.encode():
            return True
        with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
            return len(re.findall(rb"^\*\*\*End_of_Header", content, re.MULTILINE)) <= _RULES


_MOST_COLUMNS = 10_000
_SHOWN_WIDE = 100  # first lines whose columns are counted


def read_table(path: Path, options: TextOptions | None = None, *, ends: bool = False) -> TextTable:
    """Return the table in a text file, with a given or detected layout; `ends` reads only the ends of a large file.

    Raises
    ------
    DataError
        When the file is not text, or when it has no line with names or no rows.
    OSError
        When the file cannot be read.
    """
    options = options or TextOptions()
    ends = ends and is_large(path)
    text, encoding, gap_after, lines_left_out, rows_left_out = read_text(path, options.encoding, ends=ends)
    numbered = enumerate(text.split("\n"), start=1)
    lines = [NumberedLine(i + lines_left_out * (i > gap_after), line) for i, line in numbered if line.strip()]
    if any(len(re.split(r"[,;\t ]", line.text)) > _MOST_COLUMNS for line in (*lines[:_SHOWN_WIDE], *lines[-1:])):
        text = f"{path}: more than {_MOST_COLUMNS} columns; a column is one channel, a line one sample"
        raise DataError(f"{text}: save the table the other way round, or the channels that are needed")
    lines, segments = _in_one_segment(path, _with_comments(lines))
    layout = replace(find_layout(lines, encoding, options), segments=segments)
    last = layout.rows_to or (lines[-1].number if lines else 0)
    rows = tuple(q for q in lines if last >= q.number >= layout.rows_from > 0 and not is_comment(q.text))
    cells = split_cells(rows[0].text, layout.delimiter) if rows else []
    if layout.header is None and options.header_line:
        raise DataError(f"{path}: header_line: line {options.header_line} is empty or beyond the end of the file")
    content = [line.number for line in lines if not is_comment(line.text)]
    counted = any(cells == [str(i + k) for i in range(len(cells))] for k in (0, 1))  # they are names, or may be
    if layout.header is None and rows and options.header_line != 0 and (counted or rows[0].number != content[0]):
        raise DataError(
            f"{path}: no header line: no line above the numbers has a name for each column; add a line with the "
            "column names, or name it with header_line (header_line: 0 numbers the columns: column 1, column 2, ...)"
        )
    if not rows or (layout.header is None and len(rows) < 2):
        raise DataError(f"{path}: expected a header line and rows of numbers, found {len(content)} lines")
    if layout.header is None:
        headings = [f"column {i}" for i in range(1, len(cells) + (1 if cells[-1] else 0))]
    else:
        headings = split_cells(without_mark(layout.header.text), layout.delimiter)
    if headings and headings[-1] in _UNUSED and (not headings[-1] or len(headings) == len(cells) + 1):
        headings = headings[:-1]  # a delimiter at the end of the line
    below = split_cells(without_mark(layout.unit_line.text), layout.delimiter) if layout.unit_line else []
    units: list[str | None] = [name_and_unit(heading)[1] for heading in headings]
    for i, cell in enumerate(below[: len(headings)]):
        if units[i] is None and cell and cell.lower() not in _UNIT_WORDS and is_file_unit(cell):
            units[i] = written_unit(cell.strip("[]() "))
    units = ["s" if is_stamp(cell) else unit for unit, cell in zip_longest(units, cells[: len(units)], fillvalue="")]
    is_open = len(rows) > 1 and not text.endswith("\n") and rows[-1] == lines[-1]
    is_cut = is_open and len(split_cells(rows[-1].text, layout.delimiter)) >= len(headings)  # fewer cells are an error
    n_first = sum(line.number <= gap_after for line in rows) if gap_after else len(rows)
    stated = None if segments else _stated_count([line for line in lines if line.number < layout.rows_from])
    return TextTable(path, layout, numbered_twins(headings), tuple(units), rows, is_cut, n_first, rows_left_out, stated)
