"""Checks of the nominal section."""

from __future__ import annotations

from gbid.experiment.experiment import Experiment
from gbid.experiment.problems import Found
from gbid.experiment.stages.fit.checks import a_fit_is_named
from gbid.validate.central import ACTUATOR


def nominal_is_an_actuator(experiment: Experiment) -> Found:
    """Yield problems of the nominal section: its fit must exist, have the parameters, and give several models."""
    section = experiment.spec.nominal
    if section is None:
        return
    yield from a_fit_is_named(
        experiment, ("nominal", "fit"), section.fit, ACTUATOR, "name a fit of piezo_pair or plant"
    )
