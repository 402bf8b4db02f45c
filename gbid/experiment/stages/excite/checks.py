"""Checks of the excite section."""

from __future__ import annotations

from gbid.errors import GbidError
from gbid.experiment.experiment import Experiment
from gbid.experiment.problems import Found, nearest
from gbid.experiment.stages.fit.structures import fit_channels


def excitations_have_fits(experiment: Experiment) -> Found:
    """Yield a problem for each excitation whose fit does not exist or is no fit of driven recordings."""
    for name, section in experiment.spec.excite.items():
        if section.fit not in experiment.spec.fits:
            yield ("excite", name, "fit"), f"no fit {section.fit!r}; {nearest(section.fit, experiment.spec.fits)}"
            continue
        try:
            inputs, _ = fit_channels(experiment, section.fit)
        except GbidError:
            continue  # another check reports it
        if not inputs:
            yield ("excite", name, "fit"), f"fit {section.fit!r} has no inputs; there is nothing to excite"
