"""What a campaign has to do: what is there, what is to be made, what failed before."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from gbid.campaign.shard import Shard, tasks_of
from gbid.experiment.run.job import Job, Task
from gbid.experiment.run.outcome import Outcome
from gbid.experiment.run.perform import standing
from gbid.experiment.stages.fit.stage import fit_tasks
from gbid.experiment.stages.importing.stage import import_tasks
from gbid.experiment.stages.prefilter.stage import prefilter_tasks
from gbid.experiment.stages.rig.stage import rig_tasks

STAGES: tuple[Callable[[Job], list[Task]], ...] = (rig_tasks, import_tasks, prefilter_tasks, fit_tasks)
"""From recordings to fits; each stage starts from what the one before made."""


@dataclass(frozen=True)
class Planned:
    """The tasks of one stage.

    Attributes
    ----------
    tasks : tuple of Task
    known : tuple of Outcome or None
        For each task what is known of it already; None for one to be done.
    """

    tasks: tuple[Task, ...]
    known: tuple[Outcome | None, ...]


def plan_campaign(job: Job, shard: Shard | None = None) -> list[Planned]:
    """List the tasks of all stages, with what is there and what failed before.

    Parameters
    ----------
    job : Job
    shard : Shard, optional
        The part of the campaign to look at.

    Returns
    -------
    list of Planned
        Stages that have tasks, in their order.

    Raises
    ------
    UsageError
        When a result made from other settings is there and may not be replaced, before any work is done.
    """
    stages = []
    for list_tasks in STAGES:
        tasks = tasks_of(shard, job.experiment, list_tasks(job))
        if tasks:
            stages.append(Planned(tuple(tasks), tuple(standing(job, task) for task in tasks)))
    return stages
