"""Plan of the control chain of an experiment: its options and its run-out maps."""

from __future__ import annotations

from gbid.experiment.experiment import Experiment
from gbid.experiment.run.job import Job
from gbid.experiment.stages.prefilter.stage import MAP_FOLDER
from gbid.experiment.stages.target.schema import TargetSection
from gbid.prefilter import RunoutMap, load_prefilter
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


def made_maps(job: Job) -> tuple[RunoutMap, ...]:
    """Return the run-out maps that the prefilter of the experiment has stored, one for each operating point."""
    found = []
    for point in job.experiment.points:
        path = job.path(MAP_FOLDER, point)
        if job.experiment.spec.prefilter is not None and path.is_file():
            found.append(load_prefilter(path)[0])
    return tuple(each for each in found if each is not None)
