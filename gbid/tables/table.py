"""Table: columns with name, unit and format, and rows of values. The renderers beside this module show it.

A table contains values, not texts. The same table is printed with few digits for readers and written to CSV with all
digits.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import isfinite
from typing import Any

from gbid.extras import data_frame
from gbid.tables.numbers import engineering, shown_unit

Value = str | float | int | bool | None
"""Value of a cell: text, number, or yes and no. None and nan are missing values."""


@dataclass(frozen=True)
class Cell:
    """Value of a cell with a text or link of its own.

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
        """Whether the cells are texts, which are aligned left."""
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
        """Return the text of a cell."""
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
    """Table of values.

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
        """Return title, headings and values as a document for JSON; numbers that are not finite are None."""
        rows = [[_finite(value_of(entry)) for entry in row] for row in self.rows]
        return {"title": self.title, "columns": [column.heading for column in self.columns], "rows": rows}


def value_of(entry: Entry) -> Value:
    """Return the value of a cell."""
    return entry.value if isinstance(entry, Cell) else entry


def _finite(value: Value) -> Value:
    return None if isinstance(value, float) and not isfinite(value) else value


def formatted(value: float | None, format: str | int, unit: str = "") -> Entry:
    """Return a cell with its own format and unit, for a column of different quantities; None for a missing value.

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


def plain_table(names: Sequence[str], rows: Sequence[Sequence[Entry]], notes: Sequence[str] = ()) -> Table:
    """Return a table for a file: columns with names only, without units and formats."""
    return Table("", [Column(name) for name in names], rows, notes)


def table_of_records(records: Sequence[Mapping[str, Value]]) -> Table:
    """Return a table for a file of records; their common keys are the names of the columns."""
    return plain_table(list(records[0]) if records else (), [list(record.values()) for record in records])
