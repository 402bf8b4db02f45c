"""Documents and tables of tuned designs and of the published controller."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

from gbid.control.assessment.compare import COLUMNS
from gbid.control.assessment.point_assessment import FIGURES
from gbid.control.assessment.tuned_design import DesignFigures, TunedDesign
from gbid.control.impact.half_sine import HalfSine
from gbid.control.tuning.gain_result import GainResult
from gbid.experiment.run.outcome import Outcome
from gbid.operating_point import point_label
from gbid.report.reader.designs import conditions_words
from gbid.report.tables.fit_document import Row
from gbid.tables.table import Column, Table, formatted


def tuning_documents(outcomes: Sequence[Outcome], designs: Mapping[str, TunedDesign]) -> list[Row]:
    """Return the documents of tuned designs as plain values; failed ones are left out."""
    paths = {(o.stage, o.item): str(o.path) for o in outcomes if o.state != "failed"}
    return [
        {
            "design": name,
            "path": paths["tune", name],
            "controller": paths.get(("controller", name)),
            "plant": design.plant,
            "structure": design.performance[0].structure,
            **_result_row(design.result),
            "points": [list(point) for point in design.result.points],
            "sample_time_s": design.sample_time,
            "method": design.method,
            "impact": {"peak_n": design.impact.peak_n, "duration_s": design.impact.duration_s},
            "performance": [_performance_row(performance) for performance in design.performance],
            "pareto": [{"cap": cap, **_result_row(result)} for cap, result in design.front],
            "promises": [{**promise._asdict(), "holds": promise.holds} for promise in design.promises],
        }
        for name, design in designs.items()
    ]


def tuning_tables(documents: Sequence[Row]) -> list[Table]:
    """Return tables that compare designs at the same points of the same plant, with their gains below.

    Parameters
    ----------
    documents : sequence of dict
        Documents of `tuning_documents`.
    """
    groups: dict[tuple[Any, ...], list[Row]] = {}
    for document in documents:
        impact = tuple(document["impact"].values())
        points = tuple(map(tuple, document["points"]))
        alike = document["plant"], points, impact, document["sample_time_s"], document["method"]
        groups.setdefault(alike, []).append(document)
    tables = []
    for (plant, points, impact, sample_time, method), group in groups.items():
        where = point_label(*points[0]) if len(points) == 1 else f"{len(points)} operating points"
        note = conditions_words(HalfSine(*impact), sample_time, method)
        shown = [document["performance"][0] for document in group] + group[0]["performance"][1:]
        worst = {row["name"]: {name: found["value"] for name, found in row["worst"].items()} for row in shown}
        notes = [note, *(line for document in group for line in ("", *_lines(document)))]
        tables.append(_compared(f"{plant}, worst over {where}", worst, notes))
    return tables


def comparison_table(title: str, performances: Sequence[DesignFigures], note: str) -> Table:
    """Return the table of the worst figures of designs with equal assessment, a row for each figure.

    Parameters
    ----------
    title : str
        Title of the table.
    performances : sequence of DesignFigures
        Performance of the designs.
    note : str
        Conditions, from `gbid.report.reader.designs.conditions_words`.
    """
    worst = {p.name: {name: value for name, (value, _) in p.worst.items()} for p in performances}
    return _compared(title, worst, [note])


def _compared(title: str, worst: Mapping[str, Mapping[str, float]], notes: Sequence[str]) -> Table:
    rows = [
        [heading, *(formatted(factor * figures[name], form) for figures in worst.values())]
        for heading, name, factor, form in COLUMNS
    ]
    return Table(title, [Column("figure"), *(Column(name, format=4) for name in worst)], rows, notes)


def _lines(document: Row) -> list[str]:
    gains = ", ".join(f"{name} = {value:.5g}" for name, value in document["gains"].items())
    held = f"; limited by {', '.join(document['active'])}" if document["active"] else ""
    unit = " 1/s" if document["objective"] == "decay" else ""
    worst = document["worst"]
    lines = [
        f"{document['design']} ({document['structure']}): {gains}",
        f"  {document['status']}: {document['objective']} {document['value']:.4f}{unit}{held}",
        f"  worst mode: {worst['frequency_hz']:.1f} Hz, damping {worst['damping']:.4f}, at {worst['where']}",
        f"  checked: {document['verified_on']}",
        *(f"  note: {note}" for note in document["notes"]),
    ]
    for row in document["goals"]:
        kind = "objective" if row["soft"] else "limit"
        lines.append(f"  {kind} on {row['name']}: {row['excess']:+.4f} beyond it, at {row['where']}")
    for row in document["promises"]:
        lines.append(
            f"  with probability {row['probability']:g}: {row['promised']:.4f}, limits kept with at least "
            f"{row['keeps_limits']:.3f}; nominal design {row['of_nominal']:.4f}, {row['limits_of_nominal']:.3f}"
        )
    for row in document["pareto"]:
        found = f"{row['value']:.4f}" if row["success"] else row["status"]
        lines.append(f"  peak of S_o at most {row['cap']:g}: {row['objective']} {found}")
    if document["controller"]:
        lines.append(f"  controller: {document['controller']}")
    return lines


def _result_row(result: GainResult) -> Row:
    names = ("value", "objective", "status", "success", "violation", "verified_on")
    peaks = ("peak_sensitivity", "peak_control", "static_amplification")
    return {
        "gains": dict(result.gains),
        **{name: getattr(result, name) for name in (*names, *peaks)},
        "worst": {
            "where": result.worst.where,
            "frequency_hz": result.worst.frequency_hz,
            "damping": result.worst.damping,
        },
        "active": list(result.active),
        "goals": [asdict(figure) for figure in result.goals],
        "notes": list(result.notes),
    }


def _performance_row(performance: DesignFigures) -> Row:
    return {
        "name": performance.name,
        "structure": performance.structure,
        "gains": dict(performance.gains),
        "worst": {
            figure: {"value": value, "pressure_bar": point[0], "speed_rpm": point[1]}
            for figure, (value, point) in performance.worst.items()
        },
        "points": [
            {"pressure_bar": float(p), "speed_rpm": float(n), **dict(zip(FIGURES, map(float, row), strict=True))}
            for (p, n), row in zip(performance.points, performance.figures, strict=True)
        ],
    }
