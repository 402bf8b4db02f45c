"""Reader of csv files with comma, semicolon or tab, and with names and units in the header line."""

from __future__ import annotations

import csv
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from gbid.arrays import FloatArray
from gbid.errors import DataError
from gbid.recording.importers.columns import FileColumn, even_step, find_heading, name_and_unit
from gbid.recording.importers.file_format import FileChannel, FileFormat


def read_csv(path: Path, references: Sequence[str]) -> dict[str, FileColumn]:
    """Return the named columns of a csv file.

    The header is the first line that is not empty and does not start with ``#``. A cell such as ``u_x [um]`` or
    ``u_x (um)`` gives name and unit. A column can be named with or without its unit.

    Raises
    ------
    DataError
        When the file is not UTF-8 text, when it has no header line or rows of different length, when a column is
        missing or occurs twice, or when a cell of a requested column is not a number.
    """
    lines = _lines(path)
    header, rows = _cells(path, lines)
    for (number, _), row in zip(lines[1:], rows, strict=False):
        if len(row) != len(header):
            raise DataError(f"{path}: line {number} has {len(row)} cells, the header line has {len(header)}")
    numbers = [number for number, _ in lines[1:]]
    columns = {}
    for reference in references:
        index = find_heading(path, header, reference)
        columns[reference] = FileColumn(
            _numbers(path, header[index], [row[index] for row in rows], numbers), name_and_unit(header[index])[1]
        )
    return columns


def peek_csv(path: Path, references: Sequence[str]) -> tuple[int, dict[str, FileColumn]]:
    """Return the number of rows of a csv file, and its columns in the first and last row only.

    Returns
    -------
    int
        Number of rows.
    dict of str to FileColumn
        The two values of each requested column.

    Raises
    ------
    DataError
        As for `read_csv`, as far as these rows show it.
    """
    lines = _lines(path)
    if len(lines) < 3:
        raise DataError(f"{path}: expected a header line and rows of numbers, found {len(lines)} lines; record longer")
    ends = [lines[0], lines[1], lines[-1]]
    try:
        header, *rows = csv.reader(
            (text for _, text in ends), delimiter=_delimiter(lines), skipinitialspace=True, strict=True
        )
    except csv.Error as error:
        raise DataError(f"{path}: first or last row not readable as csv: {error}; export it again") from None
    header = [cell.strip() for cell in header]
    _check_header(path, header)
    for (number, _), row in zip(ends[1:], rows, strict=True):
        if len(row) != len(header):
            raise DataError(
                f"{path}: line {number} has {len(row)} cells, the header line has {len(header)}; is the file truncated?"
            )
    columns = {}
    for reference in references:
        index = find_heading(path, header, reference)
        cells, numbers = [row[index] for row in rows], [number for number, _ in ends[1:]]
        columns[reference] = FileColumn(_numbers(path, header[index], cells, numbers), name_and_unit(header[index])[1])
    return len(lines) - 1, columns


def csv_channels(path: Path) -> list[FileChannel]:
    """Return the columns of a csv file, with the units of their headings.

    Raises
    ------
    DataError
        When the file is not UTF-8 text, or when it has no header line or no rows.
    """
    header, rows = _cells(path, _lines(path))
    names = [name_and_unit(cell)[0] for cell in header]
    channels = []
    for i, heading in enumerate(header):
        name = names[i] if names.count(names[i]) == 1 else heading
        cells = [row[i] if i < len(row) else "" for row in rows]
        numbers = all(_is_number(cell) for cell in cells)
        step = even_step(np.array([float(cell) for cell in cells])) if numbers else None
        remark = "" if numbers else "not all cells are numbers"
        channels.append(FileChannel(name, len(rows), name_and_unit(heading)[1], None, step, remark))
    return channels


def _lines(path: Path) -> list[tuple[int, str]]:
    """Return the lines with content and their numbers from 1, without comments and byte order mark."""
    try:
        text = path.read_bytes().decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise DataError(f"{path}: not UTF-8 text (byte {error.start}): export it as csv in UTF-8") from None
    text = text.replace("\r\n", "\n").replace("\r", "\n")
    numbered = enumerate(text.split("\n"), start=1)
    return [(number, line) for number, line in numbered if line.strip() and not line.lstrip().startswith("#")]


def _cells(path: Path, lines: list[tuple[int, str]]) -> tuple[list[str], list[list[str]]]:
    """Return the cells of the header line and of the rows."""
    if len(lines) < 2:
        raise DataError(f"{path}: expected a header line and rows of numbers, found {len(lines)} lines")
    delimiter = _delimiter(lines)
    try:
        reader = csv.reader((text for _, text in lines), delimiter=delimiter, skipinitialspace=True, strict=True)
        header, *rows = reader
    except csv.Error as error:
        raise DataError(f"{path}: line {lines[reader.line_num - 1][0]}: not readable as csv: {error}") from None
    header = [cell.strip() for cell in header]
    _check_header(path, header)
    return header, rows


def _delimiter(lines: list[tuple[int, str]]) -> str:
    """Return the delimiter that splits the header and the first row into the same, largest number of cells."""

    def cells(delimiter: str, line: str) -> int:
        return len(next(csv.reader([line], delimiter=delimiter, skipinitialspace=True)))

    def rank(delimiter: str) -> tuple[bool, int]:
        header, row = (cells(delimiter, text) for _, text in lines[:2])
        return header == row > 1, header

    return max((",", ";", "\t"), key=rank)


def _check_header(path: Path, header: list[str]) -> None:
    if all(_is_number(cell) for cell in header):
        raise DataError(
            f"{path}: no header line: the first line holds numbers only; add a line with the column names "
            "(without # in front)"
        )
    twice = [name for name, count in Counter(header).items() if name and count > 1]
    if twice:
        raise DataError(f"{path}: the header line has column {twice[0]!r} more than once; rename one")


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return "_" not in cell  # Python accepts 1_000 as a number, other programs do not


def _numbers(path: Path, name: str, cells: list[str], lines: list[int]) -> FloatArray:
    """Return the cells of one column as numbers."""
    try:
        if "_" not in "".join(cells):
            return np.array([float(cell) for cell in cells])
    except ValueError:
        pass
    row = next(i for i, cell in enumerate(cells) if not _is_number(cell))
    where = f"{path}: line {lines[row]}, column {name!r}:"
    if not cells[row].strip():
        raise DataError(f"{where} the cell is empty; leave those samples out or repair them")
    hint = "; write decimals with a point" if _is_number(cells[row].replace(",", ".")) else ""
    raise DataError(f"{where} {cells[row]!r} is not a number{hint}")


FORMAT = FileFormat((".csv",), read_csv, csv_channels, peek_csv)
