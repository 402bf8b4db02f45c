"""Execution of tasks: one task, or all tasks of a stage on an engine."""

from __future__ import annotations

import time
import traceback
from collections.abc import Callable, Generator, Sequence
from dataclasses import replace
from pathlib import Path

from gbid.errors import DataError, GbidError, NoSpaceError, from_interrupt
from gbid.experiment.keys import is_current, writing_keyed
from gbid.experiment.run.failures import Failure, forget_failure, remember_failure, remembered_failure
from gbid.experiment.run.inputs import cause_of
from gbid.experiment.run.job import Job, Task
from gbid.experiment.run.outcome import Made, Outcome


def run_tasks(job: Job, tasks: Sequence[Task], known: Sequence[Outcome | None] | None = None) -> list[Outcome]:
    """Keep the results that are current and make the others with the engine of the job.

    Parameters
    ----------
    job : Job
        The job.
    tasks : sequence of Task
        Tasks of one stage; none needs the result of another.
    known : sequence of Outcome or None, optional
        Results of `standing` for the tasks, when the caller has them already.

    Returns
    -------
    list of Outcome
        Outcomes in the order of the tasks.

    Raises
    ------
    UsageError
        When a result made from other settings exists and must not be replaced. No task has run then.
    NoSpaceError
        When the disk is full.
    """
    if not tasks:
        return []
    found = [standing(job, task) for task in tasks] if known is None else list(known)
    settled = [outcome for outcome in found if outcome is not None]
    todo = [number for number, outcome in enumerate(found) if outcome is None]
    failed = sum(outcome.state == "failed" for outcome in settled)
    job.reporter.expect(tasks[0].stage, len(todo), len(settled) - failed, failed)
    for outcome in settled:
        job.reporter.end(outcome)
    if todo:
        running = (job.engine or InTurn()).outcomes(job, [tasks[number] for number in todo])
        try:
            for which, outcome in running:
                found[todo[which]] = ended = replace(outcome, path=tasks[todo[which]].path)
                job.reporter.end(ended)
        finally:
            running.close()
    return [outcome for outcome in found if outcome is not None]


def standing(job: Job, task: Task) -> Outcome | None:
    """Return the outcome of a task that need not run, because its result is current or it failed before; else None.

    Raises
    ------
    UsageError
        When a result made from other settings exists and must not be replaced.
    """
    try:
        if is_current(task.path, task.key, job.overwrite):
            made = task.read(task.path) if task.read else Made()
            return _outcome(task, made, "kept")
    except DataError as error:
        if not job.overwrite:
            return Outcome(task.stage, task.item, task.path, "failed", str(error), cause="data")
    failure = None if job.retry or job.overwrite else remembered_failure(job, task)
    if failure is None:
        return None
    return Outcome(task.stage, task.item, task.path, "failed", failure.text, cause=failure.cause, before=True)


def perform(job: Job, task: Task) -> Outcome:
    """Run a task and return its outcome; an error becomes an outcome, so that the other tasks go on.

    Parameters
    ----------
    job : Job
        The job.
    task : Task
        The task to run.

    Returns
    -------
    Outcome
        Outcome of the task. A failure is recorded on disk, except for a missing input.

    Raises
    ------
    NoSpaceError
        When the disk is full.
    KeyboardInterrupt
        After Ctrl-C.
    """
    began = time.perf_counter()
    try:
        with writing_keyed(task.path, task.key) as part:
            made = task.write(job, task.item, part) or Made()
        forget_failure(job, task)
        return replace(_outcome(task, made, "made"), seconds=time.perf_counter() - began)
    except NoSpaceError:
        raise
    except Exception as error:
        if from_interrupt(error):
            raise KeyboardInterrupt from None
        failure = _failure_of(task, error)
    return fail(job, task, failure)


def fail(job: Job, task: Task, failure: Failure) -> Outcome:
    """Return the outcome of a failed task and record the failure on disk."""
    if failure.cause != "input":
        remember_failure(job, task, failure)
    return Outcome(task.stage, task.item, task.path, "failed", failure.text, cause=failure.cause)


def produce(job: Job, stage: str, item: str, path: Path, key: str, write: Callable[[Path], str | None]) -> Outcome:
    """Keep a result, or make it in this process; bad data become an outcome, so that the other results go on.

    Parameters
    ----------
    job : Job
        The job.
    stage, item : str
        Names of stage and item.
    path : pathlib.Path
        The result file.
    key : str
        Content key of the result.
    write : callable
        Function that makes the result, writes it to the given path, and may return a note about it.

    Returns
    -------
    Outcome
        Outcome of the result file.

    Raises
    ------
    UsageError
        When a result made from other settings exists and must not be replaced.
    """
    began = time.perf_counter()
    try:
        if is_current(path, key, job.overwrite):
            outcome = Outcome(stage, item, path, "kept")
        else:
            job.reporter.begin(stage, item)
            with writing_keyed(path, key) as part:
                text = write(part) or ""
            outcome = Outcome(stage, item, path, "made", text, time.perf_counter() - began)
    except NoSpaceError:
        raise
    except DataError as error:
        outcome = Outcome(stage, item, path, "failed", str(error), cause=cause_of(error))
    job.reporter.end(outcome)
    return outcome


def _outcome(task: Task, made: Made, state: str) -> Outcome:
    return Outcome(
        task.stage,
        task.item,
        task.path,
        "kept" if state == "kept" else "made",
        made.text,
        converged=made.converged,
        fit_percent=made.fit_percent,
    )


def _failure_of(task: Task, error: Exception) -> Failure:
    if isinstance(error, GbidError):
        return Failure(task.key, cause_of(error), str(error))
    if isinstance(error, MemoryError):
        return Failure(task.key, "crash", "not enough memory")
    text = " ".join(f"{type(error).__name__}: {error} (a defect of gbid, not of your input; please report it)".split())
    return Failure(task.key, "defect", text, traceback.format_exc())


class InTurn:
    """Engine that runs one task after the other in this process."""

    def outcomes(self, job: Job, tasks: Sequence[Task]) -> Generator[tuple[int, Outcome], None, None]:
        """Run the tasks in their order; yield number and outcome of each."""
        for number, task in enumerate(tasks):
            job.reporter.begin(task.stage, task.item)
            yield number, perform(job, task)

    def close(self) -> None:
        """Do nothing: there are no workers."""
