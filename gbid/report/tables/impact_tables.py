"""Impacts as documents and as tables like Tables 3 and 4 of the paper: expected from the model, obtained."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from gbid.control.impact.impact_store import mode_rows, response_rows
from gbid.control.impact.study import ImpactStudy
from gbid.lpv import ReferenceModes
from gbid.operating_point import point_label
from gbid.report.tables.fit_document import Row
from gbid.tables.table import Column, Entry, Table, formatted

IMPACT_FIGURES = (("peak", "m", 1e6), ("decay", "s", 1e3), ("piezo", "m", 1e6))
"""Figures of impacts in the rows of responses: name, unit, factor to what tables show."""
_PAPER = ("open", "closed")
"""Loops that Tables 3 and 4 have."""
_QUANTITIES = (
    ("natural frequencies", "ω", "Hz", "frequency", 0, 1),
    ("damping factors", "ζ", "", "damping", 1, 3),
)

# Words, and how an entry of a mode begins and ends, with so many decimals more.
_LINES = (
    ("expected from model", "expected", "", 0),
    ("expected as it runs, sampled", "running", "", 0),
    ("obtained from the impacts", "obtained", "", 2),
    ("  standard deviation", "obtained", "_std", 2),
)


def impact_document(name: str, study: ImpactStudy, path: Path, published: Sequence[ReferenceModes] = ()) -> Row:
    """Everything that an impact study says, as plain values.

    Parameters
    ----------
    name : str
    study : ImpactStudy
    path : path
    published : sequence of ReferenceModes
        Of the machine; those of this operating point and loop stand beside.
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
    """Tables of frequencies, damping factors, force scaling and figures, operating point by operating point.

    Parameters
    ----------
    documents : sequence of dict
        From `impact_document`.
    """
    tables = []
    for pressure, speed in dict.fromkeys((d["pressure_bar"], d["speed_rpm"]) for d in documents):
        here = {d["loop"]: d for d in documents if (d["pressure_bar"], d["speed_rpm"]) == (pressure, speed)}
        where = point_label(pressure, speed)
        paper = {loop: document for loop, document in here.items() if loop in _PAPER}
        for what, sign, unit, key, column, digits in _QUANTITIES if paper else ():
            tables.append(_mode_table(f"{where}: {what}", paper, sign, unit, key, column, digits))
        tables += [_loop_table(f"{where}: {loop}", document) for loop, document in here.items() if loop not in paper]
        tables.append(_response_table(where, list(here.values())))
        tables.append(_impact_figures_table(where, list(here.values())))
    return tables


def _loop_table(title: str, document: Row) -> Table:
    """Table of the modes of a further closed loop."""
    columns = [Column(f"{sign}{mode}", unit, 4) for _, sign, unit, *_ in _QUANTITIES for mode in (1, 2)]
    rows: list[list[Entry]] = [
        [
            words,
            *(
                formatted(_mode(document, mode, f"{prefix}_{key}{suffix}", unit), f".{digits + more}f")
                for _, _, unit, key, _, digits in _QUANTITIES
                for mode in (1, 2)
            ),
        ]
        for words, prefix, suffix, more in _LINES
    ]
    return Table(title, [Column(""), *columns], rows)


def _mode_table(title: str, here: Mapping[str, Row], sign: str, unit: str, key: str, column: int, digits: int) -> Table:
    """Table of natural frequencies or damping factors, open and closed loop, with those of the paper."""
    shown = [(mode, loop) for mode in (1, 2) for loop in _PAPER if loop in here]
    columns = [Column(f"{sign}{mode},{'ol' if loop == 'open' else 'cl'}", unit, 4) for mode, loop in shown]
    closed = any(document["controller"] for document in here.values())
    rows: list[list[Entry]] = [
        [
            words,
            *(
                formatted(_mode(here[loop], mode, f"{prefix}_{key}{suffix}", unit), f".{digits + more}f")
                for mode, loop in shown
            ),
        ]
        for words, prefix, suffix, more in _LINES
        if closed or prefix != "running"
    ]
    for words, kind in (("paper: expected from model", "expected"), ("paper: obtained experimentally", "measured")):
        values = [_published(here[loop], kind, mode, column) for mode, loop in shown]
        if any(value is not None for value in values):
            rows.append([words, *(formatted(value, f".{digits}f") for value in values)])
    return Table(title, [Column(""), *columns], rows)


def _response_table(where: str, documents: Sequence[Row]) -> Table:
    """Table of measured against simulated responses."""
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
    """Table of what an impact does to disc and piezos, measured and simulated; notes of all tables below."""
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


def _mode(document: Row, mode: int, entry: str, unit: str) -> Any:
    key = f"{entry} [{unit}]" if unit else entry
    return next((row[key] for row in document["modes"] if row["mode"] == mode), None)


def _published(document: Row, kind: str, mode: int, column: int) -> Any:
    modes = document["published"].get(kind)
    return None if modes is None else modes[mode - 1][column]
