"""What a verb would make, without making it: `--dry-run`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from gbid.cli.printing import print_json, print_tables
from gbid.experiment.experiment import Experiment
from gbid.experiment.run.job import Job, Task
from gbid.experiment.run.perform import standing
from gbid.experiment.run.stage import Stage
from gbid.tables.table import Column, Table

_COLUMNS = (Column("stage"), Column("to make", format="d"), Column("there", format="d"), Column("failed", format="d"))
_LATER = "what is to be made is known when the stages before have run"


def print_plan(
    experiment: Experiment, stages: Sequence[Stage], as_json: bool, *, overwrite: bool = False, retry: bool = False
) -> None:
    """Print how many results of each stage are to be made, are there, and failed before; nothing is locked or written.

    Parameters
    ----------
    experiment : Experiment
        The experiment.
    stages : sequence of Stage
        Stages of the verb, in their order.
    as_json : bool
        Whether it is printed as a JSON document.
    overwrite, retry : bool
        Options of the verb.

    Raises
    ------
    UsageError
        When a result made from other settings exists and must not be replaced.
    """
    rows = plan_rows(Job(experiment, overwrite, retry=retry), stages)
    if as_json:
        print_json({"experiment": experiment.spec.name, "results": experiment.results, "plan": rows})
        return
    unknown = [row["stage"] for row in rows if row["to_make"] is None]
    notes = [f"results: {experiment.results}", *([f"{', '.join(unknown)}: {_LATER}"] if unknown else [])]
    table = [[row["stage"], row["to_make"], row["there"], row["failed"]] for row in rows]
    print_tables(Table("nothing is made: --dry-run", _COLUMNS, table, notes))


def plan_rows(job: Job, stages: Sequence[Stage]) -> list[dict[str, Any]]:
    """Return the counts of each stage that the experiment names; None where earlier stages have to run first."""
    rows: list[dict[str, Any]] = []
    pending = False
    for stage in stages:
        if not job.experiment.file.data.get(stage.section):
            continue
        if pending and not stage.early:
            rows.append({"stage": stage.name, "to_make": None, "there": None, "failed": None})
            continue
        work = stage.tasks(job)
        known = [standing(job, item) for item in work if isinstance(item, Task)]
        states = [outcome.state for outcome in known if outcome is not None]
        missing = known.count(None)
        failed = states.count("failed") + sum(not isinstance(item, Task) for item in work)
        rows.append({"stage": stage.name, "to_make": missing, "there": states.count("kept"), "failed": failed})
        pending = pending or missing > 0
    return rows
