"""Documents that verbs print: plain values of their results."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from gbid.core.hdf5 import load
from gbid.core.tables import Table
from gbid.experiment.experiment import Experiment
from gbid.experiment.machine import rig_machine, true_model, true_values
from gbid.experiment.run import Document, Job, Outcome, Stage, View, outcomes_view
from gbid.experiment.stages.crossval import SUMMARY, CrossvalRow, crossval_rows
from gbid.experiment.stages.cycle import made_rows
from gbid.experiment.stages.fit import load_made_fit
from gbid.experiment.stages.impact import made_impacts
from gbid.experiment.stages.loop import made_costs
from gbid.experiment.stages.lpv import made_surfaces
from gbid.experiment.stages.nominal import nominal_of
from gbid.experiment.stages.static import load_made_static
from gbid.experiment.stages.tune import made_designs
from gbid.experiment.structures import make_structure
from gbid.identify import FitTable
from gbid.prefilter import PrefilterFile
from gbid.recording import load_recording
from gbid.report.control_tables import (
    cycle_documents,
    cycle_summary,
    impact_document,
    impact_tables,
    loop_documents,
    loop_tables,
    tuning_documents,
    tuning_tables,
)
from gbid.report.fit_tables import (
    crossval_table,
    fit_tables,
    lpv_documents,
    lpv_table,
    nominal_document,
    nominal_table,
    static_document,
    static_table,
    summary_document,
    validation_table,
)
from gbid.report.read import fit_document, prefilter_rows, prefilter_table, recording_table
from gbid.validate import ValidationSummary


def recording_documents(experiment: Experiment, outcomes: Sequence[Outcome]) -> list[dict[str, Any]]:
    """Return documents of recordings that were made or imported; failed ones are left out."""
    documents = []
    for outcome in outcomes:
        if outcome.stage in ("rig", "import") and outcome.state != "failed":
            recording = load_recording(outcome.path)
            documents.append(
                {
                    "name": recording.name,
                    "kind": experiment.recordings[recording.name].kind,
                    "samples": recording.n_samples,
                    "sample_time_s": recording.sample_time,
                    "duration_s": recording.duration,
                    "conditions": dict(recording.conditions),
                    "signals": {name: list(recording.channels[name]) for name in recording.signals},
                    "state": outcome.state,
                    "path": str(outcome.path),
                }
            )
    return documents


def prefilter_documents(outcomes: Sequence[Outcome]) -> list[dict[str, Any]]:
    """Return documents of the corrections by the prefilter, from the files with the maps."""
    maps = [o.path for o in outcomes if o.stage == "prefilter" and o.item.startswith("map ") and o.state != "failed"]
    return [row for path in maps for row in prefilter_rows(load(path, PrefilterFile).reports)]


def fit_documents(job: Job, outcomes: Sequence[Outcome]) -> list[dict[str, Any]]:
    """Return documents of the fits, with true values for those of the rig; failed ones are left out."""
    documents = []
    for outcome in outcomes:
        if outcome.stage == "fit" and outcome.state != "failed":
            name, _, model = outcome.item.partition("/")
            result, structure = load_made_fit(job, name, model), make_structure(job.experiment, name)
            truth = true_values(job.experiment, result.recordings, structure)
            document = fit_document(result, truth, true_model(structure, truth, result.linear_model))
            place = {"fit": name, "model": model, "state": outcome.state, "path": str(outcome.path)}
            documents.append({**place, **document})
    return documents


def campaign_document(
    experiment: Experiment, outcomes: Sequence[Outcome], table: FitTable | None = None
) -> dict[str, Any]:
    """Return a summary of a campaign: states of the stages, fits by name, and the files of the table."""
    stages: dict[str, dict[str, int]] = {}
    for outcome in outcomes:
        if outcome.stage != "table":
            counts = stages.setdefault(outcome.stage, {"made": 0, "kept": 0, "failed": 0, "not_converged": 0})
            counts[outcome.state] += 1
            counts["not_converged"] += outcome.state != "failed" and not outcome.converged
    return {
        "experiment": experiment.spec.name,
        "results": str(experiment.results),
        "stages": stages,
        "fits": [] if table is None else [_fit_of_campaign(table, name) for name in experiment.spec.fits],
        "table": [str(outcome.path) for outcome in outcomes if outcome.stage == "table"],
    }


def _fit_of_campaign(table: FitTable, name: str) -> dict[str, Any]:
    """Return numbers of converged and missing fits of one name, their median fit percent, and the worst fit."""
    rows = table.select(fit=name)
    there = np.isfinite(rows.fit_percent).any(axis=1)
    smallest = rows.fit_percent[there].min(axis=1, initial=np.inf)
    worst = int(np.argmin(smallest)) if smallest.size else None
    return {
        "fit": name,
        "fits": len(rows),
        "converged": int(rows.success.sum()),
        "not_converged": int(there.sum() - rows.success.sum()),
        "missing": int((~there).sum()),
        "median_fit_percent": {
            output: float(np.median(rows.fit_percent[there, j])) for j, output in enumerate(rows.output_names)
        },
        "worst": None if worst is None else str(rows.model[there][worst]),
        "worst_fit_percent": None if worst is None else float(smallest[worst]),
    }


def summary_documents(outcomes: Sequence[Outcome]) -> list[dict[str, Any]]:
    """Return summaries of the cross-validations, with histograms."""
    documents = []
    for outcome in outcomes:
        if outcome.stage == "crossval" and outcome.path.suffix == ".h5" and outcome.state != "failed":
            summary = load(outcome.path, ValidationSummary)
            fit = outcome.path.stem.removesuffix(SUMMARY)
            documents.append(summary_document(fit, summary, outcome.path))
    return documents


def static_documents(job: Job, outcomes: Sequence[Outcome]) -> list[dict[str, Any]]:
    """Return documents of the static characterisations; failed ones are left out."""
    there = {o.item: o for o in outcomes if o.stage == "static" and o.state != "failed" and o.path.suffix == ".h5"}
    return [
        {**static_document(name, load_made_static(job, name)), "state": o.state, "path": str(o.path)}
        for name, o in there.items()
    ]


def impact_documents(job: Job, outcomes: Sequence[Outcome]) -> list[dict[str, Any]]:
    """Return documents of the impact studies; failed ones are left out."""
    paths = {o.item: o.path for o in outcomes if o.stage == "ringdown"}
    section, rig = job.experiment.spec.impacts, job.experiment.spec.rig
    if section is None or rig is None:
        return []
    loops = (
        ("open", "closed") if section.controller == "paper" else ("open",)
    )  # the paper's loop has the paper's controller
    published = [modes for modes in rig_machine(job.experiment).reference_modes if modes.loop in loops]
    return [impact_document(name, study, paths[name], published) for name, study in made_impacts(outcomes).items()]


def crossval_documents(rows: Sequence[CrossvalRow]) -> list[dict[str, Any]]:
    """Return the rows of the cross-validation as plain documents."""
    return [{**asdict(row), "missed": row.missed} for row in rows]


def validation_documents(job: Job, outcomes: Sequence[Outcome]) -> dict[str, Any]:
    """Return rows and summaries of the cross-validations."""
    made = any(o.stage == "crossval" and o.state != "failed" for o in outcomes)
    rows = crossval_documents(crossval_rows(job)) if made else []
    return {"crossval": rows, "crossval_summary": summary_documents(outcomes)}


def nominal_document_of(job: Job, outcomes: Sequence[Outcome]) -> dict[str, Any] | None:
    """Return the document of the nominal actuator; None when there is none."""
    for outcome in outcomes:
        if outcome.stage == "nominal" and outcome.state != "failed":
            nominal, _ = nominal_of(job)
            return nominal_document(outcome.item, nominal, outcome.path)
    return None


def surface_documents(job: Job, outcomes: Sequence[Outcome]) -> list[dict[str, Any]]:
    """Return documents of the surfaces; failed ones are left out."""
    return lpv_documents(job.experiment, [o for o in outcomes if o.stage == "lpv"], made_surfaces(outcomes))


def design_documents(outcomes: Sequence[Outcome]) -> list[dict[str, Any]]:
    """Return documents of the tuned designs; failed ones are left out."""
    return tuning_documents(outcomes, made_designs(outcomes))


# ---- Views of the stages that come with gbid; their tables are those of the report.

_ROWS = 60  # of a cross-validation; more are in its CSV file only


def view_of(stage: Stage) -> View:
    """Return the view of a stage; one that has none shows its outcomes."""
    return stage.view or VIEWS.get(stage.name) or outcomes_view(stage.name, stage.section)


def _recordings(job: Job, outcomes: Sequence[Outcome]) -> Document:
    return {"recordings": recording_documents(job.experiment, outcomes)}


def _fit_tables(document: Document) -> list[Table]:
    return [table for fit in document["fits"] for table in fit_tables(f"{fit['fit']}, {fit['model']}", fit)]


def _validation_tables(document: Document) -> Iterable[Table]:
    """Pairs of each fit, unless they are many, and their summary."""
    for summary in document["crossval_summary"]:
        own = [row for row in document["crossval"] if row["fit"] == summary["fit"]]
        if len(own) <= _ROWS:
            yield crossval_table(summary["fit"], own)
        yield validation_table(summary)


def _one(key: str, table: Callable[[Any], Table]) -> Callable[[Document], list[Table]]:
    """Give the table of an entry, none when it is empty."""
    return lambda document: [table(document[key])] if document[key] else []


_OF_RECORDINGS = View(_recordings, _one("recordings", recording_table))

VIEWS: Mapping[str, View] = {
    "rig": _OF_RECORDINGS,
    "import": _OF_RECORDINGS,
    "prefilter": View(
        lambda _, outcomes: {"prefilter": prefilter_documents(outcomes)}, _one("prefilter", prefilter_table)
    ),
    "fit": View(lambda job, outcomes: {"fits": fit_documents(job, outcomes)}, _fit_tables),
    "loop": View(lambda *_: {}, lambda _: []),  # its designs are shown with the others
    "loop cost": View(
        lambda job, _: {"loops": loop_documents(made_costs(job))},
        lambda document: loop_tables(document["loops"]),
    ),
    "static": View(
        lambda job, outcomes: {"static": static_documents(job, outcomes)},
        lambda document: map(static_table, document["static"]),
    ),
    "crossval": View(validation_documents, _validation_tables),
    "nominal": View(
        lambda job, outcomes: {"nominal": nominal_document_of(job, outcomes)}, _one("nominal", nominal_table)
    ),
    "lpv": View(
        lambda job, outcomes: {"lpv": surface_documents(job, outcomes)},
        lambda document: map(lpv_table, document["lpv"]),
    ),
    "tune": View(
        lambda _, outcomes: {"tuning": design_documents(outcomes)},
        lambda document: tuning_tables(document["tuning"]),
    ),
    "impact": View(
        lambda job, outcomes: {"impacts": impact_documents(job, outcomes)},
        lambda document: impact_tables(document["impacts"]),
    ),
    "cycle": View(
        lambda job, _: {"cycle": cycle_documents(made_rows(job))},
        _one("cycle", cycle_summary),
    ),
}
"""By the name of the stage."""
