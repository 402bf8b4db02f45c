"""Checks of the impacts section: rig, operating points inside the domain, and controller exist."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from gbid.control.impact.study import ImpactStudy, mode_rows, response_rows, study_impacts
from gbid.core.errors import GbidError
from gbid.core.hdf5 import load, save
from gbid.core.tables import table_of_records, write_csv
from gbid.experiment.controllers import (
    LOOPS,
    ImpactRecording,
    LoopController,
    controller_at,
    expecting_model,
    hammer_of,
    impacts_section,
    is_tuned,
    loop_controllers,
    loop_of,
    loop_settings,
    planned_impacts,
    study_name,
    tuned_design,
)
from gbid.experiment.experiment import Experiment
from gbid.experiment.fields import Found, Location, content_key
from gbid.experiment.machine import as_settings, machine_at, record_options, rig_model
from gbid.experiment.run import Job, Made, Outcome, Stage, Task, Work, load_checked
from gbid.experiment.schema import HammerTrain, ImpactPoint, ImpactsSection
from gbid.recording import Recording, save_recording
from gbid.rig import record

LONGEST_IMPACT = 0.25
"""Longest impact as a fraction of the time between impacts; the ring-down needs the remaining time."""


def impacts_can_be_made(experiment: Experiment) -> Found:
    """Yield problems of the rig, the operating points, the timing of impacts, and the controllers."""
    section = experiment.spec.impacts
    if section is None:
        return
    if experiment.spec.rig is None:
        yield (
            ("impacts",),
            "needs the section rig; add one (for recordings of your own use gbid.fit_ringdown)",
        )
        return
    yield from timing_problems(section, experiment.spec.rig.sample_time_s, ("impacts",))
    try:
        domain, name = rig_model(experiment).domain, rig_model(experiment).name
        for axis in section.axes:
            hammer_of(section, axis, experiment.spec.rig.sample_time_s)
    except GbidError:
        return  # the checks of the rig section report this
    if section.model == "lpv" and experiment.spec.lpv is None:
        yield ("impacts", "model"), "there is no section 'lpv'; add one, or name a model"
    elif section.model not in (None, "lpv"):
        try:
            expecting_model(experiment)
        except GbidError as error:
            yield ("impacts", "model"), str(error)
    inside = []
    for i, point in enumerate(section.operating_points):
        outside = [
            (key, value, low, high)
            for key in ("pressure_bar", "speed_rpm")
            for value, (low, high) in [(getattr(point, key), getattr(domain, key))]
            if not low <= value <= high
        ]
        for key, value, low, high in outside:
            yield (
                ("impacts", "operating_points", i, key),
                f"{value:g} lies outside the domain of {name}, {low:g} to {high:g}; choose a value inside",
            )
        if not outside:
            inside.append(point)
    yield from _controller_problems(experiment, section, inside)


def timing_problems(section: HammerTrain, sample_time: float, where: Location) -> Found:
    """Yield a problem when impacts are too long for the time between them, or too short to be measured."""
    if section.impact_s > LONGEST_IMPACT * section.spacing_s:
        yield (
            (*where, "spacing_s"),
            f"{section.spacing_s:g} s is too short for impacts of {section.impact_s:g} s; lengthen it",
        )
    elif section.impact_s < 4 * sample_time:
        yield (
            (*where, "impact_s"),
            f"{section.impact_s:g} s is less than 4 samples; the force cannot be measured: lengthen it",
        )


def _controller_problems(experiment: Experiment, section: ImpactsSection, points: list[ImpactPoint]) -> Found:
    """Yield a problem for each loop with a used name or without a controller."""
    taken = [loop for loop in section.beside if loop in LOOPS]
    for loop in taken:
        yield ("impacts", "beside", loop), f"the name {loop!r} is reserved; choose another"
    for loop, word in {"closed": section.controller, **section.beside}.items():
        if loop in taken:
            continue
        try:
            if is_tuned(word):
                tuned_design(experiment, word)
            elif loop in loop_controllers(section):
                for point in points:
                    controller_at(experiment, point, loop)
        except GbidError as error:
            yield ("impacts", "beside", loop) if loop in section.beside else ("impacts", "controller"), str(error)


# ---- Stage of the impacts (paper, Sec. 5.1): hammer on the rig in open and closed loop, ring-downs, force scaling.

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
    return {o.item: load(o.path, ImpactStudy) for o in outcomes if o.stage == "ringdown" and o.state != "failed"}


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
    save(study, part, overwrite=True)
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
    return made_study(load(path, ImpactStudy))


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
    studies = [load(job.path(FOLDER, name), ImpactStudy) for name in names]
    rows = [row for study in studies for row in (mode_rows(study) if word == "impacts" else response_rows(study))]
    write_csv(table_of_records(rows), part, [f"content_key: {_csv_key(job, names)}"])


IMPACT = Stage("impact", "impacts", (impacts_can_be_made,), recording_tasks, (_studies_of, _csv_tasks))
"""``impacts/<point>_<loop>.h5``, the recordings behind them, ``impacts.csv`` and ``responses.csv``."""
