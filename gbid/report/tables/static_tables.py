"""Documents (SI units) and tables (micrometres instead of metres) of static maps and piezo curves."""

from __future__ import annotations

import numpy as np

from gbid.characterise import PiezoCurve, StaticMap
from gbid.report.tables.fit_document import Row
from gbid.tables.numbers import finite_or_none, shown_unit
from gbid.tables.table import Column, Table, formatted


def static_document(name: str, result: StaticMap | PiezoCurve) -> Row:
    """Return the document of a static characterisation; unknown values are None.

    Parameters
    ----------
    name : str
        Name of the characterisation.
    result : StaticMap or PiezoCurve
        The result.

    Returns
    -------
    dict
        name, kind, recordings, notes, and a row for each gain of a map, or the figures of a curve.
    """
    if isinstance(result, PiezoCurve):
        steps = ~result.saturated
        return {
            "name": name,
            "kind": "piezo",
            "recordings": [result.name],
            "channel": result.channel,
            "units": list(result.units),
            "hysteresis": finite_or_none(result.hysteresis),
            "hysteresis_std": finite_or_none(result.hysteresis_std),
            "hysteresis_at": finite_or_none(result.hysteresis_at),
            "hysteresis_share": finite_or_none(result.hysteresis_share),
            "range": [float(result.position.min()), float(result.position.max())],
            "step_gain": finite_or_none(float(np.mean(result.step_gain[steps]))) if steps.any() else None,
            "uniformity": finite_or_none(result.uniformity),
            "creep": finite_or_none(float(np.mean(result.creep[steps]))) if steps.any() else None,
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
                "gain": finite_or_none(result.gain[i, j]),
                "std": finite_or_none(result.gain_std[i, j]),
                "lower_95": finite_or_none(interval[i, j, 0]),
                "upper_95": finite_or_none(interval[i, j, 1]),
                "rms": finite_or_none(result.rms[i, j]),
                "largest": finite_or_none(result.largest[i, j]),
                "hysteresis": finite_or_none(result.hysteresis[i, j]),
                "hysteresis_std": finite_or_none(result.hysteresis_std[i, j]),
            }
            for i, output in enumerate(result.output_names)
            for j, source in enumerate(result.input_names)
        ],
        "offset": result.offset.tolist(),
        "notes": list(result.notes),
    }


def static_table(document: Row) -> Table:
    """Return the table of a static characterisation from its document."""
    title = f"{document['name']}: {', '.join(document['recordings'])}"
    source, output = document["units"]
    if document["kind"] == "piezo":
        columns = [Column(document["channel"]), Column("value", format=3)]
        rows = [
            [word, formatted(_times(factor, document[key]), 3, unit)]
            for word, key, factor, unit in (
                ("hysteresis", "hysteresis", 1.0, output),
                ("  its standard error", "hysteresis_std", 1.0, output),
                ("  over the range", "hysteresis_share", 100.0, "%"),
                ("creep per step", "creep", 100.0, "%"),
                ("gain per step", "step_gain", 1.0, f"{output}/{source}"),
                ("non-uniformity of the steps", "uniformity", 100.0, "%"),
            )
        ]
        return Table(title, columns, rows, document["notes"])
    factor, unit = shown_unit(output)
    names = {
        "rms": "rms off\nlinear\n",
        "largest": "largest\n",
        "hysteresis": "hysteresis\n",
        "hysteresis_std": "its std\n",
    }
    columns = [Column("static gain"), Column("value", format=5), Column("std", format=2)]
    columns += [Column(name, unit, 3) for name in names.values()]
    gains = [
        [f"{row['input']} to {row['output']}", row["gain"], row["std"], *(_times(factor, row[key]) for key in names)]
        for row in document["gains"]
    ]
    return Table(title, columns, gains, document["notes"])


def _times(factor: float, value: float | None) -> float | None:
    return None if value is None else factor * value
