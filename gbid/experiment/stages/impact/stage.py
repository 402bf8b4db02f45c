"""Stage of the impacts (paper, Sec. 5.1): hammer on the rig in open and closed loop, ring-downs, force scaling."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from gbid.control.impact.impact_store import load_impacts, mode_rows, response_rows, save_impacts
from gbid.control.impact.study import ImpactStudy, study_impacts
from gbid.errors import GbidError
from gbid.experiment.experiment import Experiment
from gbid.experiment.keys import content_key
from gbid.experiment.run.inputs import load_checked
from gbid.experiment.run.job import Job, Task
from gbid.experiment.run.outcome import Made, Outcome
from gbid.experiment.run.stage import Stage, Work
from gbid.experiment.stages.impact.checks import impacts_can_be_made
from gbid.experiment.stages.impact.loop_program import loop_of, loop_settings
from gbid.experiment.stages.impact.plan import (
    ImpactRecording,
    LoopController,
    controller_at,
    expecting_model,
    hammer_of,
    impacts_section,
    planned_impacts,
    study_name,
)
from gbid.experiment.stages.rig.model import rig_model
from gbid.experiment.stages.rig.plan import as_settings, machine_at, record_options
from gbid.recording import Recording, save_recording
from gbid.rig import record
from gbid.tables.csv import write_csv
from gbid.tables.table import table_of_records

FOLDER = "impacts"
RECORDINGS = "impacts/recordings"


def recording_tasks(job: Job) -> Work:
    """Return the tasks of the recordings with impacts; a further loop without controller is a failed outcome.

    Raises
    ------
    UsageError
        When the model or the controller of the closed loop is missing.
    """
    if job.experiment.spec.impacts is None:
        return []
    idle = [
        Outcome("impact", loop, job.path(FOLDER, loop), "failed", why, cause="input")
        for loop, why in loops_without_controller(job.experiment).items()
    ]
    tasks = [
        Task(
            "impact",
            name,
            job.path(RECORDINGS, name),
            recording_key(job.experiment, planned),
            _write_recording,
            (name,),
        )
        for name, planned in _runnable(job.experiment).items()
    ]
    return [*idle, *tasks]


def _studies_of(job: Job, made: Sequence[Outcome]) -> list[Task]:
    return study_tasks(job) if made else []


def study_tasks(job: Job) -> list[Task]:
    """Return the tasks of the studies, one for each operating point and loop."""
    tasks = []
    for name, group in _studies(job.experiment).items():
        names = tuple(q.planned.name for q in group)
        key = study_key(job.experiment, group)
        tasks.append(Task("ringdown", name, job.path(FOLDER, name), key, _write_study, names, read=read_made_study))
    return tasks


def loops_without_controller(experiment: Experiment) -> dict[str, str]:
    """Return the further loops whose controller is missing or cannot be read, with the reason.

    Raises
    ------
    UsageError
        When the experiment has no section ``impacts``.
    """
    section, found = impacts_section(experiment), {}
    for loop in section.beside:
        try:
            for point in section.operating_points:
                controller_at(experiment, point, loop)
        except GbidError as error:
            found[loop] = str(error)
    return found


def made_impacts(outcomes: Sequence[Outcome]) -> dict[str, ImpactStudy]:
    """Return the existing studies by name."""
    return {o.item: load_impacts(o.path) for o in outcomes if o.stage == "ringdown" and o.state != "failed"}


def recording_key(experiment: Experiment, impact: ImpactRecording) -> str:
    """Return the content key of a recording with impacts."""
    section, rig = impacts_section(experiment), experiment.spec.rig
    assert rig is not None
    settings: dict[str, Any] = {
        **as_settings(record_options(experiment, impact.planned)),
        "experiment": {"hammer": asdict(hammer_of(section, impact.axis, rig.sample_time_s))},
        "machine": asdict(machine_at(experiment, impact.planned, rig_model(experiment))),
        "controller": _controller(experiment, impact).key if impact.loop != "open" else "",
        **(loop_settings(experiment) if impact.loop != "open" else {}),
    }
    return content_key("impact", settings)


def study_key(experiment: Experiment, group: list[ImpactRecording]) -> str:
    """Return the content key of a study."""
    section = impacts_section(experiment)
    settings = {
        "harmonics": section.harmonics,
        "lags": section.lags,
        "model": expecting_model(experiment)[1],
        "loop": group[0].loop,
    }
    return content_key("ringdown", settings, [recording_key(experiment, q) for q in group])


def _runnable(experiment: Experiment) -> dict[str, ImpactRecording]:
    idle = loops_without_controller(experiment)
    return {name: impact for name, impact in planned_impacts(experiment).items() if impact.loop not in idle}


def _studies(experiment: Experiment) -> dict[str, list[ImpactRecording]]:
    found: dict[str, list[ImpactRecording]] = {}
    for impact in _runnable(experiment).values():
        found.setdefault(study_name(impact.point, impact.loop), []).append(impact)
    return found


def _controller(experiment: Experiment, impact: ImpactRecording) -> LoopController:
    return controller_at(experiment, impact.point, impact.loop)


def _write_recording(job: Job, name: str, part: Path) -> None:
    experiment = job.experiment
    impact, section, rig = planned_impacts(experiment)[name], impacts_section(experiment), experiment.spec.rig
    assert rig is not None
    machine, options = (
        machine_at(experiment, impact.planned, rig_model(experiment)),
        record_options(experiment, impact.planned),
    )
    running = None if impact.loop == "open" else loop_of(experiment, _controller(experiment, impact), machine, options)
    hammer = hammer_of(section, impact.axis, rig.sample_time_s)
    save_recording(record(machine, hammer, **options, controller=running), part, overwrite=True)


def _write_study(job: Job, name: str, part: Path) -> Made:
    experiment, section = job.experiment, impacts_section(job.experiment)
    group = _studies(experiment)[name]
    recordings = [_made_recording(job, impact) for impact in group]
    controller = _controller(experiment, group[0]) if group[0].loop != "open" else None
    study = study_impacts(
        recordings,
        expecting_model(experiment)[0],
        None if controller is None else controller.continuous,
        None if controller is None else controller.sampled,
        harmonics=section.harmonics,
        lags=section.lags,
        loop=group[0].loop,
    )
    save_impacts(study, part, overwrite=True)
    return made_study(study)


def _made_recording(job: Job, impact: ImpactRecording) -> Recording:
    path = job.path(RECORDINGS, impact.planned.name)
    return load_checked(path, recording_key(job.experiment, impact), "gbid impact")


def made_study(study: ImpactStudy) -> Made:
    """Return the summary of a study."""
    text = "; ".join([study.ringdown.status, *study.ringdown.notes])
    # a loop may damp so well that nothing oscillates; this is a valid result
    return Made(
        text, study.ringdown.success or study.ringdown.aperiodic, min(v.along_percent for v in study.validations)
    )


def read_made_study(path: Path) -> Made:
    """Return the summary of an existing study."""
    return made_study(load_impacts(path))


def _csv_tasks(job: Job, made: Sequence[Outcome]) -> list[Task]:
    names = [o.item for o in made if o.stage == "ringdown" and o.state != "failed"]
    if not names:
        return []
    key = _csv_key(job, names)
    return [
        Task("impact table", ",".join([word, *names]), job.path(FOLDER, word, ".csv"), key, _write_csv)
        for word in ("impacts", "responses")
    ]


def _csv_key(job: Job, names: list[str]) -> str:
    studies = _studies(job.experiment)
    return content_key("impact csv", {"names": names}, [study_key(job.experiment, studies[name]) for name in names])


def _write_csv(job: Job, item: str, part: Path) -> None:
    word, *names = item.split(",")
    studies = [load_impacts(job.path(FOLDER, name)) for name in names]
    rows = [row for study in studies for row in (mode_rows(study) if word == "impacts" else response_rows(study))]
    write_csv(table_of_records(rows), part, [f"content_key: {_csv_key(job, names)}"])


IMPACT = Stage("impact", "impacts", (impacts_can_be_made,), recording_tasks, (_studies_of, _csv_tasks))
"""``impacts/<point>_<loop>.h5``, the recordings behind them, ``impacts.csv`` and ``responses.csv``."""
