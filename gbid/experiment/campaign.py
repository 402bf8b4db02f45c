"""Campaign: shards, lock of the results folder, run, cleaning, and the table of all fits."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import re
import shlex
import shutil
import socket
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from datetime import datetime
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING

from gbid import identify
from gbid.core import hdf5
from gbid.core.errors import DataError, UsageError, nearest
from gbid.core.files import find_stale_parts, refuse_links, remove_stale_parts
from gbid.core.index import NAME as INDEX
from gbid.core.index import load_index, save_index
from gbid.core.tables import write_csv
from gbid.experiment.engines import make_engine
from gbid.experiment.experiment import Experiment, fit_models
from gbid.experiment.fields import Item, stored_key
from gbid.experiment.run import (
    FAILED,
    Failure,
    Job,
    Outcome,
    Reporter,
    Stage,
    Task,
    go_on,
    produce,
    remembered_failure,
    run_tasks,
    standing,
)
from gbid.experiment.stages import registry
from gbid.experiment.stages.fit import FIT, fit_tasks, table_row
from gbid.experiment.stages.prefilter import with_needed
from gbid.identify.table import FitTable, TableEntry, csv_table, tabulate

if TYPE_CHECKING:
    from distributed import Client


@dataclass(frozen=True)
class Shard:
    """Shard of a campaign: part `number` of `count` parts, counted from one."""

    number: int
    count: int


def read_shard(text: str) -> Shard:
    """Return the shard of a text ``i/n``.

    Raises
    ------
    UsageError
        When the text has another form, or i is not within 1 to n.
    """
    numbers = re.fullmatch(r"(\d+)/(\d+)", text)
    if not numbers or not 1 <= int(numbers[1]) <= int(numbers[2]):
        raise UsageError(f"shard {text!r}; write i/n with i from 1 to n, as 3/8")
    return Shard(int(numbers[1]), int(numbers[2]))


def tasks_of(shard: Shard | None, experiment: Experiment, tasks: Sequence[Task]) -> list[Task]:
    """Return the tasks of a shard: recordings, their fits, and the stationary recordings that they need.

    Excited recordings are dealt out in turn, then staircases, hammer runs and run-ups. A stationary recording is made
    by each shard that needs it, and is always the same. Tasks that need recordings of several shards, such as a fit to
    all of them or the map of an operating point, are left to a run without shards.

    Parameters
    ----------
    shard : Shard or None
        The shard; None for all tasks.
    experiment : Experiment
        The experiment.
    tasks : sequence of Task
        Tasks of one stage.

    Returns
    -------
    list of Task
        The tasks of the shard, in their order.
    """
    if shard is None:
        return list(tasks)
    recordings = experiment.recordings.values()
    apart = sorted((q for q in recordings if not q.stationary), key=lambda planned: not planned.excited)
    dealt = apart[shard.number - 1 :: shard.count]
    points = {planned.point for planned in dealt if planned.excited}
    stationary = [q.name for q in recordings if q.stationary and q.point in points]
    needed = with_needed(experiment, [*(planned.name for planned in dealt), *stationary])
    return [task for task in tasks if needed.issuperset(task.recordings)]


def tasks_for(job: Job, item: str) -> list[tuple[Stage, list[Task]]]:
    """Return the tasks of one fit and of its inputs by stage; only the files of its recordings are read.

    Parameters
    ----------
    job : Job
        The job.
    item : str
        Name of the fit as in outcomes, ``FIT/MODEL``; the model is a recording, or ``together``.

    Raises
    ------
    UsageError
        When there is no such fit.
    """
    experiment = job.experiment
    items = {
        str(Item("fit", fit, model)): recordings
        for fit in experiment.spec.fits
        for model, recordings in fit_models(experiment, fit).items()
    }
    if item not in items:
        raise UsageError(f"--one {item}: no such fit; {nearest(item, items)}")
    names, part = with_needed(experiment, items[item]), replace(experiment)
    vars(part)["recordings"] = {name: q for name, q in experiment.recordings.items() if name in names}
    early = early_tasks(replace(job, experiment=part))
    return [(stage, [task for task in tasks if stage is not FIT or str(task.item) == item]) for stage, tasks in early]


def early_tasks(job: Job) -> list[tuple[Stage, list[Task]]]:
    """Return the stages from recordings to fits with their tasks, which are known before a run."""
    early = [stage for stage in registry.STAGES if stage.early]
    return [(stage, [item for item in stage.work(job) if isinstance(item, Task)]) for stage in early]


NAME = ".gbid.lock"


@contextlib.contextmanager
def locked(results: Path, shared: bool = False) -> Iterator[None]:
    """Return a context that locks a results folder for one process; the lock ends with the process.

    Parameters
    ----------
    results : pathlib.Path
        The folder; it is made when missing.
    shared : bool
        Whether other shards, each with tasks of its own, may use the folder at the same time.

    Raises
    ------
    UsageError
        When another runner has locked the folder.
    DataError
        When the folder cannot be written, its file system has no locks, or there is a link in it.
    """
    path = results / NAME
    try:
        results.mkdir(parents=True, exist_ok=True)
        refuse_links(results)
        handle = _take(path, shared)
    except BlockingIOError:
        text = f"another gbid is working in this folder{_owner(path)}; wait for it, or use --results to write elsewhere"
        raise UsageError(f"{results}: {text}") from None
    except OSError as error:
        text = f"{path}: cannot be locked: {error.strerror or error}; use --results to write elsewhere"
        raise DataError(text) from None
    try:
        if not shared:  # the owner, for the error message of another runner
            owner = {"host": socket.gethostname(), "process": os.getpid()}
            owner["since"] = f"{datetime.now():%Y-%m-%d %H:%M:%S}"
            with contextlib.suppress(OSError):  # the lock is valid also on a full disk
                os.ftruncate(handle, 0)
                os.pwrite(handle, json.dumps(owner).encode(), 0)
        yield
    finally:
        with contextlib.suppress(OSError):  # shards: the last one removes the file
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            path.unlink(missing_ok=True)
        os.close(handle)


def _take(path: Path, shared: bool) -> int:
    """Open and lock the lock file; retry if its last owner has removed the file meanwhile."""
    while True:
        handle = os.open(path, os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0), 0o666)
        try:
            fcntl.flock(handle, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
            if os.path.samestat(os.fstat(handle), path.stat()):
                return handle
        except FileNotFoundError:
            pass
        except BaseException:
            os.close(handle)
            raise
        os.close(handle)


def _owner(path: Path) -> str:
    try:
        owner = json.loads(path.read_text(encoding="utf-8"))
        return f" (process {owner['process']} on {owner['host']}, since {owner['since']})"
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return ""


@contextmanager
def working(
    experiment: Experiment,
    *,
    overwrite: bool = False,
    retry: bool = False,
    reporter: Reporter | None = None,
    engine: str = "auto",
    workers: int | None = None,
    scheduler: str | Client | None = None,
    shared: bool = False,
) -> Iterator[Job]:
    """Return a context that locks the results folder of an experiment and gives the job to run.

    At its beginning and end, temporary files of killed processes are removed.

    Parameters
    ----------
    experiment : Experiment
        The experiment to run.
    overwrite, retry : bool
        Options of `gbid.experiment.run.Job`.
    reporter : Reporter, optional
        Receiver of the progress; none by default.
    engine, workers, scheduler
        Options of `make_engine`.
    shared : bool
        Whether other processes, each with a shard or a fit of its own, may use the folder at the same time.

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
            if not shared:
                load_index(experiment.results)
            # Kept in the job, because a worker of a pool has another command line.
            words = (
                "=".join(experiment.beside(part) if Path(part).is_absolute() else part for part in word.split("="))
                for word in sys.argv[1:]
            )
            command = shlex.join([*(Path(word).name for word in sys.argv[:1]), *words])
            yield Job(experiment, overwrite, reporter or Reporter(), chosen, retry, command)
        finally:
            chosen.close()
            remove_stale_parts(experiment.results)
            if not shared:
                save_index(experiment.results)


