"""A stage of an experiment: what a section of the YAML means, and the tasks that make its results."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from gbid.experiment.experiment import Check
from gbid.experiment.run.job import Job, Task
from gbid.experiment.run.outcome import Outcome
from gbid.experiment.run.perform import run_tasks
from gbid.experiment.run.view import View

Work = Sequence[Task | Outcome]
"""Tasks, and outcomes of items that need none, because nothing can be done for them."""


@dataclass(frozen=True)
class Stage:
    """A stage.

    Attributes
    ----------
    name : str
        As progress and outcomes call it.
    section : str
        Its key in the YAML; the form of the section is a field of `gbid.experiment.schema.ExperimentFile`.
    checks : tuple of callable
        What is wrong with the section, as far as it can be known before anything runs.
    tasks : callable
        Work of the section; none when the YAML does not have it.
    then : tuple of callable
        Work that starts from what the stage has made so far, as tables of its results; one after the other.
    early : bool
        Whether its tasks are known before any other stage has run. These stages make a campaign.
    view : View, optional
        What verbs show of it. Those of gbid's own stages are in `gbid.cli.views`, above the tables of the report.
        A stage without one shows its outcomes.
    """

    name: str
    section: str
    checks: tuple[Check, ...]
    tasks: Callable[[Job], Work]
    then: tuple[Callable[[Job, Sequence[Outcome]], Work], ...] = ()
    early: bool = False
    view: View | None = None


def run_stage(job: Job, stage: Stage) -> list[Outcome]:
    """Make the results of a stage, or keep them.

    Returns
    -------
    list of Outcome
        Empty when the YAML does not have the section. What cannot be made does not stop the rest.

    Raises
    ------
    UsageError
        When a result made from other settings is there and may not be replaced.
    NoSpaceError
        When the disk is full.
    """
    return go_on(job, stage, do_work(job, stage.tasks(job)))


def go_on(job: Job, stage: Stage, made: Sequence[Outcome]) -> list[Outcome]:
    """Make what starts from the results of a stage's tasks; return the outcomes of both."""
    outcomes = list(made)
    for work in stage.then:
        outcomes += do_work(job, work(job, outcomes))
    return outcomes


def do_work(job: Job, work: Work) -> list[Outcome]:
    """Run tasks, after telling the outcomes of items that need none."""
    settled = [item for item in work if isinstance(item, Outcome)]
    for outcome in settled:
        job.reporter.end(outcome)
    return [*settled, *run_tasks(job, [item for item in work if isinstance(item, Task)])]
