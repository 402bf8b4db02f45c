"""What verbs print, as plain documents."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from gbid.experiment.load import Experiment
from gbid.experiment.stages import CrossvalRow, Job, Outcome, load_made_fit
from gbid.experiment.structures import make_structure, true_model, true_values
from gbid.prefilter import load_prefilter
from gbid.recording import load_recording
from gbid.report.rows import fit_document, prefilter_rows


def recording_documents(experiment: Experiment, outcomes: Sequence[Outcome]) -> list[dict[str, Any]]:
    """Describe recordings that were made or imported; those that failed are left out."""
    documents = []
    for outcome in outcomes:
        if outcome.state != "failed":
            recording = load_recording(outcome.path)
            documents.append(
                {
                    "name": recording.name,
                    "kind": "excited" if experiment.recordings[recording.name].excited else "stationary",
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
    """Describe what the prefilter took out, from the files with the maps."""
    maps = [o.path for o in outcomes if o.stage == "prefilter" and o.item.startswith("map ") and o.state != "failed"]
    return [row for path in maps for row in prefilter_rows(load_prefilter(path)[1])]


def fit_documents(job: Job, outcomes: Sequence[Outcome]) -> list[dict[str, Any]]:
    """Results of the fits, with the rig's truth where there is one; those that failed are left out."""
    documents = []
    for outcome in outcomes:
        if outcome.stage == "fit" and outcome.state != "failed":
            name, _, model = outcome.item.partition("/")
            result, structure = load_made_fit(job, name, model), make_structure(job.experiment, name)
            truth = true_values(job.experiment, result.recordings, structure)
            document = fit_document(result, truth, true_model(structure, truth, result.model))
            place = {"fit": name, "model": model, "state": outcome.state, "path": str(outcome.path)}
            documents.append({**place, **document})
    return documents


def crossval_documents(rows: Sequence[CrossvalRow]) -> list[dict[str, Any]]:
    """Rows of the cross-validation."""
    return [{**asdict(row), "missed": row.missed} for row in rows]
