"""Documents and tables of a cross-validation, for each pair and in summary, and of the nominal actuator."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from gbid.operating_point import point_label
from gbid.report.tables.fit_document import Row
from gbid.tables.table import Column, Entry, Table, formatted
from gbid.validate import NominalActuator, ValidationSummary

_POINTS = 30  # largest number of operating points that have their own rows
_PERCENT = (Column("fit\n", "%", ".2f"), Column("+-\n", "%", ".2g"), Column("least\n", "%", ".2f"))


def crossval_table(title: str, rows: Sequence[Row]) -> Table:
    """Return the table of the fit percent of each model on each recording, and of the residual tests."""
    columns = [
        *map(Column, ("model of", "on", "output")),
        Column("fit\n", "%", ".2f"),
        Column("largest\nerror", format=2),
        Column("residuals\nwhite", format="s"),
        Column("follow"),
    ]
    missed = any(row["missed"] for row in rows)
    laid: list[list[Entry]] = []
    for row in rows:
        cells = [*(row[key] for key in ("model", "recording", "output", "fit_percent"))]
        cells += [formatted(row["infinity_norm"], 2, row["unit"]), row["residuals_white"]]
        cells += [", ".join(row["residuals_follow"]) or None]
        cells += [f"below {row['minimum_percent']:g} %" if row["missed"] else ""] if missed else []
        laid.append(cells)
    return Table(f"{title}, cross-validation, simulated", [*columns, *([Column("")] if missed else [])], laid)


def summary_document(fit: str, summary: ValidationSummary, path: Path) -> Row:
    """Return the summary of a cross-validation as plain values, with histograms."""
    return {"fit": fit, **asdict(summary), "path": str(path)}


def validation_table(document: Row) -> Table:
    """Return the table of mean and std of the fit percent of each output, over all pairs and by operating point.

    Parameters
    ----------
    document : dict
        Document of `summary_document`.
    """
    title = (
        f"{document['fit']}, cross-validation: {document['n_models']} models, "
        f"{document['n_recordings']} recordings, {document['n_pairs']} pairs"
    )
    columns = [
        *(Column(""), Column("output"), Column("pairs", format="d")),
        *_PERCENT,
        Column("largest\nerror", format=2),
        Column("worst pair"),
    ]
    outputs = list(enumerate(zip(document["output_names"], document["output_units"], strict=True)))
    rows: list[list[Entry]] = []
    for j, (output, unit) in outputs:
        worst = next((pair for pair in document["worst"] if pair["output"] == output), None)
        numbers = (document["n_pairs"], *(document[name][j] for name in ("mean", "std", "least")))
        largest = formatted(document["infinity_norm_max"][j], 2, unit)
        pair = f"{worst['model']} on {worst['recording']}" if worst else None
        rows.append(["all" if j == 0 else "", output, *numbers, largest, pair])
    for point in document["points"] if 1 < len(document["points"]) <= _POINTS else ():
        place = point_label(point["pressure_bar"], point["speed_rpm"])
        for j, (output, unit) in outputs:
            largest = formatted(point["infinity_norm"][j], 2, unit)
            numbers = (point["n_pairs"], point["mean"][j], point["std"][j])
            rows.append([place if j == 0 else "", output, *numbers, "", largest, ""])
    return Table(title, columns, rows)


def nominal_document(fit: str, nominal: NominalActuator, path: Path) -> Row:
    """Return the nominal actuator as plain values, with the outliers and their reasons."""
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
    """Return the table of poles and gains of the nominal actuator, then of the outliers.

    Parameters
    ----------
    document : dict
        Document of `nominal_document`.
    """
    off = bool(document["outliers"] or document["left_out"])
    columns = [Column("most central model"), Column("parameter"), Column("value", format=".5g")]
    columns += [Column("std", format=".2g"), *([Column("why")] if off else [])]
    first = [document["model"], f"of {document['chosen_from']} models"]
    rows: list[list[Entry]] = [
        [first[i] if i < len(first) else "", name, value, document["std"][name], *([""] if off else [])]
        for i, (name, value) in enumerate(document["parameters"].items())
    ]
    for outlier in document["outliers"]:
        rows.append([f"outlier {outlier['model']}", outlier["parameter"], outlier["value"], "", outlier["reason"]])
    rows += [["left out", "", "", "", text] for text in document["left_out"]]
    return Table(f"{document['fit']}, nominal actuator", columns, rows)