def run_campaign(job: Job, shard: Shard | None = None, one: str | None = None) -> list[Outcome]:
    """Simulate or import, prefilter and fit the recordings of an experiment; current results are kept.

    Parameters
    ----------
    job : Job
        Job from `working`.
    shard : Shard, optional
        Part of the campaign to run; all of it by default.
    one : str, optional
        The one fit to make, with what it needs; see `tasks_for`.

    Returns
    -------
    list of Outcome
        Outcomes of all results, with those that existed already.

    Raises
    ------
    UsageError
        When there is no such fit, or when a result made from other settings exists and must not be replaced. No task
        has run then.
    NoSpaceError
        When the disk is full; complete results are kept.
    """
    if one is not None:
        plan = tasks_for(job, one)
    else:
        plan = [(stage, tasks_of(shard, job.experiment, tasks)) for stage, tasks in early_tasks(job)]
    standings = [[standing(job, task) for task in tasks] for _, tasks in plan]  # of all stages before any runs
    outcomes: list[Outcome] = []
    failed: dict[str, Outcome] = {}  # by recording
    for (stage, tasks), known in zip(plan, standings, strict=True):
        settled = [outcome or _without_input(task, failed) for task, outcome in zip(tasks, known, strict=True)]
        made = run_tasks(job, tasks, settled)
        for outcome in made:
            if outcome.state == "failed" and stage is not FIT:
                failed.setdefault(outcome.item.section, outcome)
        outcomes += made if shard is not None or one is not None or not made else go_on(job, stage, made)
    return outcomes


