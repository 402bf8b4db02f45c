"""Plan of the control chain of an experiment: its options."""

from __future__ import annotations

from gbid.experiment.experiment import Experiment
from gbid.experiment.stages.target.schema import TargetSection
from gbid.target import ChainOptions

_SHARE_OF_CLEARANCE = 0.8


def chain_options(experiment: Experiment) -> ChainOptions:
    """Return the options of the control chain from the section target, or the defaults.

    Raises
    ------
    UsageError
        When values do not fit each other.
    """
    settings = (experiment.spec.target or TargetSection()).model_dump()
    if settings["disc_limit_m"] is None:
        rig = experiment.spec.rig
        settings["disc_limit_m"] = ChainOptions().disc_limit_m if rig is None else _SHARE_OF_CLEARANCE * rig.clearance_m
    return ChainOptions(**settings)
