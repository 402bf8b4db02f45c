"""Table of all fits of a campaign."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

from gbid.campaign.plan import early_tasks
from gbid.errors import DataError
from gbid.experiment.keys import content_key, stored_key
from gbid.experiment.run.failures import remembered_failure
from gbid.experiment.run.job import Job, Task
from gbid.experiment.run.outcome import Outcome
from gbid.experiment.run.perform import produce
from gbid.experiment.stages.fit.stage import FIT, fit_tasks
from gbid.identify import FitTable, TableEntry, load_fit, load_table, save_table, tabulate
from gbid.identify.table.table_store import csv_table
from gbid.tables.csv import write_csv

NAME = "table"
NOT_MADE = "not made yet; run `gbid batch`"


def collect(job: Job) -> tuple[FitTable, list[Outcome]]:
    """Write ``table.h5`` and ``table.csv`` with one row for each fit of the experiment, made or missing.

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
    tasks = fit_tasks(job)
    states = _states(job, tasks)
    key = content_key("table", {"states": states}, [task.key for task in tasks])
    paths = [job.path("", NAME, ending) for ending in (".h5", ".csv")]
    if all(stored_key(path) == key for path in paths):
        table = load_table(paths[0])
    else:
        entries = [_entry(job, task, state) for task, state in zip(tasks, states, strict=True)]
        table = tabulate(entries)
    writers: tuple[Callable[[Path], None], ...] = (
        partial(_write_h5, table),
        partial(_write_csv, table, key),
    )
    outcomes = []
    for path, write in zip(paths, writers, strict=True):
        mine = bool(stored_key(path)) or not path.exists()
        allowed = Job(job.experiment, job.overwrite or mine, job.reporter)
        outcomes.append(produce(allowed, "table", path.name, path, key, write))
    return table, outcomes


def _entry(job: Job, task: Task, state: bool | str) -> TableEntry:
    fit, _, model = task.item.partition("/")
    conditions = [job.experiment.recordings[name].conditions for name in task.recordings]
    shared = {k: v for k, v in conditions[0].items() if all(other.get(k) == v for other in conditions)}
    if isinstance(state, str):
        return TableEntry(fit, model, task.recordings, shared, failure=state)
    try:
        return TableEntry(fit, model, task.recordings, shared, load_fit(task.path))
    except DataError as error:
        return TableEntry(fit, model, task.recordings, shared, failure=str(error))


def _states(job: Job, tasks: Sequence[Task]) -> list[bool | str]:
    """Return, for each fit, true when its result exists, else the reason as text."""
    there = [stored_key(task.path) == task.key for task in tasks]
    sources: dict[str, list[Task]] = {}
    if not all(there):
        for source in (task for _, found in early_tasks(job) for task in found if task.stage != FIT.name):
            sources.setdefault(source.item, []).append(source)
    return [found or _why_not(job, task, sources) for found, task in zip(there, tasks, strict=True)]


def _why_not(job: Job, task: Task, sources: Mapping[str, list[Task]]) -> str:
    """Return the reason of a missing result: the fit or one of its inputs failed, or it was not made yet."""
    failure = remembered_failure(job, task)
    if failure is not None:
        return f"failed: {failure.text}"
    for source in (source for name in task.recordings for source in sources.get(name, ())):
        failure = remembered_failure(job, source)
        if failure is not None:
            return f"failed: {source.stage} {source.item}: {failure.text}"
    return NOT_MADE


def _write_h5(table: FitTable, part: Path) -> None:
    save_table(table, part, overwrite=True)


def _write_csv(table: FitTable, key: str, part: Path) -> None:
    write_csv(csv_table(table), part, [f"content_key: {key}"])
