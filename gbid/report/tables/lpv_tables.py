"""Tables of the deviations of fits from the surfaces over pressure and speed."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np

from gbid.experiment.experiment import Experiment
from gbid.experiment.run.outcome import Outcome
from gbid.lpv import LPVFit
from gbid.lpv.characteristics import PUBLISHED_LARGEST_GAIN
from gbid.report.tables.fit_document import Row
from gbid.structure import KEY_PARAMETERS
from gbid.tables.numbers import shown_unit
from gbid.tables.table import Column, Entry, Table

_PUBLISHED = "theisen2016"
_OUTLIERS = 10  # largest number that is printed; the document contains all


def lpv_documents(experiment: Experiment, outcomes: Sequence[Outcome], fits: Mapping[str, LPVFit]) -> list[Row]:
    """Return documents of the surfaces of an experiment, with the paper's figures for the paper's machine."""
    published = experiment.spec.rig is not None and experiment.spec.rig.model == _PUBLISHED
    paths = {outcome.item: outcome.path for outcome in outcomes}
    return [lpv_document(item, fit, paths[item], published=published) for item, fit in fits.items()]


def lpv_document(item: str, fit: LPVFit, path: Path, *, published: bool) -> Row:
    """Return the document of a surface fit as plain values.

    Parameters
    ----------
    item : str
        Name of the surfaces.
    fit : LPVFit
        The fit.
    path : path
        The model file.
    published : bool
        Whether the machine is that of the paper; figures of the paper are then added.
    """
    rows = [asdict(d) for d in fit.deviations]
    for row in rows:
        if not published:
            row["published_rms"] = None
    return {
        "item": item,
        "path": str(path),
        "model": fit.model.name,
        "recordings": len(fit.estimates.recordings),
        "operating_points": len(fit.model.operating_points),
        "status": fit.status,
        "success": fit.success,
        "options": dict(fit.options),
        "deviations": rows,
        "published_largest_gain": PUBLISHED_LARGEST_GAIN if published else None,
        "orders": [{"order": s.order, "score": s.score, "why_not": s.why_not} for s in fit.orders],
        "coefficients": {key: list(fit.model.coefficients[key]) for key in KEY_PARAMETERS},
        "coefficients_std": dict(
            zip(KEY_PARAMETERS, np.sqrt(np.diag(fit.covariance)).reshape(-1, 6).tolist(), strict=True)
        ),
        "scatter_std": dict(zip(KEY_PARAMETERS, np.sqrt(np.diag(fit.scatter)).tolist(), strict=True)),
        "lack_of_fit": dict(zip(KEY_PARAMETERS, fit.lack_of_fit.tolist(), strict=True)),
        "outliers": [asdict(o) for o in fit.outliers],
        "left_out": list(fit.estimates.left_out),
        "notes": list(fit.notes),
    }


def lpv_table(document: Row) -> Table:
    """Return the table of deviations of one surface fit, with notes on orders and outliers.

    Parameters
    ----------
    document : dict
        Document of `lpv_document`.
    """
    with_paper = any(row["published_rms"] is not None for row in document["deviations"])
    paper = [Column("rms,\npaper", format=".4g")] if with_paper else []
    columns = [Column(""), Column("rms", format=".4g"), *paper, Column("largest", format=".4g")]
    rows: list[list[Entry]] = []
    for row in document["deviations"]:
        factor, unit = shown_unit(row["unit"])
        names = ("rms", *(["published_rms"] if with_paper else []), "largest")
        rows.append([row["name"], *(factor * row[name] for name in names), unit, row["recording"]])
    title = (
        f"{document['item']}: {document['recordings']} recordings at {document['operating_points']} operating points, "
        f"{document['options']['method']}, {document['status']}"
    )
    return Table(title, [*columns, Column("unit"), Column("recording")], rows, ["", *_notes(document)])


def _notes(document: Row) -> Iterator[str]:
    orders = [
        f"{row['order']}: {row['score']:.3f}" if row["why_not"] == "" else f"{row['order']}: not possible"
        for row in document["orders"]
    ]
    if orders:
        yield f"error at points left out, by order (order 0 = 1): {', '.join(orders)}"
    for row in document["outliers"][:_OUTLIERS]:
        yield f"off the surface: {row['recording']}, {row['parameter']}, {row['standardised']:+.1f} std"
    if len(document["outliers"]) > _OUTLIERS:
        yield f"off the surface: {len(document['outliers'])} in all; these were the worst"
    yield from (f"note: {note}" for note in document["notes"])
    yield f"model: {document['path']}"