def _without_input(task: Task, failed: Mapping[str, Outcome]) -> Outcome | None:
    """Return a failed outcome for a task whose recording failed; None for other tasks."""
    source = next((failed[name] for name in task.recordings if name in failed), None)
    if source is None:
        return None
    return task.failed(Failure(task.key, "input", f"its input is missing: {source.item.stage} {source.item} failed"))


def stale_files(results: Path, everything: bool = False, kernels: Path | None = None) -> list[Path]:
    """Return temporary files of processes that are gone, and records of failures.

    Parameters
    ----------
    results : pathlib.Path
        Folder of the results.
    everything : bool
        Whether the results themselves are among them: all files with a content key.
    kernels : pathlib.Path, optional
        Folder of compiled kernels, which are then among them as well.
    """
    stale = [*find_stale_parts(results), *(results / FAILED).rglob("*.json")]
    if everything:
        stale += [path for path in results.rglob("[!.]*") if path.is_file() and stored_key(path)]
        stale += results.glob(INDEX)
    if kernels is not None and kernels.is_dir():
        stale += [*find_stale_parts(kernels), *kernels.glob("*.so"), *kernels.glob("*.lock")]
    return sorted(dict.fromkeys(stale))


def remove(results: Path, files: Sequence[Path]) -> None:
    """Remove files, and results folders that are empty afterwards.

    Raises
    ------
    DataError
        When a file cannot be removed.
    """
    for path in files:
        try:
            if path.is_dir():
                shutil.rmtree(path)
            else:
                path.unlink(missing_ok=True)
        except OSError as error:
            raise DataError(f"{path}: cannot be removed: {error.strerror or error}") from None
    for folder in sorted((path for path in results.rglob("*") if path.is_dir()), reverse=True):
        with contextlib.suppress(OSError):  # not empty
            folder.rmdir()


TABLE = "table"
NOT_MADE = "not made yet; run `gbid batch`"


def collect(job: Job) -> tuple[identify.FitTable, list[Outcome]]:
    """Write ``table.h5`` and ``table.csv`` with one row for each planned fit, existing or missing.

    A table of an earlier state of the same campaign is replaced; all its data are also in the fits.

    Parameters
    ----------
    job : Job
        The job.

    Returns
    -------
    table : FitTable
        The table.
    outcomes : list of Outcome
        Outcomes of the two files.
    """
    experiment = job.experiment
    models = [(fit, model) for fit in experiment.spec.fits for model in fit_models(experiment, fit)]
    tasks = fit_tasks(job)
    states = _states(job, tasks)
    results = [
        experiment.result(Item("table", TABLE, form=f"{{}}{ending}"), "", {"states": states}, tasks, ending=ending)
        for ending in (".h5", ".csv")
    ]
    if all(result.is_made for result in results):
        table = hdf5.load(results[0].path, FitTable)
    else:
        table = tabulate(
            [_entry(job, *model, task, state) for model, task, state in zip(models, tasks, states, strict=True)]
        )
    writers: tuple[Callable[[Path], None], ...] = (
        lambda part: hdf5.save(table, part, overwrite=True),
        lambda part: write_csv(csv_table(table), part),
    )
    outcomes = []
    for result, write in zip(results, writers, strict=True):
        ours = bool(stored_key(result.path)) or not result.path.exists()
        outcomes.append(produce(replace(job, overwrite=job.overwrite or ours), result, write))
    return table, outcomes


def _entry(job: Job, fit: str, model: str, task: Task, state: bool | str) -> TableEntry:
    conditions = [job.experiment.recordings[name].conditions for name in task.recordings]
    first: Mapping[str, float] = conditions[0] if conditions else {}
    shared = {k: v for k, v in first.items() if all(other.get(k) == v for other in conditions)}
    row, failure = None, state if isinstance(state, str) else ""
    if not failure:
        try:
            row = table_row(task.path)
        except DataError as error:
            failure = str(error)
    return TableEntry(fit, model, task.recordings, shared, failure=failure, row=row)


def _states(job: Job, tasks: Sequence[Task]) -> list[bool | str]:
    """Return for each fit True if its result exists, else the reason as text."""
    made = [task.is_made for task in tasks]
    sources: dict[str, list[Task]] = {}
    if not all(made):
        earlier = [early for stage, early in early_tasks(job) if stage is not FIT]
        for source in chain.from_iterable(earlier):
            sources.setdefault(source.item.section, []).append(source)
    return [state or _why_not(job, task, sources) for state, task in zip(made, tasks, strict=True)]


def _why_not(job: Job, task: Task, sources: Mapping[str, list[Task]]) -> str:
    """Return the reason for a missing result: failed fit, failed input, or not run yet."""
    failure = remembered_failure(job, task)
    if failure is not None:
        return f"failed: {failure.text}"
    for source in (source for name in task.recordings for source in sources.get(name, ())):
        failure = remembered_failure(job, source)
        if failure is not None:
            return f"failed: {source.item.stage} {source.item}: {failure.text}"
    return NOT_MADE
