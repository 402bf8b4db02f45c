"""Run of a campaign, from the start or after an interruption."""

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
    """Return a context that locks the results folder of an experiment and gives the job to run in it.

    At its beginning and end, temporary files of killed processes are removed.

    Parameters
    ----------
    experiment : Experiment
        The experiment to run.
    overwrite, retry : bool
        Options of `gbid.experiment.run.job.Job`.
    reporter : Reporter, optional
        Receiver of the progress; none by default.
    engine, workers, scheduler
        Options of `gbid.campaign.engines.make_engine`.
    shared : bool
        Whether other shards may use the folder at the same time.

    Yields
    ------
    Job
        The job, with its engine.

    Raises
    ------
    UsageError
        When another runner has locked the folder, or an option of the engine is wrong.
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
    """Make, prefilter and fit the recordings of an experiment, except for results that are current.

    Parameters
    ----------
    job : Job
        Job from `working`.
    shard : Shard, optional
        Part of the campaign to run; all of it by default.

    Returns
    -------
    list of Outcome
        Outcomes of all results, with those that existed already.

    Raises
    ------
    UsageError
        When a result made from other settings exists and must not be replaced. No task has run then.
    NoSpaceError
        When the disk is full; complete results are kept.
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
    """Return a failed outcome for a task whose recording failed; None for other tasks."""
    for name in task.recordings:
        if name in failed:
            source = failed[name]
            text = f"its input is missing: {source.stage} {source.item} failed"
            return Outcome(task.stage, task.item, task.path, "failed", text, cause="input")
    return None
