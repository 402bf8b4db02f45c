"""Tables: columns with name, unit and format; numbers as text; renderers for CSV, HTML, Markdown and terminal.

A table contains values, not texts. The same table is printed with few digits for readers and written to CSV with all
digits.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from math import floor, isfinite, log10
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, cast

from gbid.core.extras import data_frame
from gbid.core.names import html_text, one_line, printable

if TYPE_CHECKING:
    from rich.console import Group

T = TypeVar("T")

# ---- Numbers in engineering notation: exponents in steps of three and significant digits.

_SHOWN = {"s": (1e3, "ms"), "m": (1e6, "µm")}


_LONG = 1e-2


def shown_unit(unit: str, largest: float = 0.0) -> tuple[float, str]:
    """Return factor and unit for the display of a value: milliseconds for times, micrometres for lengths.

    Where the largest of the values is given and is 10 mm or more, lengths are in millimetres.
    """
    if unit == "m" and largest >= _LONG:
        return 1e3, "mm"
    return _SHOWN.get(unit, (1.0, unit))


def exponent_of(value: float) -> int:
    """Return the decimal exponent of a number in steps of three; 0 when no exponent is needed.

    Examples
    --------
    >>> exponent_of(-633314.0), exponent_of(50.3), exponent_of(0.571), exponent_of(4.2e-6)
    (3, 0, 0, -6)
    """
    if value == 0 or not isfinite(value) or 1e-4 <= abs(value) < 1e4:
        return 0
    return 3 * floor(log10(abs(value)) / 3)


def finite_or_none(value: float) -> float | None:
    """Return a finite number, or None: JSON has no nan and no infinity."""
    return float(value) if isfinite(value) else None


def probability(p: float) -> str:
    """Return a probability as text with two digits; a very small one as an upper bound ("< 1e-4").

    Examples
    --------
    >>> probability(0.2345), probability(3e-145)
    ('p = 0.23', 'p < 1e-16')
    """
    return f"p = {p:.2g}" if p >= 1e-16 else "p < 1e-16"


def engineering(value: float | None, digits: int = 5, exponent: int | None = None) -> str:
    """Return a number as text with significant digits and an exponent in steps of three.

    Parameters
    ----------
    value : float or None
        Number; None and values that are not finite give a dash.
    digits : int
        Number of significant digits.
    exponent : int, optional
        Common exponent of the numbers in a row; by default that of the number itself.

    Returns
    -------
    str
        The number.

    Examples
    --------
    >>> engineering(-633314.2), engineering(0.57123), engineering(123.4, 2, 3)
    ('-633.31e3', '0.57123', '0.12e3')
    """
    if value is None or not isfinite(value):
        return "-"
    value = float(f"{value:.{digits - 1}e}")  # rounding may reach the next power of ten
    exponent = exponent_of(value) if exponent is None else exponent
    mantissa = value / 10.0**exponent
    if mantissa == 0:
        return "0"
    decimals = max(0, digits - 1 - floor(log10(abs(mantissa))))
    if decimals > 9:
        return f"{value:.{digits - 1}e}"
    text = f"{mantissa:.{decimals}f}"
    return f"{text}e{exponent}" if exponent else text


def file_size(count: int) -> str:
    """Return a number of bytes as text with a unit, e.g. ``"1.2 MB"``."""
    value = float(count)
    for unit in ("B", "kB", "MB"):
        if value < 1000:
            return f"{value:.3g} {unit}"
        value /= 1000
    return f"{value:.3g} GB"


Row = dict[str, Any]
"""Row of plain values by key, for JSON and tables."""
Value = str | float | int | bool | None
"""Value of a cell: text, number, or yes and no. None and nan are missing values."""


@dataclass(frozen=True)
class Cell:
    """Cell with a display text or a link beside its value.

    Parameters
    ----------
    value : str, float, int, bool or None
        The value.
    text : str
        Text to show; by default the value in the format of the column.
    href : str
        Target of the link in HTML.
    """

    value: Value
    text: str = ""
    href: str = ""


Entry = Value | Cell


@dataclass(frozen=True)
class Column:
    r"""Column of a table: its heading and the format of its values.

    Parameters
    ----------
    name : str
        Heading. On a terminal a line break in the name breaks the heading; at its end it moves the unit to a new line.
    unit : str
        Unit of the values.
    format : str or int
        Format specification of the numbers, or number of significant digits in engineering notation. Columns without
        format and unit contain texts and are aligned left; others are aligned right.
    missing : str
        Text for a missing value.
    wrap : bool
        Whether a terminal may break the cells over several lines.

    Examples
    --------
    >>> Column("frequency", "Hz", ".2f").show(98.4321)
    '98.43'
    >>> Column("k_xx", format=5).show(Cell(-633314.2)), Column("std", format=2).show(None)
    ('-633.31e3', '-')
    """

    name: str
    unit: str = ""
    format: str | int = ""
    missing: str = "-"
    wrap: bool = False

    @property
    def left(self) -> bool:
        """Whether the column has texts, which are aligned left."""
        return self.format == "" and not self.unit

    @property
    def lines(self) -> str:
        """Lines of the heading."""
        gap = "" if self.name.endswith("\n") else " "
        return f"{self.name}{gap}[{self.unit}]" if self.unit else self.name

    @property
    def heading(self) -> str:
        """Heading on one line."""
        return " ".join(self.lines.split())

    def show(self, entry: Entry) -> str:
        """Return the text of a value in this column."""
        if isinstance(entry, Cell):
            return entry.text or self.show(entry.value)
        if entry is None or entry != entry:
            return self.missing
        if isinstance(entry, str):
            return entry
        if isinstance(entry, bool):
            return "yes" if entry else "no"
        if isinstance(self.format, str) and self.format:
            return format(entry, self.format)
        if isinstance(entry, int):
            return str(entry)
        return engineering(entry, self.format or 4)


@dataclass(frozen=True)
class Table:
    """Table of values: columns, rows, title and notes.

    Parameters
    ----------
    title : str
        Title; may be empty.
    columns : sequence of Column
        The columns. A terminal shows no headings when all names are empty.
    rows : sequence of sequences
        One entry for each column: a value or a `Cell`.
    notes : sequence of str
        Notes below the table; in a CSV file, comments above it.

    Raises
    ------
    ValueError
        When a row has more or fewer cells than there are columns.
    """

    title: str
    columns: Sequence[Column]
    rows: Sequence[Sequence[Entry]]
    notes: Sequence[str] = ()

    def __post_init__(self) -> None:
        for i, row in enumerate(self.rows):
            if len(row) != len(self.columns):
                raise ValueError(f"table {self.title!r}: row {i} has {len(row)} cells for {len(self.columns)} columns")

    def texts(self) -> list[list[str]]:
        """Return the texts of the cells, row by row."""
        return [[column.show(entry) for column, entry in zip(self.columns, row, strict=True)] for row in self.rows]

    def to_frame(self) -> Any:
        """Return the values as a pandas.DataFrame, with the units in ``frame.attrs["units"]``.

        Raises
        ------
        UsageError
            When pandas is not installed.
        """
        names = [" ".join(column.name.split()) for column in self.columns]
        values = {name: [value_of(row[i]) for row in self.rows] for i, name in enumerate(names)}
        return data_frame(values, units={name: c.unit for name, c in zip(names, self.columns, strict=True)})

    def document(self) -> dict[str, Any]:
        """Return title, headings and values for JSON; nan and infinity are None."""
        values = [[value_of(entry) for entry in row] for row in self.rows]
        rows = [[finite_or_none(value) if isinstance(value, float) else value for value in row] for row in values]
        return {"title": self.title, "columns": [column.heading for column in self.columns], "rows": rows}


def titled(title: str, tables: Iterable[Table]) -> list[Table]:
    """Return tables with a title added; the first table's title follows it."""
    return [replace(q, title=f"{title}, {q.title}".removesuffix(", ")) if i == 0 else q for i, q in enumerate(tables)]


