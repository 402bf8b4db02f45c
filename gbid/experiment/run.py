"""Run of an experiment: job, tasks, outcomes, remembered failures, and stages."""

from __future__ import annotations

import json
import math
import time
import traceback
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Protocol, get_args

from gbid.core.arrays import one_blas_thread
from gbid.core.errors import DataError, GbidError, NoSpaceError, UsageError, from_interrupt
from gbid.core.files import atomic_path
from gbid.core.tables import Column, Table
from gbid.experiment.experiment import Check, Experiment
from gbid.experiment.fields import InputError, Item, Result, is_current, writing_keyed

if TYPE_CHECKING:
    from gbid.control.tuning.problem import SearchStep
    from gbid.identify import Progress

State = Literal["made", "kept", "failed", "missing", "stale"]
Cause = Literal["", "input", "data", "usage", "defect", "crash"]


@dataclass(frozen=True)
class Outcome:
    """Outcome of one result file: state, cause of failure, and summary.

    Attributes
    ----------
    item : Item
        What the result is about.
    path : pathlib.Path
        The result file.
    state : {"made", "kept", "failed", "missing", "stale"}
        ``kept``: the file existed already, made from the same settings and data. Results that are only looked at may be
        ``missing``, or ``stale``: made from others.
    text : str
        Reason of a failure, or a note about the result.
    seconds : float
        Computing time [s].
    converged : bool
        False for a fit that did not converge; its file is written anyway.
    fit_percent : float
        For a fit, the smallest fit percent of its outputs; nan for other results.
    cause : {"", "input", "data", "usage", "defect", "crash"}
        Cause of a failure: missing input, bad data, wrong options, defect of gbid, or death of the process.
    before : bool
        Whether the task failed in an earlier run and was not tried again.
    """

    item: Item
    path: Path
    state: State
    text: str = ""
    seconds: float = 0.0
    converged: bool = True
    fit_percent: float = math.nan
    cause: Cause = ""
    before: bool = False


@dataclass(frozen=True)
class Made:
    """Summary of a result; its fields are fields of `Outcome` as well."""

    text: str = ""
    converged: bool = True
    fit_percent: float = math.nan


class Reporter:
    """Receiver of the progress of stages; this base class ignores all events."""

    def expect(self, stage: str, todo: int, there: int, failed: int) -> None:
        """Receive the numbers of new, existing and previously failed items of a stage, before their outcomes."""

    def begin(self, item: Item) -> None:
        """Receive the start of an item."""

    def iteration(self, progress: Progress) -> None:
        """Receive an iteration of the solver."""

    def search(self, step: SearchStep) -> None:
        """Receive a step of a search for gains."""

    def lose(self, items: Sequence[Item], count: int) -> None:
        """Receive the items of a lost worker, which are retried, and the number of lost workers so far."""

    def end(self, outcome: Outcome) -> None:
        """Receive the outcome of an item."""


@dataclass(frozen=True)
class Task(Result):
    """Task that computes one result file, in any process.

    Attributes
    ----------
    write : callable
        Function that makes the result, writes it to the given path, and may return its summary. It is defined in a
        module, or a `functools.partial` of such a function, so that another process can import it.
    recordings : tuple of str
        Recordings from which the result is made.
    read : callable, optional
        Function that returns the summary of an existing result: the same as `write` returned.
    """

    write: Callable[[Job, Path], Made | None]
    recordings: tuple[str, ...] = ()
    read: Callable[[Path], Made] | None = None

    @classmethod
    def of(
        cls,
        result: Result,
        write: Callable[[Job, Path], Made | None],
        recordings: Iterable[str] = (),
        read: Callable[[Path], Made] | None = None,
    ) -> Task:
        """Return the task that computes a result."""
        return cls(result.item, result.path, result.key, write, tuple(recordings), read)

    def failed(self, failure: Failure, before: bool = False) -> Outcome:
        """Return the outcome of the task after a failure in this or an earlier run."""
        return Outcome(self.item, self.path, "failed", failure.text, cause=failure.cause, before=before)

    def ended(self, state: State, made: Made, seconds: float = 0.0) -> Outcome:
        """Return the outcome of the task with the summary of its result."""
        return Outcome(self.item, self.path, state, made.text, seconds, made.converged, made.fit_percent)


