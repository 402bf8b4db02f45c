"""Documents and tables of impacts, like Tables 3 and 4 of the paper: expected from the model, and identified."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from gbid.control.impact.impact_store import mode_rows, response_rows
from gbid.control.impact.study import ImpactStudy
from gbid.lpv import ReferenceModes
from gbid.operating_point import point_label
from gbid.report.tables.fit_document import Row
from gbid.tables.table import Column, Entry, Table, formatted

IMPACT_FIGURES = (("peak", "m", 1e6), ("decay", "s", 1e3), ("piezo", "m", 1e6))
"""Figures of impacts in the rows of responses: name, unit, factor to the unit of tables."""
_PAPER = ("open", "closed")
"""Loops in Tables 3 and 4."""


class _ModeQuantity(NamedTuple):
    """Quantity of a mode: symbol and unit, key in documents, column of published values, decimals."""

    words: str
    sign: str
    unit: str
    key: str
    column: int
    digits: int

    def of(self, document: Row, mode: int, entry: str) -> Any:
        """Return the value of a mode of a study; None without such a mode."""
        name = entry.format(self.key) + (f" [{self.unit}]" if self.unit else "")
        return next((row[name] for row in document["modes"] if row["mode"] == mode), None)


_QUANTITIES = (
    _ModeQuantity("natural frequencies", "ω", "Hz", "frequency", 0, 1),
    _ModeQuantity("damping factors", "ζ", "", "damping", 1, 3),
)
# Heading, entry of a mode with the key of the quantity, and number of further decimals.
_LINES = (
    ("expected from model", "expected_{}", 0),
    ("expected, sampled loop", "running_{}", 0),
    ("obtained from the impacts", "obtained_{}", 2),
    ("  standard deviation", "obtained_{}_std", 2),
)


def impact_document(name: str, study: ImpactStudy, path: Path, published: Sequence[ReferenceModes] = ()) -> Row:
    """Return the document of an impact study as plain values.

    Parameters
    ----------
    name : str
        Name of the study.
    study : ImpactStudy
        The study.
    path : path
        File of the study.
    published : sequence of ReferenceModes
        Published modes of the machine; those of this operating point and loop are added.
    """
    ring = study.ringdown
    here = [
        m
        for m in published
        if (m.pressure_bar, m.speed_rpm) == (study.conditions["pressure_bar"], study.conditions["speed_rpm"])
        and m.loop == study.loop
    ]
    return {
        "name": name,
        "path": str(path),
        **study.conditions,
        "loop": study.loop,
        "model": study.model,
        "controller": study.controller,
        "status": ring.status,
        "success": ring.success,
        "notes": list(ring.notes),
        "impacts": ring.n_impacts,
        "lag_rates": ring.lag_rates.tolist(),
        "residual_rms": ring.residual_rms.tolist(),
        "modes": mode_rows(study),
        "published": {m.kind: [list(mode) for mode in m.modes] for m in here if m.kind in ("expected", "measured")},
        "responses": response_rows(study),
    }


def impact_tables(documents: Sequence[Row]) -> list[Table]:
    """Return tables of frequencies, damping factors, force scaling and figures, for each operating point.

    Parameters
    ----------
    documents : sequence of dict
        Documents of `impact_document`.
    """
    tables = []
    for pressure, speed in dict.fromkeys((d["pressure_bar"], d["speed_rpm"]) for d in documents):
        here = {d["loop"]: d for d in documents if (d["pressure_bar"], d["speed_rpm"]) == (pressure, speed)}
        where = point_label(pressure, speed)
        paper = {loop: document for loop, document in here.items() if loop in _PAPER}
        tables += [_quantity_table(where, paper, quantity) for quantity in _QUANTITIES if paper]
        for loop, document in here.items():
            if loop not in paper:
                shown = [(f"{q.sign}{mode}", document, mode, q) for q in _QUANTITIES for mode in (1, 2)]
                tables.append(_mode_table(f"{where}: {loop}", shown))
        tables.append(_response_table(where, list(here.values())))
        tables.append(_impact_figures_table(where, list(here.values())))
    return tables


def _quantity_table(where: str, here: Mapping[str, Row], quantity: _ModeQuantity) -> Table:
    """Return the table of natural frequencies or damping factors in open and closed loop, with those of the paper."""
    shown = [
        (f"{quantity.sign}{mode},{'ol' if loop == 'open' else 'cl'}", here[loop], mode, quantity)
        for mode in (1, 2)
        for loop in _PAPER
        if loop in here
    ]
    more: list[list[Entry]] = []
    for words, kind in (("paper: expected from model", "expected"), ("paper: obtained experimentally", "measured")):
        modes = [document["published"].get(kind) for _, document, *_ in shown]
        if any(known is not None for known in modes):
            values = [
                known and known[mode - 1][quantity.column] for known, (*_, mode, _) in zip(modes, shown, strict=True)
            ]
            more.append([words, *(formatted(value, f".{quantity.digits}f") for value in values)])
    return _mode_table(f"{where}: {quantity.words}", shown, more)


def _mode_table(
    title: str, shown: Sequence[tuple[str, Row, int, _ModeQuantity]], more: Sequence[list[Entry]] = ()
) -> Table:
    """Return the table of expected and identified modes; a column is a quantity of one mode of one study."""
    rows: list[list[Entry]] = []
    closed = any(document["controller"] for _, document, *_ in shown)
    for words, entry, decimals in _LINES:
        if closed or "running" not in entry:
            cells = (
                formatted(q.of(document, mode, entry), f".{q.digits + decimals}f") for _, document, mode, q in shown
            )
            rows.append([words, *cells])
    columns = [Column(heading, quantity.unit, 4) for heading, _, _, quantity in shown]
    return Table(title, [Column(""), *columns], [*rows, *more])


def _response_table(where: str, documents: Sequence[Row]) -> Table:
    """Return the table of measured and simulated responses."""
    columns = {
        "recording": Column("recording"),
        "impacts": Column("impacts", format="d"),
        "force_scale [1/kg]": Column("g_f", "1/kg", ".4f"),
        "force_scale_std [1/kg]": Column("std", format=".4f"),
        "fit_along [%]": Column("fit along\nthe impact", "%", ".2f"),
        "fit_x [%]": Column("fit x", "%", ".2f"),
        "fit_y [%]": Column("fit y", "%", ".2f"),
    }
    rows = [[row[key] for key in columns] for document in documents for row in document["responses"]]
    return Table(f"{where}: measured against simulated responses, p = g_f G f", list(columns.values()), rows)


def _impact_figures_table(where: str, documents: Sequence[Row]) -> Table:
    """Return the table of measured and simulated motion of disc and piezos, with the notes of all tables."""
    columns = [Column("recording")]
    for name, unit in (("disc up to\n", "um"), ("over after\n", "ms"), ("piezo up to\n", "um")):
        columns += [Column(name, unit, ".2f"), Column("std", format=".2f"), Column("simulated", format=".2f")]
    keys = [
        (f"{name}{suffix} [{unit}]", factor)
        for name, unit, factor in IMPACT_FIGURES
        for suffix in ("", "_std", "_simulated")
    ]
    rows: list[list[Entry]] = [
        [row["recording"], *(None if row[key] is None else factor * row[key] for key, factor in keys)]
        for document in documents
        for row in document["responses"]
    ]
    notes = []
    for document in documents:
        notes += [f"note, {document['loop']} loop: {note}" for note in document["notes"]]
        notes += [] if document["success"] else [f"{document['loop']} loop: {document['status']}"]
    return Table(f"{where}: after an impact, mean over the impacts", columns, rows, ["", *notes] if notes else ())
