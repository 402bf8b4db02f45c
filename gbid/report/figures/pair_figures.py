"""Stage that draws the figures of an experiment."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

from matplotlib.figure import Figure

from gbid.errors import DataError
from gbid.experiment.keys import content_key
from gbid.experiment.run.job import Job
from gbid.experiment.run.outcome import Outcome
from gbid.experiment.run.perform import produce
from gbid.experiment.stages.crossval.pairing import (
    bode_of_pair,
    drawn_pairs,
    pair_keys,
    residuals_of_pair,
    validate_pair,
)
from gbid.report.figures.measured.residual_panels import residuals_figure
from gbid.report.figures.measured.response import response_figure
from gbid.report.figures.model.bode_diagram import plot_bode
from gbid.report.figures.save import save_figure
from gbid.tables.csv import write_csv

FOLDER = "figures"


def draw_figures(job: Job) -> list[Outcome]:
    """Write ``figures/<fit>_<model>_on_<recording>.png``, or further formats, for each fit that is to be shown.

    What is shown are the pairs of the fit's cross-validation; without one, each model on its own recordings. Where
    the experiment asks for the residuals, they come as ``..._residuals``; Bode diagrams come as ``..._bode``, with the
    numbers as csv.
    """
    outcomes = []
    for fit, model, recording in drawn_pairs(job):
        name = f"{fit}_{model}_on_{recording}"
        try:
            sources = pair_keys(job, fit, model, recording)
        except (DataError, OSError) as error:
            outcomes.append(
                Outcome("figure", name, job.path(FOLDER, name, ".png"), "failed", str(error), cause="input")
            )
            job.reporter.end(outcomes[-1])
            continue
        section = job.experiment.spec.figures[fit]
        pictures = [(name, _response, section.model_dump(exclude={"residuals", "bode", "formats"}))]
        if section.residuals:
            pictures.append((f"{name}_residuals", _residuals, {"residuals": True}))
        if section.bode:
            pictures.append((f"{name}_bode", _bode, {"bode": True}))
            path, key = job.path(FOLDER, f"{name}_bode", ".csv"), content_key("figure", {"kind": "csv"}, sources)
            numbers = partial(_save_bode, job, fit, model, recording, key)
            outcomes.append(produce(job, "figure", f"{name}_bode.csv", path, key, numbers))
        for title, draw, settings in pictures:
            for kind in section.formats:
                path = job.path(FOLDER, title, f".{kind}")
                key = content_key("figure", {"kind": kind, **settings}, sources)
                write = partial(_save, partial(draw, job, fit, model, recording), kind, key)
                outcomes.append(produce(job, "figure", f"{title}.{kind}", path, key, write))
    return outcomes


def _response(job: Job, fit: str, model: str, recording: str) -> Figure:
    section = job.experiment.spec.figures[fit]
    return response_figure(validate_pair(job, fit, model, recording), from_s=section.from_s, to_s=section.to_s)


def _residuals(job: Job, fit: str, model: str, recording: str) -> Figure:
    ahead = "one-step-ahead" if job.experiment.spec.fits[fit].focus == "prediction" else "simulation"
    title = f"{ahead} residuals of {fit}, model of {model} on {recording}"
    return residuals_figure(residuals_of_pair(job, fit, model, recording), title=title)


def _bode(job: Job, fit: str, model: str, recording: str) -> Figure:
    result, measured = bode_of_pair(job, fit, model, recording)
    axes = plot_bode({f"model of {model}": result}, measured=measured)
    figure: Figure = axes[0, 0].figure
    return figure


def _save_bode(job: Job, fit: str, model: str, recording: str, key: str, part: Path) -> None:
    result, _ = bode_of_pair(job, fit, model, recording)
    write_csv(result.bode().table(), part, (f"content_key: {key}",))


def _save(draw: Callable[[], Figure], kind: str, key: str, part: Path) -> None:
    save_figure(draw(), part, kind=kind, note=f"content_key: {key}")
