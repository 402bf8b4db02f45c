"""What a campaign has to do: what is there, what is to be made, what failed before."""

from __future__ import annotations

from dataclasses import dataclass

from gbid.campaign.shard import Shard, tasks_of
from gbid.experiment.run.job import Job, Task
from gbid.experiment.run.outcome import Outcome
from gbid.experiment.run.perform import standing
from gbid.experiment.run.stage import Stage
from gbid.experiment.stages import registry


@dataclass(frozen=True)
class Planned:
    """The tasks of one stage.

    Attributes
    ----------
    stage : Stage
    tasks : tuple of Task
    known : tuple of Outcome or None
        For each task what is known of it already; None for one to be done.
    """

    stage: Stage
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
    for stage, all_tasks in early_tasks(job):
        tasks = tasks_of(shard, job.experiment, all_tasks)
        if tasks:
            stages.append(Planned(stage, tuple(tasks), tuple(standing(job, task) for task in tasks)))
    return stages


def early_tasks(job: Job) -> list[tuple[Stage, list[Task]]]:
    """List the stages whose tasks are known before anything has run, from recordings to fits, with their tasks."""
    early = [stage for stage in registry.STAGES if stage.early]
    return [(stage, [item for item in stage.tasks(job) if isinstance(item, Task)]) for stage in early]