def value_of(entry: Entry) -> Value:
    """Return the plain value of a cell."""
    return entry.value if isinstance(entry, Cell) else entry


def formatted(value: float | None, format: str | int, unit: str = "") -> Entry:
    """Return a cell with a unit and format different from its column's; None for a missing value.

    Parameters
    ----------
    value : float or None
        The value.
    format : str or int
        Format as of a `Column`.
    unit : str
        Unit of the value, shown behind it; seconds become milliseconds, metres micrometres.

    Returns
    -------
    Cell or None
        The cell, with the value in the unit shown.

    Examples
    --------
    >>> formatted(1.25e-6, 2, "m").text, formatted(0.041, ".1f", "%").text
    ('1.2 µm', '0.0 %')
    """
    if value is None or value != value:
        return None
    factor, shown = shown_unit(unit)
    return Cell(factor * value, f"{Column('', format=format).show(factor * value)} {shown}".rstrip())


def in_unit(value: float, unit: str, digits: int = 3) -> str:
    """Return a value as text with significant digits, in the display unit of tables.

    Examples
    --------
    >>> in_unit(1.25e-6, "m"), in_unit(8.4e-6, "m")
    ('1.25 µm', '8.40 µm')
    """
    factor, shown = shown_unit(unit)
    return f"{f'{factor * value:#.{digits}g}'.rstrip('.')} {shown}".rstrip()


