"""Impacts as documents and as tables like Tables 3 and 4 of the paper: expected from the model, obtained."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Group
from rich.table import Table
from rich.text import Text

from gbid.control.impact.impact_store import mode_rows, response_rows
from gbid.control.impact.study import ImpactStudy
from gbid.lpv import ReferenceModes
from gbid.operating_point import point_label
from gbid.report.rows import Row
from gbid.report.tables import new_table

IMPACT_FIGURES = (("peak", "m", 1e6), ("decay", "s", 1e3), ("piezo", "m", 1e6))
"""Figures of impacts in the rows of responses: name, unit, factor to what tables show."""
_PAPER = ("open", "closed")
"""Loops that Tables 3 and 4 have."""
_QUANTITIES = (
    ("natural frequencies", "ω", " \\[Hz]", "frequency", 0, 1),
    ("damping factors", "ζ", "", "damping", 1, 3),
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


def impact_tables(documents: Sequence[Row]) -> Group:
    """Frequencies, damping factors and force scaling, operating point by operating point.

    Parameters
    ----------
    documents : sequence of dict
        From `impact_document`.
    """
    parts: list[Table | Text] = []
    points = dict.fromkeys((d["pressure_bar"], d["speed_rpm"]) for d in documents)
    for pressure, speed in points:
        here = {d["loop"]: d for d in documents if (d["pressure_bar"], d["speed_rpm"]) == (pressure, speed)}
        where = point_label(pressure, speed)
        paper = {loop: document for loop, document in here.items() if loop in _PAPER}
        for what, sign, unit, key, column, digits in _QUANTITIES if paper else ():
            parts += [_mode_table(f"{where}: {what}", paper, sign, unit, key, column, digits), Text("")]
        for loop, document in here.items():
            if loop not in paper:
                parts += [_loop_table(f"{where}: {loop}", document), Text("")]
        parts += [_response_table(where, list(here.values())), Text("")]
        parts += [_impact_figures_table(where, list(here.values())), Text("")]
        for document in here.values():
            parts += [Text(f"note, {document['loop']} loop: {note}") for note in document["notes"]]
            if not document["success"]:
                parts.append(Text(f"{document['loop']} loop: {document['status']}"))
    return Group(*parts)


def _loop_table(title: str, document: Row) -> Table:
    """Modes of a further closed loop."""
    heads = [f"{sign}{mode}{unit}" for _, sign, unit, *_ in _QUANTITIES for mode in (1, 2)]
    table = new_table(title, ["", *heads], left=("",))
    for words, prefix, suffix, more in (
        ("expected from model", "expected", "", 0),
        ("expected as it runs, sampled", "running", "", 0),
        ("obtained from the impacts", "obtained", "", 2),
        ("  standard deviation", "obtained", "_std", 2),
    ):
        cells = []
        for *_, key, _, digits in _QUANTITIES:
            ending = " [Hz]" if key == "frequency" else ""
            entry = f"{prefix}_{key}{suffix}{ending}"
            cells += [_cell(_mode(document, mode, entry), digits + more) for mode in (1, 2)]
        table.add_row(words, *cells)
    return table


def _mode_table(title: str, here: Mapping[str, Row], sign: str, unit: str, key: str, column: int, digits: int) -> Table:
    columns = [(mode, loop) for mode in (1, 2) for loop in ("open", "closed") if loop in here]
    heads = [f"{sign}{mode},{'ol' if loop == 'open' else 'cl'}{unit}" for mode, loop in columns]
    ending = " [Hz]" if key == "frequency" else ""
    table = new_table(title, ["", *heads], left=("",))
    closed = next((d["controller"] for d in here.values() if d["controller"]), "")
    for words, entry, precision in (
        ("expected from model", f"expected_{key}{ending}", digits),
        ("expected as it runs, sampled" if closed else "", f"running_{key}{ending}", digits),
        ("obtained from the impacts", f"obtained_{key}{ending}", digits + 2),
        ("  standard deviation", f"obtained_{key}_std{ending}", digits + 2),
    ):
        if words:
            table.add_row(words, *(_cell(_mode(here[loop], mode, entry), precision) for mode, loop in columns))
    for words, kind in (("paper: expected from model", "expected"), ("paper: obtained experimentally", "measured")):
        values = [_published(here[loop], kind, mode, column) for mode, loop in columns]
        if any(value is not None for value in values):
            table.add_row(words, *(_cell(value, digits) for value in values))
    return table


def _response_table(where: str, documents: Sequence[Row]) -> Table:
    title = f"{where}: measured against simulated responses, p = g_f G f"
    heads = ["recording", "impacts", "g_f \\[1/kg]", "std", "fit along\nthe impact \\[%]", "fit x \\[%]", "fit y \\[%]"]
    table = new_table(title, heads)
    for document in documents:
        for row in document["responses"]:
            table.add_row(
                row["recording"],
                str(row["impacts"]),
                f"{row['force_scale [1/kg]']:.4f}",
                f"{row['force_scale_std [1/kg]']:.4f}",
                *(f"{row[key]:.2f}" for key in ("fit_along [%]", "fit_x [%]", "fit_y [%]")),
            )
    return table


def _impact_figures_table(where: str, documents: Sequence[Row]) -> Table:
    """Lay out what an impact does to disc and piezos, measured and simulated."""
    title = f"{where}: after an impact, mean over the impacts"
    heads = ["recording"]
    for what, unit in (("disc up to", "um"), ("over after", "ms"), ("piezo up to", "um")):
        heads += [f"{what}\n\\[{unit}]", "std", "simulated"]
    table = new_table(title, heads)
    for document in documents:
        for row in document["responses"]:
            cells = []
            for name, unit, factor in IMPACT_FIGURES:
                for suffix in ("", "_std", "_simulated"):
                    cells.append(_cell(factor * row[f"{name}{suffix} [{unit}]"], 2))
            table.add_row(row["recording"], *cells)
    return table


def _mode(document: Row, mode: int, entry: str) -> Any:
    return next((row[entry] for row in document["modes"] if row["mode"] == mode), None)


def _published(document: Row, kind: str, mode: int, column: int) -> Any:
    modes = document["published"].get(kind)
    return None if modes is None else modes[mode - 1][column]


def _cell(value: float | None, digits: int) -> str:
    return "-" if value is None or value != value else f"{value:.{digits}f}"
