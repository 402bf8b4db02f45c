"""Stage of the identification-for-control cycle: record in closed loop, fit and tune again, and try it by impacts."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from gbid.control.assessment.tuned_design import load_tuned
from gbid.errors import GbidError
from gbid.experiment.experiment import Experiment
from gbid.experiment.keys import content_key, stored_key
from gbid.experiment.run.inputs import cause_of
from gbid.experiment.run.job import Job, Task
from gbid.experiment.run.outcome import Outcome
from gbid.experiment.run.stage import Stage, Work
from gbid.experiment.stages.cycle.checks import cycle_can_run
from gbid.experiment.stages.cycle.closed_recordings import fit_key, fit_tasks, recording_tasks
from gbid.experiment.stages.cycle.plan import (
    FOLDER,
    controller_file,
    cycle_design,
    cycle_section,
    round_recordings,
    surfaces_file,
    trial_recordings,
)
from gbid.experiment.stages.cycle.redesign import controller_task, design_task, model_task, surfaces_task
from gbid.experiment.stages.cycle.rows import CycleRow, cycle_table, read_cycle, rows_of_round
from gbid.experiment.stages.cycle.schema import MOST_ROUNDS
from gbid.experiment.stages.cycle.trial import load_studies, study_path, study_tasks
from gbid.experiment.stages.lpv.surfaces import Surfaces
from gbid.experiment.stages.tune.plan import controller_section
from gbid.experiment.stages.tune.stage import key_from_surfaces, read_designs
from gbid.lpv import load_lpv_fit
from gbid.tables.csv import write_csv

TABLE = "cycle"
"""Name of the table of all rounds."""

Step = Callable[[Job, int], list[Task]]


def first_tasks(job: Job) -> Work:
    """Return the tasks of the impacts with the design of the experiment; a failed outcome when there is none."""
    if job.experiment.spec.cycle is None:
        return []
    path = job.path(FOLDER, TABLE, ".csv")
    try:
        name = cycle_design(job.experiment)
        missing = read_designs(job)[1].get(name)
        if missing is None:
            return recording_tasks(job, trial_recordings(job.experiment, 0))
        return [Outcome("cycle recording", "round0", path, "failed", f"design {name}: {missing}", cause="input")]
    except GbidError as error:
        return [Outcome("cycle recording", "round0", path, "failed", str(error), cause=cause_of(error))]


_STEPS: tuple[Step, ...] = (
    lambda job, number: recording_tasks(job, round_recordings(job.experiment, number)),
    fit_tasks,
    lambda job, number: [surfaces_task(job, number)],
    lambda job, number: [model_task(job, number)],
    lambda job, number: [design_task(job, number)],
    lambda job, number: [controller_task(job, number)],
    lambda job, number: recording_tasks(job, trial_recordings(job.experiment, number)),
    study_tasks,
)
"""Steps of a round, each on the results of those before."""


def _next(step: Step, number: int, job: Job, made: Sequence[Outcome]) -> Work:
    """Return the work of a step of a round; none after a failure, because all later steps need its result."""
    section = job.experiment.spec.cycle
    if section is None or number > section.rounds or any(outcome.state == "failed" for outcome in made):
        return []
    return step(job, number)


def _table_tasks(job: Job, made: Sequence[Outcome]) -> list[Task]:
    if job.experiment.spec.cycle is None or any(outcome.state == "failed" for outcome in made):
        return []
    return [table_task(job)]


def _in_run(experiment: Experiment) -> bool:
    return experiment.spec.cycle is None or experiment.spec.cycle.in_run


def table_task(job: Job) -> Task:
    """Return the task of the table of all rounds."""
    return Task("cycle table", TABLE, job.path(FOLDER, TABLE, ".csv"), _table_key(job), _write_table)


def made_rows(job: Job) -> list[CycleRow]:
    """Return the rows of the cycle when all its results are there; nothing is computed.

    Returns
    -------
    list of CycleRow
        Empty without the section, and while results are missing or were made from other settings.
    """
    if job.experiment.spec.cycle is None:
        return []
    try:
        task = table_task(job)
    except (GbidError, OSError):  # files of a round are missing
        return []
    return read_cycle(task.path) if stored_key(task.path) == task.key else []


def _table_key(job: Job) -> str:
    """Return the content key of the table: of all that the rounds are made from, and of all that they made."""
    experiment, rounds = job.experiment, _rounds(job)
    section = controller_section(experiment, cycle_design(experiment))
    fitted = [fit_key(job, one) for number in rounds[1:] for one in round_recordings(experiment, number).values()]
    designs = [key_from_surfaces(experiment, section, surfaces_file(job, number)) for number in rounds]
    tried = [task.key for number in rounds for task in study_tasks(job, number)]
    files = [surfaces_file(job, number) for number in rounds]
    files += [controller_file(job, number).with_suffix(".h5") for number in rounds]
    files += [study_path(job, task.item) for number in rounds for task in study_tasks(job, number)]
    sources = [Surfaces(job).key, *fitted, *designs, *tried, *(stored_key(path) for path in files)]
    return content_key("cycle table", {}, sources)


def _write_table(job: Job, item: str, part: Path) -> None:
    del item
    rows = []
    for number in _rounds(job):
        fit = load_lpv_fit(surfaces_file(job, number))
        design = load_tuned(controller_file(job, number).with_suffix(".h5"))
        rows += rows_of_round(number, fit, design, load_studies(job, number))
    write_csv(cycle_table(rows), part, [f"content_key: {_table_key(job)}"])


def _rounds(job: Job) -> range:
    return range(cycle_section(job.experiment).rounds + 1)


CYCLE = Stage(
    "cycle",
    "cycle",
    (cycle_can_run,),
    first_tasks,
    (
        partial(_next, study_tasks, 0),
        *(partial(_next, step, number) for number in range(1, MOST_ROUNDS + 1) for step in _STEPS),
        _table_tasks,
    ),
    in_run=_in_run,
)
"""``cycle/round<n>`` with recordings, fits, surfaces, controller and impacts of each round, and ``cycle/cycle.csv``."""
