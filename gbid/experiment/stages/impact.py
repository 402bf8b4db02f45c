"""Stage of the impacts: checks, recordings, ring-down studies and tables; checks of the control chain."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path

from gbid import control, lpv
from gbid.core.errors import GbidError, UsageError
from gbid.core.hdf5 import load, save
from gbid.core.tables import table_of_records, write_csv
from gbid.core.units import SIGNALS
from gbid.experiment.controllers import (
    LOOPS,
    chain_options,
    controller_at,
    controller_key,
    loop_of,
    loop_settings,
    model_source,
    tuned_design,
    with_actuators,
)
from gbid.experiment.experiment import RIG_SIGNALS, Experiment, PlannedRecording
from gbid.experiment.fields import Found, Item, Location, Result, file_digest, needed, refusal
from gbid.experiment.machine import hammer_of, outside_domain, rig_model, rig_run
from gbid.experiment.rig_schema import ControllerName, Place
from gbid.experiment.run import Job, Made, Outcome, Stage, Task, Work, no_tasks
from gbid.experiment.schema import HammerTrain, ImpactsSection
from gbid.recording.recording import Recording, save_recording

LONGEST_IMPACT = 0.25
"""Longest impact as a fraction of the time between impacts; the ring-down needs the remaining time."""


def impacts_can_be_made(experiment: Experiment) -> Found:
    """Yield problems of the rig, operating points, impact timing and controllers."""
    section, rig = needed(experiment.spec.impacts, "impacts"), experiment.spec.rig
    if rig is None:
        yield ("impacts",), "needs the section rig; add one (for recordings of your own use gbid.fit_ringdown)"
        return
    yield from timing_problems(section, rig.sample_time_s, ("impacts",))
    try:
        domain, name = rig_model(experiment).domain, rig_model(experiment).name
        for axis in section.axes:
            hammer_of(section, axis, rig.sample_time_s)
    except GbidError:
        return  # the checks of the rig section report this
    if section.model == "lpv" and experiment.spec.lpv is None:
        yield ("impacts", "model"), "there is no section 'lpv'; add one, or name a model"
    elif section.model not in (None, "lpv"):
        yield from refusal(("impacts", "model"), partial(expecting_model, experiment))
    inside = []
    for i, point in enumerate(section.operating_points):
        outside = list(outside_domain(domain, name, point, ("impacts", "operating_points", i)))
        yield from outside
        inside += [] if outside else [point]
    for loop, named in {"closed": section.controller, **section.beside}.items():
        where: Location = ("impacts", "beside", loop) if loop in section.beside else ("impacts", "controller")
        if loop in section.beside and loop in LOOPS:
            yield where, f"the name {loop!r} is reserved; choose another"
        elif named.kind == "tuned":
            yield from refusal(where, partial(tuned_design, experiment, named.name))
        elif loop in loop_controllers(section):
            for point in inside:
                yield from refusal(where, partial(controller_at, experiment, point, loop))


def timing_problems(section: HammerTrain, sample_time: float, where: Location) -> Found:
    """Yield a problem for impacts that are too long for their spacing or too short for the sample time."""
    if section.impact_s > LONGEST_IMPACT * section.spacing_s:
        text = f"{section.spacing_s:g} s is too short for impacts of {section.impact_s:g} s; lengthen it"
        yield (*where, "spacing_s"), text
    elif section.impact_s < 4 * sample_time:
        text = f"{section.impact_s:g} s is less than 4 samples; the force cannot be measured: lengthen it"
        yield (*where, "impact_s"), text


@dataclass(frozen=True)
class ImpactRecording:
    """Planned recording with impacts.

    Attributes
    ----------
    planned : PlannedRecording
        Recording of the rig.
    point : Place
        Operating point.
    loop : str
        Name of the loop: ``"open"``, ``"closed"`` or that of a further loop.
    """

    planned: PlannedRecording
    point: Place
    loop: str

    @property
    def study(self) -> str:
        """Name of the study of operating point and loop, such as ``p6_n0_open``."""
        return self.planned.name.rpartition("_")[0]


def loop_controllers(section: ImpactsSection) -> dict[str, ControllerName | None]:
    """Return the controller of each loop in order; None for the open loop."""
    return {loop: section.controller if loop == "closed" else None for loop in section.loops} | section.beside


def planned_impacts(experiment: Experiment) -> dict[str, ImpactRecording]:
    """Return the recordings with impacts by name, such as ``p6_n0_open_x``."""
    section = needed(experiment.spec.impacts, "impacts")
    signals = {**RIG_SIGNALS, "f": SIGNALS["f"].channels}
    impacts = {}
    for i, point in enumerate(section.operating_points):
        place = ("impacts", "operating_points", i)
        for loop, axis in product(loop_controllers(section), section.axes):
            name = f"p{point.pressure_bar:g}_n{point.speed_rpm:g}_{loop}_{axis}"
            planned = PlannedRecording(name, False, point.model_dump(), signals, place, run=("impact", axis))
            impacts[name] = ImpactRecording(planned, point, loop)
    return impacts


def expecting_model(experiment: Experiment) -> tuple[lpv.LPVModel, str]:
    """Return the model that predicts the modes, and its identity for content keys.

    Raises
    ------
    UsageError
        When the model is missing or has no actuators.
    """
    section = needed(experiment.spec.impacts, "impacts")
    if section.model is None:
        model = rig_model(experiment)
        return with_actuators(model), f"rig {model.name}"
    source = model_source(experiment, section.model)
    if section.model == "lpv":
        source = experiment.path("lpv", needed(experiment.spec.lpv, "lpv").fit, ending=".yaml")
        if not source.is_file():
            raise UsageError(f"{source}: file is missing; `gbid lpv` makes it")
    key = file_digest(source) if isinstance(source, Path) else source
    return with_actuators(lpv.load_model(source)), key


FOLDER = "impacts"
RECORDINGS = "impacts/recordings"


def recording_tasks(job: Job) -> Work:
    """Return the tasks of the recordings with impacts; a loop with a missing controller is a failed outcome.

    Raises
    ------
    UsageError
        When the model or the controller of the closed loop is missing.
    """
    experiment = job.experiment
    idle = loops_without_controller(experiment)
    return [
        *(
            Outcome(Item("impact", loop), job.path(FOLDER, loop), "failed", why, cause="input")
            for loop, why in idle.items()
        ),
        *(
            Task.of(recording_result(experiment, impact), partial(_write_recording, name=name), [name])
            for name, impact in planned_impacts(experiment).items()
            if impact.loop not in idle
        ),
    ]


def study_tasks(job: Job, _: Sequence[Outcome] = ()) -> list[Task]:
    """Return the tasks of the studies, one for each operating point and loop."""
    tasks = []
    section = needed(job.experiment.spec.impacts, "impacts")
    for name, group in _studies(job.experiment).items():
        model, loop = expecting_model(job.experiment)[1], group[0].loop
        settings = {"harmonics": section.harmonics, "lags": section.lags, "model": model, "loop": loop}
        sources = [recording_result(job.experiment, impact) for impact in group]
        result = job.experiment.result(Item("ringdown", name), FOLDER, settings, sources)
        names = [impact.planned.name for impact in group]
        tasks.append(Task.of(result, partial(_write_study, name=name), names, _read_study))
    return tasks


def loops_without_controller(experiment: Experiment) -> dict[str, str]:
    """Return the loops with a missing or unreadable controller, with the reason.

    Raises
    ------
    UsageError
        When the experiment has no section ``impacts``.
    """
    section, idle = needed(experiment.spec.impacts, "impacts"), {}
    for loop in section.beside:
        try:
            for point in section.operating_points:
                controller_at(experiment, point, loop)
        except GbidError as error:
            idle[loop] = str(error)
    return idle


def recording_result(experiment: Experiment, impact: ImpactRecording) -> Result:
    """Return the result file of a recording with impacts."""
    planned, settings = impact.planned, rig_run(experiment, impact.planned).settings()
    if impact.loop != "open":
        settings |= {"controller": controller_key(experiment, impact.loop), **loop_settings(experiment)}
    return experiment.result(Item("impact", planned.name), RECORDINGS, settings)


def _studies(experiment: Experiment) -> dict[str, list[ImpactRecording]]:
    """Return the recordings of each study."""
    idle, studies = loops_without_controller(experiment), dict[str, list[ImpactRecording]]()
    for impact in planned_impacts(experiment).values():
        if impact.loop not in idle:
            studies.setdefault(impact.study, []).append(impact)
    return studies


def _write_recording(job: Job, part: Path, name: str) -> None:
    impact = planned_impacts(job.experiment)[name]
    run, running = rig_run(job.experiment, impact.planned), None
    if impact.loop != "open":
        running = loop_of(job.experiment, controller_at(job.experiment, impact.point, impact.loop), run)
    save_recording(run.record(running), part, overwrite=True)


def _write_study(job: Job, part: Path, name: str) -> Made:
    experiment, section = job.experiment, needed(job.experiment.spec.impacts, "impacts")
    group = _studies(experiment)[name]
    point, loop = group[0].point, group[0].loop
    controller = controller_at(experiment, point, loop) if loop != "open" else None
    laws = (None, None) if controller is None else (controller.continuous, controller.sampled)
    study = control.study_impacts(
        [load(recording_result(experiment, impact).require(), Recording) for impact in group],
        expecting_model(experiment)[0],
        *laws,
        harmonics=section.harmonics,
        lags=section.lags,
        loop=loop,
    )
    save(study, part, overwrite=True)
    return _made_study(study)


def _made_study(study: control.ImpactStudy) -> Made:
    text = "; ".join([study.ringdown.status, *study.ringdown.notes])
    # a loop may damp so well that nothing oscillates; this is a valid result
    return Made(
        text, study.ringdown.success or study.ringdown.aperiodic, min(v.along_percent for v in study.validations)
    )


def _read_study(path: Path) -> Made:
    return _made_study(load(path, control.ImpactStudy))


_TABLES = ("impacts", "responses")


def _csv_tasks(job: Job, outcomes: Sequence[Outcome]) -> list[Task]:
    """Return the tasks of the tables of all studies."""
    names = [o.item.section for o in outcomes if o.item.stage == "ringdown" and o.state != "failed"]
    if not names:
        return []
    studies = [task for task in study_tasks(job) if task.item.section in names]
    return [
        Task.of(
            job.experiment.result(Item("impact table", table), FOLDER, {"studies": names}, studies, ending=".csv"),
            partial(_write_csv, table=table, studies=names),
        )
        for table in _TABLES
    ]


def _write_csv(job: Job, part: Path, table: str, studies: Sequence[str]) -> None:
    from gbid.control.impact.study import impact_mode_rows, response_rows

    rows_of = impact_mode_rows if table == "impacts" else response_rows
    rows = [row for name in studies for row in rows_of(load(job.path(FOLDER, name), control.ImpactStudy))]
    write_csv(table_of_records(rows), part)


IMPACT = Stage("impact", "impacts", (impacts_can_be_made,), recording_tasks, (study_tasks, _csv_tasks))
"""``impacts/<point>_<loop>.h5``, the recordings behind them, ``impacts.csv`` and ``responses.csv``."""


# ---- Control chain; `gbid export --to c` writes it, and the rig runs it (``rig: controller: compiled``).


def chain_can_run(experiment: Experiment) -> Found:
    """Yield a problem if values of the section target do not fit each other."""
    yield from refusal(("target",), partial(chain_options, experiment))


TARGET = Stage("target", "target", (chain_can_run,), no_tasks)
