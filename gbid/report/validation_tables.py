"""Tables of what a cross-validation says as a whole, and of the nominal actuator."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

from rich.table import Table

from gbid.operating_point import point_label
from gbid.report.rows import Row
from gbid.report.tables import new_table
from gbid.tables.numbers import engineering
from gbid.validate import NominalActuator, ValidationSummary

_POINTS = 30  # operating points up to which each has its lines


def summary_document(fit: str, summary: ValidationSummary, path: Path) -> Row:
    """Everything in a summary of a cross-validation, histograms included."""
    return {"fit": fit, **asdict(summary), "path": str(path)}


def validation_table(document: Row) -> Table:
    """Mean and standard deviation of the fit percent of each output, over all pairs and by operating point.

    Parameters
    ----------
    document : dict
        From `summary_document`.
    """
    title = (
        f"{document['fit']}, cross-validation: {document['n_models']} models, "
        f"{document['n_recordings']} recordings, {document['n_pairs']} pairs"
    )
    columns = ["", "output", "pairs", "fit\n[%]", "+-\n[%]", "least\n[%]", "largest\nerror", "worst pair"]
    table = new_table(title, columns, left=("", "output", "worst pair"))
    names, units = document["output_names"], document["output_units"]
    for j, (output, unit) in enumerate(zip(names, units, strict=True)):
        worst = next(iter(pair for pair in document["worst"] if pair["output"] == output), None)
        table.add_row(
            "all" if j == 0 else "",
            output,
            str(document["n_pairs"]),
            *_percent(document["mean"][j], document["std"][j]),
            f"{document['least'][j]:.2f}",
            _largest(document["infinity_norm_max"][j], unit),
            f"{worst['model']} on {worst['recording']}" if worst else "-",
        )
    points = document["points"] if 1 < len(document["points"]) <= _POINTS else ()
    for point in points:
        for j, (output, unit) in enumerate(zip(names, units, strict=True)):
            table.add_row(
                point_label(point["pressure_bar"], point["speed_rpm"]) if j == 0 else "",
                output,
                str(point["n_pairs"]),
                *_percent(point["mean"][j], point["std"][j]),
                "",
                _largest(point["infinity_norm"][j], unit),
                "",
            )
    return table


def nominal_document(fit: str, nominal: NominalActuator, path: Path) -> Row:
    """Tell the nominal actuator with the outliers and why they are."""
    return {
        "fit": fit,
        "model": nominal.name,
        "parameters": nominal.parameters,
        "std": nominal.std,
        "chosen_from": len(nominal.models),
        "distance": float(nominal.distances.min()),
        "outliers": [{**asdict(outlier), "reason": outlier.reason} for outlier in nominal.outliers],
        "left_out": list(nominal.left_out),
        "path": str(path),
    }


def nominal_table(document: Row) -> Table:
    """Poles and gains of the nominal actuator, then the outliers.

    Parameters
    ----------
    document : dict
        From `nominal_document`.
    """
    off = bool(document["outliers"] or document["left_out"])
    columns = ["most central model", "parameter", "value", "std", *(["why"] if off else [])]
    table = new_table(f"{document['fit']}, nominal actuator", columns, left=("most central model", "parameter", "why"))
    first = [document["model"], f"of {document['chosen_from']} models"]
    for i, (name, value) in enumerate(document["parameters"].items()):
        std = document["std"][name]
        shown = "-" if std != std else f"{std:.2g}"
        table.add_row(first[i] if i < len(first) else "", name, f"{value:.5g}", shown)
    for outlier in document["outliers"]:
        table.add_row(
            f"outlier {outlier['model']}", outlier["parameter"], f"{outlier['value']:.5g}", "", outlier["reason"]
        )
    for text in document["left_out"]:
        table.add_row("left out", "", "", "", text)
    return table


def _percent(mean: float, std: float) -> tuple[str, str]:
    return f"{mean:.2f}", "-" if std != std else f"{std:.2g}"


def _largest(value: float, unit: str) -> str:
    factor, shown = (1e6, "µm") if unit == "m" else (1.0, unit)
    return f"{engineering(factor * value, 2)} {shown}"
