"""Plan of a fit: its models and the recordings of each."""

from __future__ import annotations

from gbid.experiment.experiment import Experiment

TOGETHER = "together"
"""Name of the one model of a fit to all its recordings together."""


def fit_models(experiment: Experiment, fit: str) -> dict[str, list[str]]:
    """Return the models of a fit by name, each with the recordings to which it is fitted."""
    names = [q.name for q in experiment.fit_recordings(fit)]
    if experiment.spec.fits[fit].together:
        return {TOGETHER: names}
    return {name: [name] for name in names}


def recordings_of(experiment: Experiment, fit: str, model: str) -> list[str]:
    """Return the recordings to which one model of a fit is fitted."""
    if experiment.spec.fits[fit].together:
        return [q.name for q in experiment.fit_recordings(fit)]
    return [model]
