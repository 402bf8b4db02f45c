"""The reproduction table, for a terminal and as Markdown."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rich.console import Group
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from gbid.report.tables import new_table
from gbid.tables.numbers import engineering

_HEADS = ("where", "quantity", "unit", "paper", "+-", "ours", "std", "off by", "")
_WORDED = ("where", "quantity", "unit", "")
_LEGEND = "+-: how far by the paper's own account; less: a size of scatter or error, where less is no deviation"
_COUNTED = {
    "within": "within the paper's own scatter",
    "explained": "further off or without a scatter to compare with, and explained",
    "off": "off without an explanation",
    "missing": "missing",
}
_DIGITS = 3
_WORDS = {"within": "within", "explained": "see", "off": "OFF", "missing": "missing"}


def reproduction_table(document: Mapping[str, Any]) -> Group:
    """Lay out the rows, then the explanations that they name, each once.

    Parameters
    ----------
    document : dict
        From `gbid.report.paper.stage.reproduction_document`.
    """
    table = new_table("the paper's figures and ours", list(_HEADS), left=("where", "quantity", "unit", ""))
    table.columns[1].no_wrap = False  # the only one with words enough to give way
    rows, reasons = _laid_out(document)
    for row in rows:
        table.add_row(*row)
    notes = [Text(f"{i}: {reason}") for i, reason in enumerate(reasons, 1)]
    parts: list[Table | Text] = [table, Text(""), Text(_total(document)), Text(_LEGEND), *notes, Text("")]
    for past in document.get("past_the_paper", ()):
        words = [i for i, cell in enumerate(past["rows"][0]) if isinstance(cell, str)]
        heads = [escape(column).replace(" ", "\n") for column in past["columns"]]
        extra = new_table(past["title"], heads, left=[heads[i] for i in words])
        for row in past["rows"]:
            extra.add_row(*(escape(cell) if isinstance(cell, str) else _cell(cell, _DIGITS) for cell in row))
        parts += [extra, Text("")]
    return Group(*parts)


def reproduction_markdown(document: Mapping[str, Any]) -> str:
    """Lay out the same as Markdown.

    Parameters
    ----------
    document : dict
        From `gbid.report.paper.stage.reproduction_document`.
    """
    rows, reasons = _laid_out(document)
    lines = [_HEADS, tuple("---" if h in _WORDED else "---:" for h in _HEADS), *rows]
    table = "\n".join("| " + " | ".join(line) + " |" for line in lines)
    notes = "\n".join(f"{i}. {reason}" for i, reason in enumerate(reasons, 1))
    past = "".join(f"\n{_past_markdown(found)}" for found in document.get("past_the_paper", ()))
    return f"{table}\n\n{_total(document)}. {_LEGEND}.\n\n{notes}\n{past}"


def _past_markdown(past: Mapping[str, Any]) -> str:
    ruler = ("---" if isinstance(cell, str) else "---:" for cell in past["rows"][0])
    cells = ((cell if isinstance(cell, str) else _cell(cell, _DIGITS) for cell in row) for row in past["rows"])
    lines = "\n".join("| " + " | ".join(line) + " |" for line in (past["columns"], ruler, *cells))
    return f"**{past['title']}**\n\n{lines}\n"


def _laid_out(document: Mapping[str, Any]) -> tuple[list[tuple[str, ...]], list[str]]:
    """Cells of each row, and the explanations that the last column numbers."""
    rows: list[tuple[str, ...]] = []
    reasons: list[str] = []
    for row in document["rows"]:
        word = _WORDS[row["verdict"]]
        if row["why"]:
            reasons += [] if row["why"] in reasons else [row["why"]]
            word = f"{word} {reasons.index(row['why']) + 1}"
        scatter = "less" if row["at_most"] else _cell(row["scatter"], 2)
        numbers = (_cell(row["paper"], 4), scatter, _cell(row["ours"], 4), _cell(row["ours_std"], 2), _off(row))
        rows.append((row["where"], row["quantity"], row["unit"], *numbers, word))
    return rows, reasons


def _total(document: Mapping[str, Any]) -> str:
    counts = ", ".join(f"{count} {_COUNTED[verdict]}" for verdict, count in document["counts"].items() if count)
    return f"{len(document['rows'])} rows: {counts}"


def _off(row: Mapping[str, Any]) -> str:
    if row["deviation"] is None or (row["at_most"] and row["deviation"] <= 0):
        return "-"
    if row["deviation_percent"] is None:
        return _cell(row["deviation"], 2)
    return f"{row['deviation_percent']:+.1f} %"


def _cell(value: float | None, digits: int) -> str:
    if value is None:
        return "-"
    if 0.001 <= abs(value) < 1e5:
        return f"{value:.{digits}g}" if abs(value) < 10**digits else f"{value:.0f}"
    return engineering(value, digits)
