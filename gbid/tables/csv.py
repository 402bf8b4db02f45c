"""CSV renderer of tables: numbers with all digits, for programs and spreadsheets."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from pathlib import Path

from gbid.naming.escape import one_line, printable
from gbid.tables.table import Table, Value, value_of

_QUOTED = re.compile(r'[,"]|^#|^ | $')  # a first cell with # would be read as a comment
_FORMULA = re.compile(r"[=@]|[+-](?=.)(?![0-9.]+([eE][+-]?[0-9]+)?$)")


def csv_text(table: Table, comments: Sequence[str] = ()) -> str:
    """Return the text of a CSV file: notes and comments in lines that begin with #, the headings, the rows.

    Numbers are written with all digits, so that they are read back exactly. An empty cell is a missing value. Each row
    is one line of the file. A text that a spreadsheet would take for a formula begins with an apostrophe.

    Parameters
    ----------
    table : Table
        The table.
    comments : sequence of str
        Further comment lines below the notes.

    Returns
    -------
    str
        Text of the file.
    """
    lines = [f"# {one_line(comment)}" for comment in (*table.notes, *comments)]
    lines.append(_line(_safe(column.heading) for column in table.columns))
    lines += [_line(_text(value_of(entry)) for entry in row) for row in table.rows]
    return "".join(f"{line}\n" for line in lines)


def write_csv(table: Table, path: Path, comments: Sequence[str] = ()) -> None:
    """Write the text of `csv_text` to a file."""
    path.write_text(csv_text(table, comments), encoding="utf-8", newline="")


def _line(cells: Iterable[str]) -> str:
    return ",".join('"' + cell.replace('"', '""') + '"' if _QUOTED.search(cell) else cell for cell in cells)


def _text(value: Value) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float):
        return repr(float(value))
    return _safe(value) if isinstance(value, str) else "" if value is None else str(value)


def _safe(text: str) -> str:
    text = printable(text)
    return f"'{text}" if _FORMULA.match(text) else text
