"""Stage that draws the figures of an experiment."""

from __future__ import annotations

from functools import partial
from pathlib import Path

from gbid.errors import DataError
from gbid.experiment.keys import content_key
from gbid.experiment.stages import Job, Outcome, drawn_pairs, pair_keys, produce, validate_pair
from gbid.report.figures import response_figure, save_figure

FOLDER = "figures"


def draw_figures(job: Job) -> list[Outcome]:
    """Write ``figures/<fit>_<model>_on_<recording>.png`` and ``.pdf`` for each fit that is to be shown.

    What is shown are the pairs of the fit's cross-validation; without one, each model on its own recordings.
    """
    outcomes = []
    for fit, model, recording in drawn_pairs(job):
        name = f"{fit}_{model}_on_{recording}"
        for kind in ("png", "pdf"):
            path = job.path(FOLDER, name, f".{kind}")
            try:
                sources = pair_keys(job, fit, model, recording)
            except (DataError, OSError) as error:
                outcomes.append(Outcome("figure", name, path, "failed", str(error)))
                job.reporter.end(outcomes[-1])
                break
            section = job.experiment.spec.figures[fit].model_dump()
            key = content_key("figure", {"kind": kind, **section}, sources)
            draw = partial(_draw, job, fit, model, recording, kind, key)
            outcomes.append(produce(job, "figure", f"{name}.{kind}", path, key, draw))
    return outcomes


def _draw(job: Job, fit: str, model: str, recording: str, kind: str, key: str, part: Path) -> None:
    section = job.experiment.spec.figures[fit]
    validation = validate_pair(job, fit, model, recording)
    figure = response_figure(validation, from_s=section.from_s, to_s=section.to_s)
    save_figure(figure, part, kind=kind, note=f"content_key: {key}")