class TaskEngine(Protocol):
    """Engine that runs tasks in this process or in others."""

    def outcomes(self, job: Job, tasks: Sequence[Task]) -> Generator[tuple[int, Outcome], None, None]:
        """Run tasks; yield index and outcome of each as soon as it ends, in any order.

        The engine informs the reporter of the job when a task begins. Closing the generator stops the running tasks.

        Raises
        ------
        NoSpaceError
            When the disk is full; the remaining tasks are not run.
        """
        ...

    def close(self) -> None:
        """Stop the workers of the engine."""
        ...


@dataclass(frozen=True)
class Job:
    """Experiment with the options of its run.

    Attributes
    ----------
    experiment : Experiment
        The experiment to run.
    overwrite : bool
        Whether results made from other settings may be replaced.
    reporter : Reporter
        Receiver of the progress.
    engine : TaskEngine, optional
        Engine that runs the tasks; without it they run one after the other in this process.
    retry : bool
        Whether tasks that failed in an earlier run, with the same settings and data, are tried again.
    command : str
        Command line that runs the job, for its result files.
    """

    experiment: Experiment
    overwrite: bool = False
    reporter: Reporter = field(default_factory=Reporter)
    engine: TaskEngine | None = None
    retry: bool = False
    command: str = ""

    def path(self, *names: str, ending: str = ".h5") -> Path:
        """Return the path of a result, as `Experiment.path` does."""
        return self.experiment.path(*names, ending=ending)


FAILED = "failed"
"""Folder of the records of failures, in the results."""


@dataclass(frozen=True)
class Failure:
    """Cause of the failure of a task.

    Attributes
    ----------
    key : str
        Content key of the missing result. The task is tried again when settings or data change.
    cause : str
        Kind of cause, as in `Outcome`.
    text : str
        Text of the error.
    details : str
        Traceback of a defect, else empty.
    """

    key: str
    cause: Cause
    text: str
    details: str = ""


def failure_path(job: Job, result: Result) -> Path:
    """Return the path of the record of a failure, ``failed/<stage>/<item>.json``."""
    return job.path(FAILED, result.item.stage, *result.item.names, ending=".json")


def remember_failure(job: Job, result: Result, failure: Failure) -> None:
    """Write the record of a failure.

    Raises
    ------
    DataError
        When the record cannot be written.
    """
    when = datetime.now(UTC).isoformat(timespec="seconds")
    document = {"stage": result.item.stage, "item": str(result.item), **failure.__dict__, "when": when}
    with atomic_path(failure_path(job, result), overwrite=True) as part:
        part.write_text(json.dumps(document, indent=2) + "\n", encoding="utf-8")


def remembered_failure(job: Job, result: Result) -> Failure | None:
    """Return the recorded failure of a result for equal settings and data; None without a readable record."""
    try:
        document = json.loads(failure_path(job, result).read_text(encoding="utf-8"))
        failure = Failure(*(str(document[key]) for key in ("key", "cause", "text", "details")))  # type: ignore[arg-type]
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return None
    return failure if failure.key == result.key and failure.cause in get_args(Cause) else None


def cause_of(error: GbidError) -> Cause:
    """Return the kind of cause of an error: missing input, wrong options, or bad data."""
    if isinstance(error, InputError):
        return "input"
    return "usage" if isinstance(error, UsageError) else "data"


