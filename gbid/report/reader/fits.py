"""Fits that are there, each with what a reader wants to know about it."""

from __future__ import annotations

from dataclasses import dataclass

from gbid.experiment.run.job import Job
from gbid.experiment.stages.fit.stage import load_made_fit
from gbid.experiment.stages.fit.structures import make_structure
from gbid.experiment.stages.fit.truth import true_model, true_values
from gbid.identify import FitResult
from gbid.report.tables.fit_document import Row, fit_document


@dataclass(frozen=True, eq=False)
class MadeFit:
    """A fit that is there.

    Attributes
    ----------
    fit, model : str
    point : str
        Operating point of its recordings; empty where they have several.
    result : FitResult
    document : dict
        From `gbid.report.tables.fit_document.fit_document`, with the rig's truth where there is one.
    """

    fit: str
    model: str
    point: str
    result: FitResult
    document: Row


def read_fit(job: Job, fit: str, model: str) -> MadeFit:
    """Read a fit, and put the rig's truth beside it."""
    result, structure = load_made_fit(job, fit, model), make_structure(job.experiment, fit)
    truth = true_values(job.experiment, result.recordings, structure)
    document = fit_document(result, truth, true_model(structure, truth, result.model))
    points = {job.experiment.recordings[name].point for name in result.recordings}
    return MadeFit(fit, model, points.pop() if len(points) == 1 else "", result, document)
