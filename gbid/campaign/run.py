"""Run a campaign, or what is left of it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager

from gbid.atomic import remove_stale_parts
from gbid.campaign.engines import make_engine
from gbid.campaign.lock import locked
from gbid.campaign.plan import plan_campaign
from gbid.campaign.shard import Shard
from gbid.experiment.experiment import Experiment
from gbid.experiment.run.job import Job, Task
from gbid.experiment.run.outcome import Outcome
from gbid.experiment.run.perform import run_tasks
from gbid.experiment.run.reporter import Reporter, Silent
from gbid.experiment.run.stage import go_on


@contextmanager
def working(
    experiment: Experiment,
    *,
    overwrite: bool = False,
    retry: bool = False,
    reporter: Reporter | None = None,
    engine: str = "auto",
    workers: int | None = None,
    scheduler: str | None = None,
    shared: bool = False,
) -> Iterator[Job]:
    """Hold the results folder of an experiment and give the job to run in it.

    At the beginning and at the end, temporary files that killed processes left are removed.

    Parameters
    ----------
    experiment : Experiment
    overwrite, retry : bool
        As in `gbid.experiment.run.job.Job`.
    reporter : Reporter, optional
    engine, workers, scheduler
        As in `gbid.campaign.engines.make_engine`.
    shared : bool
        Whether other shards may work in the folder as well.

    Yields
    ------
    Job

    Raises
    ------
    UsageError
        When another runner holds the folder, or for options of the engine.
    DataError
        When the folder cannot be written.
    """
    with locked(experiment.results, shared):
        chosen = make_engine(engine, workers, scheduler)
        try:
            remove_stale_parts(experiment.results)
            yield Job(experiment, overwrite, reporter or Silent(), chosen, retry)
        finally:
            chosen.close()
            remove_stale_parts(experiment.results)


def run_campaign(job: Job, shard: Shard | None = None) -> list[Outcome]:
    """Make the recordings, prefilter and fit them, as far as the experiment asks for it and it is not done.

    Parameters
    ----------
    job : Job
        From `working`.
    shard : Shard, optional
        The part of the campaign to run.

    Returns
    -------
    list of Outcome
        Of all results, those that were there included.

    Raises
    ------
    UsageError
        When a result made from other settings is there and may not be replaced, before any work is done.
    NoSpaceError
        When the disk is full; what is complete is kept.
    """
    outcomes: list[Outcome] = []
    failed: dict[str, Outcome] = {}  # by recording
    for planned in plan_campaign(job, shard):
        known = [
            outcome or _without_input(task, failed) for task, outcome in zip(planned.tasks, planned.known, strict=True)
        ]
        made = run_tasks(job, planned.tasks, known)
        for task, outcome in zip(planned.tasks, made, strict=True):
            if outcome.state == "failed" and task.stage != "fit":
                failed.setdefault(task.item, outcome)
        outcomes += made if shard is not None else go_on(job, planned.stage, made)
    return outcomes


def _without_input(task: Task, failed: Mapping[str, Outcome]) -> Outcome | None:
    """Outcome of a task whose recording could not be made; None when it has all that it needs."""
    for name in task.recordings:
        if name in failed:
            source = failed[name]
            text = f"nothing to start from: {source.stage} {source.item} failed"
            return Outcome(task.stage, task.item, task.path, "failed", text, cause="input")
    return None
