"""Stage of an experiment: a section of the YAML, its checks, and the tasks that make its results."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from gbid.experiment.experiment import Check, Experiment
from gbid.experiment.run.job import Job, Task
from gbid.experiment.run.outcome import Outcome
from gbid.experiment.run.perform import run_tasks
from gbid.experiment.run.view import View

Work = Sequence[Task | Outcome]
"""Tasks to run, and outcomes of items for which no task is possible."""


def always(_: Experiment) -> bool:
    """Return true: `gbid run` runs a stage."""
    return True


@dataclass(frozen=True)
class Stage:
    """Stage of an experiment.

    Attributes
    ----------
    name : str
        Name of the stage in progress and outcomes.
    section : str
        Key of its section in the YAML; a field of `gbid.experiment.schema.ExperimentFile` defines the section.
    checks : tuple of callable
        Checks of the section that are possible before a run.
    tasks : callable
        Function that returns the work of the section; empty when the YAML has no such section.
    then : tuple of callable
        Functions that return work on the results of the stage, such as tables; run one after the other.
    early : bool
        Whether its tasks are known before any other stage has run. Campaigns consist of these stages.
    in_run : callable
        Whether `gbid run` runs the stage for an experiment; its own verb does so in any case.
    view : View, optional
        JSON document and tables of its outcomes for verbs. Those of gbid's own stages are in `gbid.cli.views`. Without
        a view, the outcomes are shown as a list.
    """

    name: str
    section: str
    checks: tuple[Check, ...]
    tasks: Callable[[Job], Work]
    then: tuple[Callable[[Job, Sequence[Outcome]], Work], ...] = ()
    early: bool = False
    in_run: Callable[[Experiment], bool] = always
    view: View | None = None


def run_stage(job: Job, stage: Stage) -> list[Outcome]:
    """Make or keep the results of a stage and return their outcomes.

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
    return go_on(job, stage, do_work(job, stage.tasks(job)))


def go_on(job: Job, stage: Stage, made: Sequence[Outcome]) -> list[Outcome]:
    """Make the results that start from those of the stage's tasks; return the outcomes of both."""
    outcomes = list(made)
    for work in stage.then:
        outcomes += do_work(job, work(job, outcomes))
    return outcomes


def do_work(job: Job, work: Work) -> list[Outcome]:
    """Run tasks and return their outcomes, after those of items that need no task."""
    settled = [item for item in work if isinstance(item, Outcome)]
    for outcome in settled:
        job.reporter.end(outcome)
    return [*settled, *run_tasks(job, [item for item in work if isinstance(item, Task)])]
