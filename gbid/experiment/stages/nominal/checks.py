"""Checks of the nominal section."""

from __future__ import annotations

from gbid.experiment.experiment import Experiment
from gbid.experiment.problems import Found, Location, nearest
from gbid.experiment.stages.fit.structures import structure_or_none
from gbid.validate.central import ACTUATOR


def nominal_is_an_actuator(experiment: Experiment) -> Found:
    """Yield problems of the nominal section: its fit must exist, have the parameters, and give several models."""
    section = experiment.spec.nominal
    if section is None:
        return
    where: Location = ("nominal", "fit")
    if section.fit not in experiment.spec.fits:
        yield where, f"no fit of this name; {nearest(section.fit, experiment.spec.fits)}"
        return
    if experiment.spec.fits[section.fit].together:
        yield where, f"{section.fit} is one model for all recordings; name a fit per recording"
    structure = structure_or_none(experiment, section.fit)
    missing = [n for n in ACTUATOR if n not in {q.name for q in structure.parameters}] if structure else []
    if missing:
        yield where, f"{section.fit} has no parameters {', '.join(missing)}; name a fit of piezo_pair or plant"
