"""States of the result files of an experiment: existing, failed, missing, or made with other settings."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Generic, Literal, TypeVar

from gbid.errors import GbidError, UsageError
from gbid.experiment.run.job import Job, Task
from gbid.experiment.run.perform import standing
from gbid.experiment.stages.fit.stage import fit_tasks
from gbid.experiment.stages.importing.stage import import_tasks
from gbid.experiment.stages.prefilter.stage import prefilter_tasks
from gbid.experiment.stages.rig.stage import rig_tasks

State = Literal["there", "failed", "missing", "stale"]
Value = TypeVar("Value")


@dataclass(frozen=True)
class Standing:
    """State of one planned result file.

    Attributes
    ----------
    stage, item : str
        Names of the stage and of the item.
    state : {"there", "failed", "missing", "stale"}
        ``stale``: made with other settings or data.
    text : str
        Reason of a missing result, or status of an existing fit.
    converged : bool
        False for a fit that did not converge.
    """

    stage: str
    item: str
    state: State
    text: str = ""
    converged: bool = True


@dataclass(frozen=True, eq=False)
class StageResults(Generic[Value]):
    """Results of one stage: existing ones, and reasons for missing ones.

    Attributes
    ----------
    found : dict of str to value
        Existing results by name.
    missing : dict of str to str
        Reason for each missing result, by name.
    """

    found: Mapping[str, Value]
    missing: Mapping[str, str]


def read_standings(job: Job) -> tuple[Standing, ...]:
    """Return the states of recordings, prefiltered recordings and fits, in this order."""
    tasks = [*rig_tasks(job), *import_tasks(job), *prefilter_tasks(job), *fit_tasks(job)]
    return tuple(_standing(job, task) for task in tasks)


def _standing(job: Job, task: Task) -> Standing:
    try:
        outcome = standing(job, task)
    except UsageError:
        return Standing(task.stage, task.item, "stale", "made with other settings or data, or by another gbid")
    if outcome is None:
        return Standing(task.stage, task.item, "missing", "not made yet")
    state: State = "failed" if outcome.state == "failed" else "there"
    return Standing(task.stage, task.item, state, outcome.text, outcome.converged)


def read_tasks(job: Job, tasks: Sequence[Task], verb: str, load: Callable[[Task], Value]) -> StageResults[Value]:
    """Return the existing results of tasks, and the reasons for missing ones.

    Parameters
    ----------
    job : Job
        The job.
    tasks : sequence of Task
        Tasks of one stage.
    verb : str
        Command that makes the results, such as ``"gbid static"``.
    load : callable
        Function that loads the result of a task.
    """
    found: dict[str, Value] = {}
    missing: dict[str, str] = {}
    for task in tasks:
        try:
            outcome = standing(job, task)
            if outcome is None:
                missing[task.item] = f"{task.stage} {task.item} not there; run `{verb}` or `gbid run`"
            elif outcome.state == "failed":
                missing[task.item] = f"{task.stage} {task.item} failed: {outcome.text}"
            else:
                found[task.item] = load(task)
        except GbidError as error:
            missing[task.item] = str(error)
    return StageResults(found, missing)
