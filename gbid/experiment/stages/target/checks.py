"""Checks of the target section."""

from __future__ import annotations

from gbid.errors import UsageError
from gbid.experiment.experiment import Experiment
from gbid.experiment.problems import Found
from gbid.experiment.stages.target.plan import chain_options


def chain_can_run(experiment: Experiment) -> Found:
    """Yield a problem when values of the section do not fit each other, or when the rig has no loop to close."""
    rig = experiment.spec.rig
    if rig is not None and rig.controller == "compiled" and experiment.spec.impacts is None:
        yield (
            ("rig", "controller"),
            "closes the loop of impacts, but there is no section impacts; add it or remove this",
        )
    if experiment.spec.target is None:
        return
    try:
        chain_options(experiment)
    except UsageError as error:
        yield ("target",), str(error).removeprefix("target: ")
