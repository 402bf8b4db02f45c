"""Tables of a fit: parameters, modes, static gains, and a summary in words."""

from __future__ import annotations

from collections.abc import Sequence
from math import floor, log10

from gbid.report.tables.fit_document import Row
from gbid.report.tables.fit_summary import summary_lines
from gbid.tables.numbers import engineering, exponent_of, shown_unit
from gbid.tables.table import Cell, Column, Entry, Table, formatted

# Heading, unit, entries of the row, and smallest number of decimals of a mode.
_MODE = (
    ("frequency\n", "Hz", "frequency_hz", "frequency_std_hz", "true_frequency_hz", 2),
    ("damping\nfactor", "", "damping", "damping_std", "true_damping", 4),
)


def fit_tables(title: str, document: Row) -> list[Table]:
    """Return the tables of a fit: parameters, modes, static gain and summary.

    Parameters
    ----------
    title : str
        Title of the first table.
    document : dict
        Document of `gbid.report.tables.fit_document.fit_document`.
    """
    tables = [parameter_table(title, document["parameters"], document["trusted"])]
    if document["modes"]:
        tables.append(mode_table(document["modes"]))
    if document["static_gain"]:
        tables.append(gain_table(document["static_gain"]))
    return [*tables, Table("", [Column(""), Column("", wrap=True)], list(summary_lines(document)))]


def parameter_table(title: str, rows: Sequence[Row], trusted: str) -> Table:
    """Return the table of estimates, standard deviations and truth; the numbers of a row have one power of ten."""
    with_truth = any(row["truth"] is not None for row in rows)
    columns = [Column("parameter"), Column("estimate", format=5), Column(f"std\n({trusted})", format=2)]
    if with_truth:
        columns += [Column("truth", format=5), Column("off by", format="+.2f"), Column("in std", format="+.1f")]
    laid: list[list[Entry]] = []
    for row in rows:
        factor, unit = shown_unit(row["unit"])
        estimate, spread = factor * row["estimate"], factor * (row["std"] or 0.0)
        exponent = exponent_of(max(abs(estimate), spread))
        std = Cell(None, "fixed") if row["fixed"] else _in_power(row["std"], 2, exponent, factor)
        cells = [row["parameter"], _in_power(row["estimate"], _digits(estimate, spread), exponent, factor), std]
        if with_truth:
            off = formatted(row["deviation_percent"], "+.2f", "%")
            cells += [_in_power(row["truth"], 5, exponent, factor), off, row["deviation_std"]]
        laid.append([*cells, unit])
    return Table(title, [*columns, Column("unit")], laid)


def mode_table(rows: Sequence[Row]) -> Table:
    """Return the table of natural frequencies and damping factors."""
    with_truth = any(row["true_frequency_hz"] is not None for row in rows)
    columns = [Column("mode")]
    for heading, unit, *_, least in _MODE:
        form = f".{least}f"
        columns += [Column(heading, unit, form), Column("std", format=form)]
        columns += [Column("truth", format=form)] if with_truth else []
    laid: list[list[Entry]] = []
    for row in rows:
        laid.append([str(row["mode"])])
        for *_, key, std, true, least in _MODE:
            own = f".{_decimals(row[std], least)}f"
            laid[-1] += [formatted(row[name], own) for name in (key, std, *([true] if with_truth else []))]
    return Table("", columns, laid)


def gain_table(rows: Sequence[Row]) -> Table:
    """Return the table of static gains; those that are zero by structure are left out."""
    with_truth = any(row["truth"] is not None for row in rows)
    columns = [Column("static gain"), Column("value", format=5), Column("std", format=2)]
    laid: list[list[Entry]] = []
    for row in rows:
        if row["gain"] != 0 or row["std"]:
            exponent = exponent_of(row["gain"])
            cells = [_in_power(row["gain"], 5, exponent), _in_power(row["std"], 2, exponent)]
            cells += [_in_power(row["truth"], 5, exponent)] if with_truth else []
            laid.append([f"{row['input']} to {row['output']}", *cells])
    return Table("", [*columns, *([Column("truth", format=5)] if with_truth else [])], laid)


def _in_power(value: float | None, digits: int, exponent: int, factor: float = 1.0) -> Entry:
    """Return a cell in a given power of ten, so that the numbers of a row can be compared."""
    return None if value is None else Cell(factor * value, engineering(factor * value, digits, exponent))


def _digits(estimate: float, std: float) -> int:
    """Return the number of significant digits of an estimate: five, or enough to show its standard deviation."""
    if estimate == 0 or abs(estimate) >= std:
        return 5
    return max(1, 2 + floor(log10(abs(estimate))) - floor(log10(std)))


def _decimals(std: float | None, least: int) -> int:
    """Return the number of decimals that show two digits of a standard deviation."""
    return least if not std else min(max(least, 1 - floor(log10(std))), 7)
