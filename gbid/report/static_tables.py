"""Static maps and piezo curves as documents (SI) and as tables (micrometres where they are metres)."""

from __future__ import annotations

from typing import Any

import numpy as np
from rich import box
from rich.table import Table

from gbid.characterise import PiezoCurve, StaticMap
from gbid.report.rows import Row
from gbid.tables.numbers import engineering


def static_document(name: str, result: StaticMap | PiezoCurve) -> Row:
    """Everything a reader wants to know about a static characterisation; what is not known is None.

    Parameters
    ----------
    name : str
        Of the characterisation.
    result : StaticMap or PiezoCurve

    Returns
    -------
    dict
        name, kind, recordings, notes, and for a map a row for each gain, for a curve its figures.
    """
    if isinstance(result, PiezoCurve):
        steps = ~result.saturated
        return {
            "name": name,
            "kind": "piezo",
            "recordings": [result.name],
            "channel": result.channel,
            "units": list(result.units),
            "hysteresis": _known(result.hysteresis),
            "hysteresis_std": _known(result.hysteresis_std),
            "hysteresis_at": _known(result.hysteresis_at),
            "hysteresis_share": _known(result.hysteresis_share),
            "range": [float(result.position.min()), float(result.position.max())],
            "step_gain": _known(float(np.mean(result.step_gain[steps]))) if steps.any() else None,
            "uniformity": _known(result.uniformity),
            "creep": _known(float(np.mean(result.creep[steps]))) if steps.any() else None,
            "steps": len(result.step),
            "saturated_steps": [int(i) + 1 for i in np.flatnonzero(result.saturated)],
            "notes": list(result.notes),
        }
    interval = result.interval()
    return {
        "name": name,
        "kind": "bearing",
        "recordings": list(result.sources),
        "conditions": dict(result.conditions),
        "units": list(result.units),
        "plateaus": len(result.command),
        "dof": result.dof,
        "gains": [
            {
                "output": output,
                "input": source,
                "gain": _known(result.gain[i, j]),
                "std": _known(result.gain_std[i, j]),
                "lower_95": _known(interval[i, j, 0]),
                "upper_95": _known(interval[i, j, 1]),
                "rms": _known(result.rms[i, j]),
                "largest": _known(result.largest[i, j]),
                "hysteresis": _known(result.hysteresis[i, j]),
                "hysteresis_std": _known(result.hysteresis_std[i, j]),
            }
            for i, output in enumerate(result.output_names)
            for j, source in enumerate(result.input_names)
        ],
        "offset": result.offset.tolist(),
        "notes": list(result.notes),
    }


def static_table(document: Row) -> Table:
    """Table of one characterisation, from its document."""
    title = f"{document['name']}: {', '.join(document['recordings'])}"
    caption = "; ".join(document["notes"]) or None
    if document["kind"] == "piezo":
        table = Table(title=title, caption=caption, box=box.SIMPLE_HEAD, title_justify="left")
        table.add_column(document["channel"])
        table.add_column("value", justify="right")
        unit, factor = _shown(document["units"][1])
        for word, key, scale, ending in (
            ("hysteresis", "hysteresis", factor, unit),
            ("  its standard error", "hysteresis_std", factor, unit),
            ("  over the range", "hysteresis_share", 100.0, "%"),
            ("creep per step", "creep", 100.0, "%"),
            ("gain per step", "step_gain", 1.0, f"{document['units'][1]}/{document['units'][0]}"),
            ("non-uniformity of the steps", "uniformity", 100.0, "%"),
        ):
            table.add_row(word, f"{_cell(document[key], scale)} {ending}")
        return table
    unit, factor = _shown(document["units"][1])
    table = Table(title=title, caption=caption, box=box.SIMPLE_HEAD, title_justify="left")
    for column in (
        *("static gain", "value", "std"),
        *(f"{word}\n\\[{unit}]" for word in ("rms off\nlinear", "largest", "hysteresis", "its std")),
    ):
        table.add_column(column, justify="left" if column == "static gain" else "right")
    for row in document["gains"]:
        lengths = [_cell(row[key], factor) for key in ("rms", "largest", "hysteresis", "hysteresis_std")]
        table.add_row(
            f"{row['input']} to {row['output']}", engineering(row["gain"], 5), engineering(row["std"], 2), *lengths
        )
    return table


def _shown(unit: str) -> tuple[str, float]:
    return ("um", 1e6) if unit == "m" else (unit, 1.0)


def _cell(value: Any, factor: float) -> str:
    return "-" if value is None else engineering(factor * value, 3)


def _known(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
