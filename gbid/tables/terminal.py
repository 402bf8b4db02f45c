"""Terminal renderer of tables, with rich."""

from __future__ import annotations

from typing import TYPE_CHECKING

from gbid.naming.escape import printable
from gbid.tables.table import Table

if TYPE_CHECKING:
    from rich.console import Group


def terminal_table(table: Table) -> Group:
    """Return the rich table with its notes; control characters and markup in texts have no effect."""
    from rich import box
    from rich.console import Group
    from rich.table import Table as RichTable
    from rich.text import Text

    title = Text(printable(table.title)) if table.title else None
    headed = any(column.name for column in table.columns)
    if headed:
        laid = RichTable(title_justify="left", title_style="bold", box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False)
    else:
        laid = RichTable.grid(padding=(0, 2, 0, 0))
    laid.title = title
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
