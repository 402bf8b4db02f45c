"""Trial of a round: impacts on the rig in closed loop, and the damping that they show."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from gbid.control.impact.impact_store import load_impacts, save_impacts
from gbid.control.impact.study import ImpactStudy, study_impacts
from gbid.experiment.keys import content_key, stored_key
from gbid.experiment.run.job import Job, Task
from gbid.experiment.run.outcome import Made
from gbid.experiment.stages.cycle.closed_recordings import load_closed, recording_key
from gbid.experiment.stages.cycle.plan import (
    RoundRecording,
    controller_file,
    cycle_section,
    round_folder,
    round_of,
    surfaces_file,
    trial_name,
    trial_recordings,
)
from gbid.experiment.stages.impact.plan import loop_controller
from gbid.experiment.stages.impact.stage import made_study, read_made_study
from gbid.lpv import load_model

_TRIALS = "impacts"


def study_tasks(job: Job, number: int) -> list[Task]:
    """Return the tasks of the impact studies of a round; its recordings must exist."""
    return [
        Task(
            "cycle ringdown",
            name,
            study_path(job, name),
            _key(job, group),
            _write_study,
            tuple(one.planned.name for one in group),
            read_made_study,
        )
        for name, group in _groups(job, number).items()
    ]


def study_path(job: Job, name: str) -> Path:
    """Return the path of an impact study."""
    return job.path(f"{round_folder(round_of(name))}/{_TRIALS}", name)


def load_studies(job: Job, number: int) -> list[ImpactStudy]:
    """Return the impact studies of a round, in the order of the operating points."""
    return [load_impacts(study_path(job, name)) for name in _groups(job, number)]


def _groups(job: Job, number: int) -> dict[str, list[RoundRecording]]:
    found: dict[str, list[RoundRecording]] = {}
    for one in trial_recordings(job.experiment, number).values():
        found.setdefault(trial_name(one.point, number), []).append(one)
    return found


def _key(job: Job, group: Sequence[RoundRecording]) -> str:
    section, number = cycle_section(job.experiment).impacts, group[0].number
    settings = {"harmonics": section.harmonics, "lags": section.lags, "round": number}
    sources = [stored_key(surfaces_file(job, number)), *(recording_key(job, one) for one in group)]
    return content_key("cycle ringdown", settings, sources)


def _write_study(job: Job, name: str, part: Path) -> Made:
    number = round_of(name)
    group, section = _groups(job, number)[name], cycle_section(job.experiment).impacts
    controller = loop_controller(job.experiment, controller_file(job, number), group[0].point)
    study = study_impacts(
        [load_closed(job, one) for one in group],
        load_model(surfaces_file(job, number)),
        controller.continuous,
        controller.sampled,
        harmonics=section.harmonics,
        lags=section.lags,
        loop=f"round {number}",
    )
    save_impacts(study, part, overwrite=True)
    return made_study(study)
