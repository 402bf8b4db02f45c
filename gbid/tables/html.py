"""HTML renderer of tables, with markup for the style of the page and for screen readers."""

from __future__ import annotations

from gbid.naming.escape import html_text
from gbid.tables.table import Cell, Column, Entry, Table


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