def run_tasks(job: Job, tasks: Sequence[Task], known: Sequence[Outcome | None] | None = None) -> list[Outcome]:
    """Keep current results and compute the others with the engine of the job.

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
    outcomes = dict(enumerate(known or [standing(job, task) for task in tasks]))
    todo = [number for number, outcome in outcomes.items() if outcome is None]
    settled = [outcome for outcome in outcomes.values() if outcome is not None]
    failed = sum(outcome.state == "failed" for outcome in settled)
    job.reporter.expect(tasks[0].item.stage, len(todo), len(settled) - failed, failed)
    for outcome in settled:
        job.reporter.end(outcome)
    if todo:
        with closing((job.engine or InTurn()).outcomes(job, [tasks[number] for number in todo])) as running:
            for which, outcome in running:
                outcomes[todo[which]] = ended = replace(outcome, path=tasks[todo[which]].path)
                job.reporter.end(ended)
    return [outcome for outcome in outcomes.values() if outcome is not None]


def standing(job: Job, task: Task) -> Outcome | None:
    """Return the outcome of a task that need not run: its result is current or it failed before; else None.

    Raises
    ------
    UsageError
        When a result made from other settings exists and must not be replaced.
    """
    try:
        if is_current(task.path, task.key, job.overwrite):
            return task.ended("kept", task.read(task.path) if task.read else Made())
    except DataError as error:
        if not job.overwrite:
            return task.failed(Failure(task.key, "data", str(error)))
    failure = None if job.retry or job.overwrite else remembered_failure(job, task)
    return None if failure is None else task.failed(failure, before=True)


def perform(job: Job, task: Task) -> Outcome:
    """Run a task and return its outcome; an error becomes a failed outcome, so that other tasks continue.

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
    try:
        outcome = _make(job, task)
        failure_path(job, task).unlink(missing_ok=True)
        return outcome
    except NoSpaceError:
        raise
    except Exception as error:
        if from_interrupt(error):
            raise KeyboardInterrupt from None
        return fail(job, task, _failure_of(task, error))


def _make(job: Job, task: Task) -> Outcome:
    began = time.perf_counter()
    fit = task.item.section if task.item.stage == "fit" else ""
    origin = {**job.experiment.origin(task.recordings, fit), "command": job.command}
    with one_blas_thread(), writing_keyed(task.path, task.key, origin) as part:
        made = task.write(job, part) or Made()
    return task.ended("made", made, time.perf_counter() - began)


def fail(job: Job, task: Task, failure: Failure) -> Outcome:
    """Return the outcome of a failed task and record the failure on disk."""
    if failure.cause != "input":
        remember_failure(job, task, failure)
    return task.failed(failure)


