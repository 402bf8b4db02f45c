"""Stage that fits: one model per recording, or one for all of them together."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from math import inf
from pathlib import Path
from typing import Any

from gbid.experiment.keys import content_key
from gbid.experiment.load import Experiment
from gbid.experiment.pairs import fit_models
from gbid.experiment.stages.common import Job, Outcome, produce
from gbid.experiment.stages.prefiltering import fit_input_key, load_fit_input
from gbid.experiment.stages.recordings import check_made, refuse_bad_signals
from gbid.experiment.structures import make_structure, structure_settings
from gbid.identify import FitResult, fit, load_fit, save_fit

FOLDER = "fits"


def run_fits(job: Job, only: str | None = None) -> list[Outcome]:
    """Write ``fits/<fit>/<recording>.h5``, or ``together.h5`` for a fit to all its recordings.

    A fit that does not converge is written, and its outcome says so. A recording that cannot be fitted does not
    stop the others.

    Parameters
    ----------
    job : Job
    only : str, optional
        Name of the one fit to run.
    """
    outcomes = []
    for name in job.experiment.spec.fits if only is None else [only]:
        for model, recordings in fit_models(job.experiment, name).items():
            path, key = fit_path(job, name, model), fit_key(job.experiment, name, recordings)
            outcome = produce(job, "fit", f"{name}/{model}", path, key, partial(_fit, job, name, recordings))
            if outcome.state != "failed":
                result = load_fit(path)
                outcome = replace(outcome, converged=result.success, text=result.status)
            outcomes.append(outcome)
    return outcomes


def fit_path(job: Job, name: str, model: str) -> Path:
    """Path of a fit's result."""
    return job.path(f"{FOLDER}/{name}", model)


def load_made_fit(job: Job, name: str, model: str) -> FitResult:
    """Read the result of a fit that was made from the present settings.

    Raises
    ------
    DataError
        When it is not there, or was made from other settings.
    """
    recordings = fit_models(job.experiment, name)[model]
    path = fit_path(job, name, model)
    check_made(path, fit_key(job.experiment, name, recordings), "gbid fit")
    return load_fit(path)


def fit_key(experiment: Experiment, name: str, recordings: list[str]) -> str:
    """Content key of a fit to recordings."""
    section = experiment.spec.fits[name]
    settings = section.model_dump(exclude={"structure", "options", "recordings", "together"})
    settings["structure"] = structure_settings(experiment, name)
    settings["recordings"] = recordings
    return content_key("fit", settings, [fit_input_key(experiment, experiment.recordings[r]) for r in recordings])


def fit_arguments(experiment: Experiment, name: str) -> dict[str, Any]:
    """Keyword arguments of `gbid.fit` that a fit section gives."""
    section = experiment.spec.fits[name]
    hold = section.intersample
    return {
        "inputs": section.inputs,
        "outputs": section.outputs,
        "focus": section.focus,
        "intersample": hold[0] if hold and len(hold) == 1 else hold,
        "criterion": section.criterion,
        "window": section.window,
        "start": section.start,
        "fixed": section.fixed,
        "bounds": {
            key: (-inf if low is None else low, inf if high is None else high)
            for key, (low, high) in section.bounds.items()
        },
        "stop": section.stop,
        "max_iterations": section.max_iterations,
    }


def _fit(job: Job, name: str, recordings: list[str], part: Path) -> None:
    structure = make_structure(job.experiment, name)
    section = job.experiment.spec.fits[name]
    used = [*(section.inputs or structure.inputs), *(section.outputs or structure.outputs)]
    data = []
    for planned in (job.experiment.recordings[recording] for recording in recordings):
        data.append(load_fit_input(job, planned))
        refuse_bad_signals(planned, data[-1], used)
    result = fit(structure, data, progress=job.reporter.iteration, **fit_arguments(job.experiment, name))
    save_fit(result, part, overwrite=True)
