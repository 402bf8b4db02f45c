"""Checks of the target section."""

from __future__ import annotations

from gbid.core.errors import UsageError
from gbid.experiment.controllers import chain_options
from gbid.experiment.experiment import Experiment
from gbid.experiment.fields import Found
from gbid.experiment.run import Stage


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


# ---- Stage of the control chain; `gbid export --to c` writes it, and the rig runs it (``rig: controller: compiled``).

TARGET = Stage("target", "target", (chain_can_run,), lambda _: ())
