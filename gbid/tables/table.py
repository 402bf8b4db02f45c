"""Table: columns with name, unit and format, rows of values. Renderers beside this module turn it into words.

A table holds values, not words: the same table is printed with the digits that a reader needs, and written to CSV with
all of them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import isfinite
from typing import Any

from gbid.tables.numbers import engineering, shown_unit

Value = str | float | int | bool | None
"""What a cell holds: text, number or yes and no. None is missing, and so is a number that is nan."""


@dataclass(frozen=True)
class Cell:
    """A value that is not shown in the format of its column.

    Parameters
    ----------
    value : str, float, int, bool or None
    text : str
        What is shown. The format of the column makes it when left out.
    href : str
        Where the cell leads to in HTML.
    """

    value: Value
    text: str = ""
    href: str = ""


Entry = Value | Cell


@dataclass(frozen=True)
class Column:
    r"""A column: its heading, and how its values are shown.

    Parameters
    ----------
    name : str
        On a terminal a line break in the name breaks the heading; at its end it puts the unit on a line of its own.
    unit : str
        Unit of the values.
    format : str or int
        Format specification of the numbers, or their significant digits in engineering notation. Left out, the column
        holds texts. Texts stand to the left, and columns with a format or unit to the right.
    missing : str
        What is shown for a value that is missing.
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
        """Whether the cells stand to the left, because they are texts."""
        return self.format == "" and not self.unit

    @property
    def lines(self) -> str:
        """Heading with its line breaks."""
        gap = "" if self.name.endswith("\n") else " "
        return f"{self.name}{gap}[{self.unit}]" if self.unit else self.name

    @property
    def heading(self) -> str:
        """Heading on one line."""
        return " ".join(self.lines.split())

    def show(self, entry: Entry) -> str:
        """Text of a cell."""
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
    """A table.

    Parameters
    ----------
    title : str
        Empty when it has none.
    columns : sequence of Column
        A terminal shows no headings when all names are empty.
    rows : sequence of sequences
        One cell for each column: a value or a `Cell`.
    notes : sequence of str
        What stands below it; in a CSV file, the comments above it.

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
        """Cells as they are shown, row by row."""
        return [[column.show(entry) for column, entry in zip(self.columns, row, strict=True)] for row in self.rows]

    def document(self) -> dict[str, Any]:
        """Title, headings and values as a plain document for JSON; numbers that are not finite are None."""
        rows = [[_finite(value_of(entry)) for entry in row] for row in self.rows]
        return {"title": self.title, "columns": [column.heading for column in self.columns], "rows": rows}


def value_of(entry: Entry) -> Value:
    """Value of a cell."""
    return entry.value if isinstance(entry, Cell) else entry


def _finite(value: Value) -> Value:
    return None if isinstance(value, float) and not isfinite(value) else value


def formatted(value: float | None, format: str | int, unit: str = "") -> Entry:
    """Cell with a format of its own, for a column whose rows differ; missing where the value is.

    Parameters
    ----------
    value : float or None
    format : str or int
        As of a `Column`.
    unit : str
        Unit of the value, shown behind it; seconds become milliseconds, metres micrometres.

    Examples
    --------
    >>> formatted(1.25e-6, 2, "m").text, formatted(0.041, ".1f", "%").text
    ('1.2 µm', '0.0 %')
    """
    if value is None or value != value:
        return None
    factor, shown = shown_unit(unit)
    return Cell(factor * value, f"{Column('', format=format).show(factor * value)} {shown}".rstrip())


def plain_table(names: Sequence[str], rows: Sequence[Sequence[Entry]], notes: Sequence[str] = ()) -> Table:
    """Table for a file: columns that are no more than their names."""
    return Table("", [Column(name) for name in names], rows, notes)


def table_of_records(records: Sequence[Mapping[str, Value]]) -> Table:
    """Table for a file of records with the same keys, which become the names of the columns."""
    return plain_table(list(records[0]) if records else (), [list(record.values()) for record in records])
