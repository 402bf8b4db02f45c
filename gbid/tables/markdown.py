"""Markdown renderer of tables."""

from __future__ import annotations

import re
from collections.abc import Iterable

from gbid.naming.escape import one_line
from gbid.tables.table import Table

# Characters with a meaning in Markdown. An underscore inside a name has none.
_SPECIAL = re.compile(r"[\\|`*<&]|(?<![A-Za-z0-9])_|_(?![A-Za-z0-9])")


def markdown_table(table: Table) -> str:
    """Return the Markdown of a table: the title in bold, a pipe table, the notes. Texts are escaped."""
    lines = [
        _line(column.heading for column in table.columns),
        "| " + " | ".join("---" if column.left else "---:" for column in table.columns) + " |",
        *map(_line, table.texts()),
    ]
    title = [f"**{_escaped(table.title)}**"] if table.title else []
    return "\n\n".join([*title, "\n".join(lines), *map(_escaped, filter(None, table.notes))]) + "\n"


def _line(cells: Iterable[str]) -> str:
    return "| " + " | ".join(map(_escaped, cells)) + " |"


def _escaped(text: str) -> str:
    return _SPECIAL.sub(r"\\\g<0>", one_line(text))
