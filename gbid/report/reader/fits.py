"""Existing fits with the documents that tables show."""

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
    """Existing fit.

    Attributes
    ----------
    fit, model : str
        Names of the fit and of its model.
    point : str
        Operating point of its recordings; empty when they have several.
    result : FitResult
        Result of the fit.
    document : dict
        Document of `gbid.report.tables.fit_document.fit_document`, with true values for recordings of the rig.
    """

    fit: str
    model: str
    point: str
    result: FitResult
    document: Row


def read_fit(job: Job, fit: str, model: str) -> MadeFit:
    """Return a fit, with true values for recordings of the rig."""
    result, structure = load_made_fit(job, fit, model), make_structure(job.experiment, fit)
    truth = true_values(job.experiment, result.recordings, structure)
    document = fit_document(result, truth, true_model(structure, truth, result.linear_model))
    points = {job.experiment.recordings[name].point for name in result.recordings}
    return MadeFit(fit, model, points.pop() if len(points) == 1 else "", result, document)