def keyed_table(
    title: str, columns: Mapping[str, Column], rows: Iterable[Mapping[str, Any]], notes: Sequence[str] = ()
) -> Table:
    """Return the table of rows given as mappings; the keys of the columns select the values."""
    return Table(title, list(columns.values()), [[row[key] for key in columns] for row in rows], notes)


def plain_table(names: Sequence[str], rows: Sequence[Sequence[Entry]], notes: Sequence[str] = ()) -> Table:
    """Return a table for a file: columns with names only, without units and formats."""
    return Table("", [Column(name) for name in names], rows, notes)


def table_of_records(records: Sequence[Mapping[str, Value]]) -> Table:
    """Return a table for a file of records; the keys that all records have are the column names."""
    return plain_table(list(records[0]) if records else (), [list(record.values()) for record in records])


def table_of_values(kind: type, values: Sequence[object], notes: Sequence[str] = ()) -> Table:
    """Return a table for a file from dataclass values; the field names are the column names."""
    names = [field.name for field in fields(kind)]
    return plain_table(names, [[getattr(value, name) for name in names] for value in values], notes)


_CELLS: dict[str, Callable[[str], Any]] = {"int": int, "float": float, "bool": lambda cell: cell == "true", "str": str}


def read_values(path: Path, kind: type[T]) -> list[T]:
    """Return the values in a CSV file written from `table_of_values`; the types of the fields decide the cells."""
    readers = {field.name: _CELLS[str(field.type)] for field in fields(cast(Any, kind))}
    return [kind(**{name: read(row[name]) for name, read in readers.items()}) for row in csv_rows(path)]


def csv_rows(path: Path) -> list[dict[str, str]]:
    """Return the cells of a CSV file, row by row and by heading, without comments."""
    with path.open(encoding="utf-8", newline="") as handle:
        return list(csv.DictReader(line for line in handle if not line.startswith("#")))


# ---- Renderers of tables: CSV, HTML, Markdown, terminal.

_QUOTED = re.compile(r'[,"]|^#|^ | $')  # a first cell with # would be read as a comment
_FORMULA = re.compile(r"[=@]|[+-](?=.)(?![0-9.]+([eE][+-]?[0-9]+)?$)")


