"""Forms of job and task for other processes: without positions and reporter, with absolute paths."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from ruamel.yaml.comments import CommentedMap

from gbid.errors import NoSpaceError
from gbid.experiment.run.job import Job, Task
from gbid.experiment.run.outcome import Outcome
from gbid.experiment.run.perform import perform, standing
from gbid.yaml_file import YamlFile


def bare_job(job: Job) -> Job:
    """Return the job for worker processes: absolute paths, no positions in the YAML, no reporter."""
    experiment = job.experiment
    file = YamlFile(experiment.file.path.resolve(), {}, CommentedMap())
    there = replace(experiment, file=file, results=experiment.results.resolve())
    vars(there)["recordings"] = experiment.recordings  # searched once: the files of a folder may change
    return Job(there, job.overwrite, retry=job.retry)


def bare_task(task: Task) -> Task:
    """Return the task with an absolute path."""
    return replace(task, path=Path(task.path).resolve())


def attempt(job: Job, task: Task) -> Outcome | str:
    """Run a task in a worker and return its outcome.

    Returns
    -------
    Outcome or str
        Outcome, or the text of the error when the disk is full. A result that a worker completed just before it died
        counts as made.
    """
    if task.path.exists():
        there = standing(job, task)
        if there is not None and there.state == "kept":
            return replace(there, state="made")
    try:
        return perform(job, task)
    except NoSpaceError as error:
        return str(error)
