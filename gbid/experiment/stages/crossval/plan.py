"""Plan of a cross-validation: pairs of model and recording (paper, Sec. 3.8)."""

from __future__ import annotations

from gbid.experiment.experiment import Experiment
from gbid.experiment.stages.fit.plan import fit_models

SPECIAL = ("cyclic", "others", "point")
"""Words for the recordings of a cross-validation."""


def validation_pairs(experiment: Experiment, fit: str) -> list[tuple[str, str]]:
    """Return the pairs of model and recording in the cross-validation of a fit.

    ``cyclic``: model j on recording j + 1 of the same operating point, the last on the first. ``others``: each
    model on all other excited recordings. ``point``: on those of its operating points. Names: each model on the
    recordings with these names.

    Returns
    -------
    list of (model, recording)
        The recording is empty for a model without a recording to validate on.
    """
    models, on = fit_models(experiment, fit), experiment.spec.crossval[fit].on
    if on == ("cyclic",):
        return [(model, _next(experiment, model, list(models))) for model in models]
    if on in (("others",), ("point",)):
        excited = [q for q in experiment.recordings.values() if q.excited]
        pairs = []
        for model, used in models.items():
            taken, points = set(used), {experiment.recordings[name].point for name in used}
            there = [q.name for q in excited if q.name not in taken and (on == ("others",) or q.point in points)]
            pairs += [(model, name) for name in there or [""]]
        return pairs
    return [(model, q.name) for model in models for q in experiment.matching(on)]


def figure_pairs(experiment: Experiment, fit: str) -> list[tuple[str, str]]:
    """Return the pairs of the figures of a fit: those of its cross-validation, else each model on its recordings."""
    if fit in experiment.spec.crossval:
        return validation_pairs(experiment, fit)
    return [(model, name) for model, names in fit_models(experiment, fit).items() for name in names]


def _next(experiment: Experiment, model: str, models: list[str]) -> str:
    """Return the next recording of the same operating point; empty when there is none."""
    point = experiment.recordings[model].point
    same = [name for name in models if experiment.recordings[name].point == point]
    return same[(same.index(model) + 1) % len(same)] if len(same) > 1 else ""
