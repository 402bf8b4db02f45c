"""Tables of a campaign: states of the items of each stage, and a summary of the fits."""

from __future__ import annotations

from gbid.report.tables.fit_document import Row
from gbid.tables.table import Column, Table

_STATES = ("made", "kept", "failed", "not_converged")
_COUNTS = ("fits", "converged", "missing")


def campaign_tables(document: Row) -> list[Table]:
    """Return the tables of the stages and of the fits of a campaign; empty tables are left out."""
    heads = [Column("stage"), *(Column(state.replace("_", " "), format="d") for state in _STATES)]
    stages = [[stage, *(counts[state] for state in _STATES)] for stage, counts in document["stages"].items()]
    columns = [
        Column("fit"),
        *(Column(name, format="d") for name in _COUNTS),
        Column("median", "%"),
        Column("worst", "%", ".1f", missing=""),
        Column("of", missing=""),
    ]
    fits = []
    for row in document["fits"]:
        medians = ", ".join(f"{output} {value:.1f}" for output, value in row["median_fit_percent"].items())
        fits.append([row["fit"], *(row[name] for name in _COUNTS), medians, row["worst_fit_percent"], row["worst"]])
    return [table for table in (Table("", heads, stages), Table("", columns, fits)) if table.rows]