def csv_text(table: Table, comments: Sequence[str] = ()) -> str:
    """Return the text of a CSV file: notes and comments in # lines, headings, rows.

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
    lines.append(",".join(_cell_text(column.heading) for column in table.columns))
    lines += [",".join(_cell_text(value_of(entry)) for entry in row) for row in table.rows]
    return "".join(f"{line}\n" for line in lines)


def write_csv(table: Table, path: Path, comments: Sequence[str] = ()) -> None:
    """Write the text of `csv_text` to a file."""
    path.write_text(csv_text(table, comments), encoding="utf-8", newline="")


def _cell_text(value: Value) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float):
        return repr(float(value))
    if not isinstance(value, str):
        return "" if value is None else str(value)
    text = printable(value)
    text = f"'{text}" if _FORMULA.match(text) else text
    return '"' + text.replace('"', '""') + '"' if _QUOTED.search(text) else text


def html_table(table: Table) -> str:
    """Return the HTML of a table; the first cell of a row is its heading. Texts are escaped."""
    title = html_text(table.title)
    heads = "".join(
        f'<th scope="col"{_left(column.left or i == 0)}>{html_text(column.heading)}</th>'
        for i, column in enumerate(table.columns)
    )
    rows = "".join(f"<tr>{''.join(map(_cell, range(len(row)), table.columns, row))}</tr>\n" for row in table.rows)
    notes = "".join(f'<p class="words">{html_text(note)}</p>\n' for note in table.notes)
    return (
        f'<p class="caption" aria-hidden="true">{title}</p>\n'
        f'<div class="scroll" role="region" aria-label="{title}" tabindex="0">\n'
        f'<table aria-label="{title}">\n<thead><tr>{heads}</tr></thead>\n<tbody>\n{rows}</tbody>\n</table>\n</div>\n'
        f"{notes}"
    )


def _cell(i: int, column: Column, entry: Entry) -> str:
    text = html_text(column.show(entry))
    if isinstance(entry, Cell) and entry.href:
        text = f'<a href="{html_text(entry.href)}">{text}</a>'
    return f"<td{_left(column.left)}>{text}</td>" if i else f'<th scope="row">{text}</th>'


def _left(left: bool) -> str:
    return ' class="left"' if left else ""


# Characters with a meaning in Markdown. An underscore inside a name has none.
_SPECIAL = re.compile(r"[\\|`*<&]|(?<![A-Za-z0-9])_|_(?![A-Za-z0-9])")


def markdown_table(table: Table) -> str:
    """Return the Markdown of a table: the title in bold, a pipe table, the notes. Texts are escaped."""
    lines = [
        _line_markdown(column.heading for column in table.columns),
        "| " + " | ".join("---" if column.left else "---:" for column in table.columns) + " |",
        *map(_line_markdown, table.texts()),
    ]
    title = [f"**{_escaped(table.title)}**"] if table.title else []
    return "\n\n".join([*title, "\n".join(lines), *map(_escaped, filter(None, table.notes))]) + "\n"


def _line_markdown(cells: Iterable[str]) -> str:
    return "| " + " | ".join(map(_escaped, cells)) + " |"


def _escaped(text: str) -> str:
    return _SPECIAL.sub(r"\\\g<0>", one_line(text))


def terminal_table(table: Table) -> Group:
    """Return a rich table with its notes; control characters and markup in texts are escaped."""
    from rich import box
    from rich.console import Group
    from rich.table import Table as RichTable
    from rich.text import Text

    headed = any(column.name for column in table.columns)
    if headed:
        laid = RichTable(title_justify="left", title_style="bold", box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False)
    else:
        laid = RichTable.grid(padding=(0, 2, 0, 0))
    laid.title = Text(printable(table.title)) if table.title else None
    for column in table.columns:
        heading = Text("\n".join(map(printable, column.lines.split("\n"))))
        laid.add_column(
            heading,
            justify="left" if column.left else "right",
            no_wrap=not column.wrap,
            overflow="fold" if column.wrap else "ellipsis",
        )
    for row in table.texts():
        laid.add_row(*(Text(printable(text)) for text in row))
    return Group(*([laid] if table.columns else []), *(Text(printable(note)) for note in table.notes))