def produce(job: Job, result: Result, write: Callable[[Path], str | None]) -> Outcome:
    """Keep a result or compute it in this process; bad data become a failed outcome, so that other results continue.

    Parameters
    ----------
    job : Job
        The job.
    result : Result
        The result file.
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
    task = Task.of(result, lambda _, part: Made(write(part) or ""))
    try:
        if is_current(task.path, task.key, job.overwrite):
            outcome = task.ended("kept", Made())
        else:
            job.reporter.begin(task.item)
            outcome = _make(job, task)
    except NoSpaceError:
        raise
    except DataError as error:
        outcome = task.failed(_failure_of(task, error))
    job.reporter.end(outcome)
    return outcome


def _failure_of(task: Task, error: Exception) -> Failure:
    if isinstance(error, GbidError):
        return Failure(task.key, cause_of(error), str(error))
    if isinstance(error, MemoryError):
        return Failure(task.key, "crash", "not enough memory")
    text = " ".join(f"{type(error).__name__}: {error} (a defect of gbid, not of your input; please report it)".split())
    return Failure(task.key, "defect", text, traceback.format_exc())


class InTurn:
    """Engine that runs tasks one by one in this process."""

    def outcomes(self, job: Job, tasks: Sequence[Task]) -> Generator[tuple[int, Outcome], None, None]:
        """Run the tasks in order; yield index and outcome of each."""
        for number, task in enumerate(tasks):
            job.reporter.begin(task.item)
            yield number, perform(job, task)

    def close(self) -> None:
        """Do nothing, because there are no workers."""


Document = Mapping[str, Any]


@dataclass(frozen=True)
class View:
    """JSON document and tables of a stage.

    Attributes
    ----------
    document : callable
        Function that returns the entries of the JSON document from the outcomes of a run; it skips other stages.
    tables : callable
        Function that returns the tables for a terminal.
    """

    document: Callable[[Job, Sequence[Outcome]], Document]
    tables: Callable[[Job, Sequence[Outcome]], Iterable[Table]]


def outcomes_view(stage: str, key: str) -> View:
    """Return the default view of a stage: the list of its outcomes under a key of the JSON document."""
    columns = [Column("item"), Column("state"), Column("text", wrap=True)]

    def document(_: Job, outcomes: Sequence[Outcome]) -> Document:
        made = [o for o in outcomes if o.item.stage == stage]
        return {key: [{"item": str(o.item), "state": o.state, "text": o.text, "path": str(o.path)} for o in made]}

    def tables(job: Job, outcomes: Sequence[Outcome]) -> list[Table]:
        rows = [[row[column.name] for column in columns] for row in document(job, outcomes)[key]]
        return [Table(stage, columns, rows)] if rows else []

    return View(document, tables)


Work = Sequence[Task | Outcome]
"""Tasks to run, and outcomes of items for which no task is possible."""


def no_tasks(_: Job) -> Work:
    """Return no work, for a stage whose section is only checked."""
    return ()


def has_section(experiment: Experiment, key: str) -> bool:
    """Return whether an experiment has a section, by its key in the YAML."""
    return bool(getattr(experiment.spec, "imported" if key == "import" else key, None))


@dataclass(frozen=True)
class Stage:
    """Stage of an experiment: YAML section, checks, and tasks that compute its results.

    Attributes
    ----------
    name : str
        Name of the stage in progress and outcomes.
    section : str
        Key of its section in the YAML; a field of `gbid.experiment.schema.ExperimentFile` defines the section.
    checks : tuple of callable
        Checks of the section that are possible before a run; not called when the YAML has no such section.
    tasks : callable
        Function that returns the work of the section; not called when the YAML has no such section.
    then : tuple of callable
        Functions that return work on the results of the stage, such as tables; run one after the other.
    early : bool
        Whether its tasks are known before any other stage has run. Campaigns consist of these stages.
    in_run : callable
        Whether `gbid run` runs the stage for an experiment; its own verb does so in any case.
    view : View, optional
        JSON document and tables of its outcomes for verbs. Those of gbid's own stages are in `gbid.report.views`.
        Without a view, the outcomes are shown as a list.
    """

    name: str
    section: str
    checks: tuple[Check, ...]
    tasks: Callable[[Job], Work]
    then: tuple[Callable[[Job, Sequence[Outcome]], Work], ...] = ()
    early: bool = False
    in_run: Callable[[Experiment], bool] = lambda _: True
    view: View | None = None

    def work(self, job: Job) -> Work:
        """Return the work of the section; empty if the YAML has no such section."""
        return self.tasks(job) if has_section(job.experiment, self.section) else ()


def run_stage(job: Job, stage: Stage) -> list[Outcome]:
    """Compute or keep the results of a stage and return their outcomes.

    Returns
    -------
    list of Outcome
        Empty when the YAML has no such section. A failure does not stop the other tasks.

    Raises
    ------
    UsageError
        When a result made from other settings exists and must not be replaced.
    NoSpaceError
        When the disk is full.
    """
    return go_on(job, stage, do_work(job, stage.work(job)))


def go_on(job: Job, stage: Stage, made: Sequence[Outcome]) -> list[Outcome]:
    """Compute the follow-up results of a stage; return the outcomes of its tasks and of the follow-up."""
    outcomes = list(made)
    for work in stage.then if has_section(job.experiment, stage.section) else ():
        outcomes += do_work(job, work(job, outcomes))
    return outcomes


def do_work(job: Job, work: Work) -> list[Outcome]:
    """Run tasks and return their outcomes, after the outcomes that need no task."""
    settled = [item for item in work if isinstance(item, Outcome)]
    for outcome in settled:
        job.reporter.end(outcome)
    return [*settled, *run_tasks(job, [item for item in work if isinstance(item, Task)])]
