"""The reproduction table, for a terminal and as Markdown."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from gbid.tables.markdown import markdown_table
from gbid.tables.table import Column, Entry, Table, formatted

_COLUMNS = (
    Column("where"),
    Column("quantity", wrap=True),  # the only one with words enough to give way
    Column("unit"),
    *(Column(name, format="g") for name in ("paper", "+-", "ours", "std", "off by")),
    Column(""),
)
_LEGEND = "+-: how far by the paper's own account; less: a size of scatter or error, where less is no deviation"
_COUNTED = {
    "within": "within the paper's own scatter",
    "explained": "further off or without a scatter to compare with, and explained",
    "off": "off without an explanation",
    "missing": "missing",
}
_DIGITS = 3
_WORDS = {"within": "within", "explained": "see", "off": "OFF", "missing": "missing"}


def reproduction_tables(document: Mapping[str, Any]) -> list[Table]:
    """Table of the paper's figures and ours, with the explanations below, each once; then what goes past the paper.

    Parameters
    ----------
    document : dict
        From `gbid.report.paper.paper_files.reproduction_document`.
    """
    rows, reasons = _laid_out(document)
    notes = [_total(document), f"{_LEGEND}.", *(f"{i}. {reason}" for i, reason in enumerate(reasons, 1))]
    table = Table("the paper's figures and ours", _COLUMNS, rows, ["", *notes])
    return [table, *map(_past, document.get("past_the_paper", ()))]


def reproduction_markdown(document: Mapping[str, Any]) -> str:
    """Markdown of the same tables.

    Parameters
    ----------
    document : dict
        From `gbid.report.paper.paper_files.reproduction_document`.
    """
    first, *past = reproduction_tables(document)
    return "\n".join(map(markdown_table, (replace(first, title=""), *past)))  # a page has a heading of its own


def _past(document: Mapping[str, Any]) -> Table:
    """Table of what the paper has no figures for, from its document."""
    rows = [[cell if isinstance(cell, str) else _cell(cell, _DIGITS) for cell in row] for row in document["rows"]]
    worded = [isinstance(cell, str) for cell in document["rows"][0]]
    heads = zip(document["columns"], worded, strict=True)
    columns = [Column(name) if words else Column(name.replace(" ", "\n"), format="g") for name, words in heads]
    return Table(document["title"], columns, rows)


def _laid_out(document: Mapping[str, Any]) -> tuple[list[list[Entry]], list[str]]:
    """Cells of each row, and the explanations that the last column numbers."""
    rows: list[list[Entry]] = []
    reasons: list[str] = []
    for row in document["rows"]:
        word = _WORDS[row["verdict"]]
        if row["why"]:
            reasons += [] if row["why"] in reasons else [row["why"]]
            word = f"{word} {reasons.index(row['why']) + 1}"
        scatter = "less" if row["at_most"] else _cell(row["scatter"], 2)
        numbers = (_cell(row["paper"], 4), scatter, _cell(row["ours"], 4), _cell(row["ours_std"], 2), _off(row))
        rows.append([row["where"], row["quantity"], row["unit"], *numbers, word])
    return rows, reasons


def _total(document: Mapping[str, Any]) -> str:
    counts = ", ".join(f"{count} {_COUNTED[verdict]}" for verdict, count in document["counts"].items() if count)
    return f"{len(document['rows'])} rows: {counts}"


def _off(row: Mapping[str, Any]) -> Entry:
    if row["deviation"] is None or (row["at_most"] and row["deviation"] <= 0):
        return None
    if row["deviation_percent"] is None:
        return _cell(row["deviation"], 2)
    return formatted(row["deviation_percent"], "+.1f", "%")


def _cell(value: float | None, digits: int) -> Entry:
    if value is None or not 0.001 <= abs(value) < 1e5:
        return formatted(value, digits)
    return formatted(value, f".{digits}g" if abs(value) < 10**digits else ".0f")
