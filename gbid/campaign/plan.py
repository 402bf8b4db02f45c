"""Plan of a campaign: the tasks to run, current results, and earlier failures."""

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
    """Tasks of one stage with their known outcomes.

    Attributes
    ----------
    stage : Stage
        The stage.
    tasks : tuple of Task
        Its tasks.
    known : tuple of Outcome or None
        Known outcome of each task; None for a task to run.
    """

    stage: Stage
    tasks: tuple[Task, ...]
    known: tuple[Outcome | None, ...]


def plan_campaign(job: Job, shard: Shard | None = None) -> list[Planned]:
    """Return the tasks of all stages, with current results and earlier failures.

    Parameters
    ----------
    job : Job
        The job.
    shard : Shard, optional
        Part of the campaign; all of it by default.

    Returns
    -------
    list of Planned
        Stages with tasks, in their order.

    Raises
    ------
    UsageError
        When a result made from other settings exists and must not be replaced. No task has run then.
    """
    stages = []
    for stage, all_tasks in early_tasks(job):
        tasks = tasks_of(shard, job.experiment, all_tasks)
        if tasks:
            stages.append(Planned(stage, tuple(tasks), tuple(standing(job, task) for task in tasks)))
    return stages


def early_tasks(job: Job) -> list[tuple[Stage, list[Task]]]:
    """Return the stages whose tasks are known before a run, from recordings to fits, with their tasks."""
    early = [stage for stage in registry.STAGES if stage.early]
    return [(stage, [item for item in stage.tasks(job) if isinstance(item, Task)]) for stage in early]
