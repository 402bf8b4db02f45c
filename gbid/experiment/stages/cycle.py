"""Identification-for-control cycle: rounds, measured damping in each round, and checks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gbid import control, lpv
from gbid.core.arrays import FloatArray, point_label
from gbid.core.errors import GbidError
from gbid.core.hdf5 import load
from gbid.core.names import file_stem
from gbid.core.tables import Column, Entry, Table, read_values, table_of_values, write_csv
from gbid.experiment.controllers import TUNED, controller_section, load_design, surfaces_item, tuned_design
from gbid.experiment.experiment import RIG_SIGNALS, Experiment, PlannedRecording
from gbid.experiment.fields import Found, InputError, Item, Result, needed, refusal
from gbid.experiment.machine import rig_model
from gbid.experiment.rig_schema import Place
from gbid.experiment.run import Job, Made, Outcome, Stage, Task, Work, cause_of
from gbid.experiment.schema import MOST_ROUNDS, ImpactsSection
from gbid.experiment.stages.fit import fit_tasks
from gbid.experiment.stages.impact import IMPACT, RECORDINGS, study_tasks, timing_problems
from gbid.experiment.stages.lpv import LPV, Surfaces
from gbid.experiment.stages.prefilter import PREFILTER
from gbid.experiment.stages.rig import RIG
from gbid.experiment.stages.tune import TUNE, design_tasks, read_designs
from gbid.lpv.model import CHARACTERISTICS
from gbid.structure import KEY_PARAMETERS

if TYPE_CHECKING:
    from gbid.control.assessment import TunedDesign

FOLDER = "cycle"
_LATER = ("lpv", "controller", "impacts", RECORDINGS)  # folders of the results that each round has for itself


def cycle_design(experiment: Experiment) -> str:
    """Return the name of the design that the cycle tunes.

    Raises
    ------
    UsageError
        When there is none, or several and the section names none.
    """
    name = needed(experiment.spec.cycle, "cycle").design
    return tuned_design(experiment, name or "")


def recording_points(experiment: Experiment) -> tuple[Place, ...]:
    """Return the operating points of the new recordings of a round."""
    section, rig = needed(experiment.spec.cycle, "cycle"), experiment.spec.rig
    if section.operating_points is not None:
        return section.operating_points
    points = rig.operating_points if rig is not None else ()
    return tuple(Place(pressure_bar=q.pressure_bar, speed_rpm=q.speed_rpm) for q in points)


def trial_points(experiment: Experiment) -> tuple[Place, ...]:
    """Return the operating points of the impacts of a round."""
    return needed(experiment.spec.cycle, "cycle").impacts.operating_points or recording_points(experiment)


@lru_cache(maxsize=2 * MOST_ROUNDS)
def round_experiment(experiment: Experiment, number: int) -> Experiment:
    """Return a round of the cycle as an experiment.

    A round has the recordings of the experiment and of all rounds so far, which its fits use as well. Its surfaces,
    controller and impacts lie in a folder of its own; round 0 has the surfaces and the controller of the experiment.
    """
    spec, name = experiment.spec, cycle_design(experiment)
    surfaces = needed(spec.lpv, "lpv")
    new = {name: planned for i in range(1, number + 1) for name, planned in round_recordings(experiment, i).items()}
    fit = spec.fits[surfaces.fit]
    if fit.recordings is not None:
        fit = fit.model_copy(update={"recordings": (*fit.recordings, *new)})
    trial = {**dict(needed(experiment.spec.cycle, "cycle").impacts), "operating_points": trial_points(experiment)}
    impacts = ImpactsSection.model_validate({**trial, "model": "lpv", "beside": {f"round{number}": "tuned"}})
    changed = {
        "fits": {**spec.fits, surfaces.fit: fit},
        "lpv": surfaces.model_copy(update={"direct": False}),
        "controller": {name: spec.controller[name]},
        "impacts": impacts.model_copy(update={"loops": ()}),
    }
    folders = {folder: f"{FOLDER}/round{number}/{folder}" for folder in (_LATER if number else _LATER[2:])}
    derived = replace(experiment, spec=spec.model_copy(update=changed), folders=folders)
    vars(derived)["recordings"] = {**experiment.recordings, **new}
    return derived


def round_recordings(experiment: Experiment, number: int) -> dict[str, PlannedRecording]:
    """Return the recordings of a round by name, such as ``round1_p4_n0_prbs1``."""
    before = f"{FOLDER}/round{number - 1}/" if number > 1 else ""
    controller = f"{before}{TUNED}/{file_stem(cycle_design(experiment))}.yaml"
    planned = {}
    for point in recording_points(experiment):
        for i in range(needed(experiment.spec.cycle, "cycle").recordings):
            name = f"round{number}_p{point.pressure_bar:g}_n{point.speed_rpm:g}_prbs{i + 1}"
            run = ("round",)
            planned[name] = PlannedRecording(
                name, True, point.model_dump(), RIG_SIGNALS, ("cycle",), run=run, controller=controller
            )
    return planned


def cycle_can_run(experiment: Experiment) -> Found:
    """Yield problems of the cycle: missing sections, and operating points without map or outside the domain."""
    section, spec = needed(experiment.spec.cycle, "cycle"), experiment.spec
    for other, why in (("rig", "runs on it"), ("lpv", "fits its surfaces again"), ("controller", "tunes it again")):
        if not getattr(spec, other):
            yield ("cycle",), f"there is no section {other!r}; add one, because the cycle {why}"
    if spec.rig is None or spec.lpv is None or not spec.controller:
        return
    yield from timing_problems(section.impacts, spec.rig.sample_time_s, ("cycle", "impacts"))
    try:
        name = cycle_design(experiment)
        if surfaces_item(experiment, controller_section(experiment, name)) != spec.lpv.fit:
            yield ("cycle", "design"), f"design {name!r} does not use the surfaces; write model: lpv, or choose another"
    except GbidError as error:
        yield ("cycle", "design"), str(error)
    at = [(q.pressure_bar, q.speed_rpm) for q in spec.rig.operating_points]
    if spec.prefilter is not None and spec.prefilter.method != "none":
        for i, q in enumerate(section.operating_points or ()):
            if (q.pressure_bar, q.speed_rpm) not in at:
                text = "is no operating point of the section rig, so it has no run-out map; choose one of those"
                yield ("cycle", "operating_points", i), text
    try:
        model = rig_model(experiment)
    except GbidError:
        return  # the checks of the rig section report this
    recorded, hit = recording_points(experiment), trial_points(experiment)
    for where, points in ((("cycle", "operating_points"), recorded), (("cycle", "impacts", "operating_points"), hit)):
        for q in points:
            point = (q.pressure_bar, q.speed_rpm)
            yield from refusal(where, partial(model.domain.check, point, f"model {model.name!r}"))


_INTERVAL = 1.96  # standard deviations of a 95 % interval
_STEP = 1e-3  # of the difference quotients, in standard deviations of a parameter
_MODES = ("frequency_1_hz", "frequency_2_hz", "damping_1", "damping_2")


@dataclass(frozen=True)
class CycleRow:
    """Result of one round at one operating point.

    Attributes
    ----------
    round : int
        The round; 0 is the design of the experiment.
    pressure_bar, speed_rpm : float
        Operating point.
    recordings : int
        Number of recordings behind the surfaces.
    model_frequency_1_hz, model_frequency_2_hz, model_damping_1, model_damping_2 : float
        Modes of the bearing without controller, from the surfaces; with ``_std`` their standard deviations.
    promised_damping : float
        Smallest damping that the design has over all operating points and plants of the search.
    expected_damping : float
        Smaller damping of the two modes that the surfaces give for the sampled loop at this point.
    frequency_1_hz, frequency_2_hz, damping_1, damping_2 : float
        Modes of the loop on the rig, measured by impacts; with ``_std`` their standard deviations.
    impacts : int
        Number of impacts.
    converged : bool
        Whether the fit to the ring-downs converged.
    """

    round: int
    pressure_bar: float
    speed_rpm: float
    recordings: int
    model_frequency_1_hz: float
    model_frequency_1_hz_std: float
    model_frequency_2_hz: float
    model_frequency_2_hz_std: float
    model_damping_1: float
    model_damping_1_std: float
    model_damping_2: float
    model_damping_2_std: float
    promised_damping: float
    expected_damping: float
    frequency_1_hz: float
    frequency_1_hz_std: float
    frequency_2_hz: float
    frequency_2_hz_std: float
    damping_1: float
    damping_1_std: float
    damping_2: float
    damping_2_std: float
    impacts: int
    converged: bool

    @property
    def reached(self) -> tuple[float, float]:
        """Smallest measured damping factor of the two modes, with its standard deviation."""
        first = not self.damping_2 < self.damping_1
        return (self.damping_1, self.damping_1_std) if first else (self.damping_2, self.damping_2_std)


def cycle_table(rows: Sequence[CycleRow]) -> Table:
    """Return the table of all rows, as in the CSV file."""
    notes = (
        "model_: modes of the bearing without controller, from the surfaces of the round; expected_damping: of the "
        "sampled loop, by the same surfaces; frequency and damping: of the loop on the rig, measured by impacts",
    )
    return table_of_values(CycleRow, rows, notes)


def rounds_table(rows: Sequence[CycleRow]) -> Table:
    """Return a short table of the rounds for display."""
    columns = [
        *(Column("round", format="d"), Column("where"), Column("recordings", format="d")),
        *(Column("std of frequencies", "Hz"), Column("std of dampings")),
        *(Column("promised", format=".3f"), Column("expected", format=".3f"), Column("reached, 95 %")),
    ]
    notes = (
        "std: of both modes of the bearing without controller, by the surfaces of the round; promised: smallest "
        "damping of the design over all points and plants; expected: of the sampled loop at this point, by the "
        "surfaces; reached: smaller damping of both modes of the loop on the rig, measured by impacts",
    )
    cells: list[list[Entry]] = []
    for row in rows:
        frequencies = f"{row.model_frequency_1_hz_std:.3f}, {row.model_frequency_2_hz_std:.3f}"
        dampings = f"{row.model_damping_1_std:.5f}, {row.model_damping_2_std:.5f}"
        damping, std = row.reached
        reached = f"{damping:.4f} ± {_INTERVAL * std:.4f}" if row.converged else "ring-downs not fitted"
        model = (row.recordings, frequencies, dampings, row.promised_damping, row.expected_damping)
        cells.append([row.round, point_label(row.pressure_bar, row.speed_rpm), *model, reached])
    return Table("Rounds of the cycle", columns, cells, notes)


def _row(number: int, fit: lpv.LPVFit, design: TunedDesign, study: control.ImpactStudy) -> CycleRow:
    pressure, speed = (float(study.conditions[key]) for key in ("pressure_bar", "speed_rpm"))
    ring, places = study.ringdown, [0, 2, 1, 3]  # a ring-down has frequency and damping of each mode in turn
    measured = np.column_stack([ring.frequency_hz, ring.damping]).ravel()[places]
    measured_std = np.column_stack([ring.frequency_std, ring.damping_std]).ravel()[places]
    return CycleRow(
        number,
        pressure,
        speed,
        len(fit.estimates.recordings),
        promised_damping=design.result.value,
        expected_damping=min(damping for _, damping in study.expected_sampled),
        impacts=ring.n_impacts,
        converged=ring.success,
        **_named("model_", *modes_of_surfaces(fit, pressure, speed)),
        **_named("", measured, measured_std),
    )


def _named(prefix: str, mean: FloatArray, std: FloatArray) -> dict[str, Any]:
    """Return modes and their standard deviations as named fields of a row."""
    pairs = zip(_MODES, mean.tolist(), std.tolist(), strict=True)
    return {f"{prefix}{name}{ending}": v for name, m, s in pairs for ending, v in (("", m), ("_std", s))}


def modes_of_surfaces(fit: lpv.LPVFit, pressure_bar: float, speed_rpm: float) -> tuple[FloatArray, FloatArray]:
    """Return both natural frequencies [Hz] and damping factors of surfaces at a point, with standard deviations.

    Parameters
    ----------
    fit : LPVFit
        Surfaces with their covariance.
    pressure_bar, speed_rpm : float
        Operating point.

    Returns
    -------
    mean : (4,) array
        Frequency 1, frequency 2, damping 1, damping 2.
    std : (4,) array
        Their standard deviations, to first order.
    """
    known = fit.model.key_parameters(pressure_bar, speed_rpm)
    values = np.array([float(known[key]) for key in KEY_PARAMETERS])
    covariance = fit.uncertainty_at(pressure_bar, speed_rpm)
    steps = _STEP * np.sqrt(np.diag(covariance))
    near = lpv.characteristics(np.vstack([values, values + np.diag(steps), values - np.diag(steps)]))
    columns = [CHARACTERISTICS.index(name) for name in ("omega_1", "omega_2", "zeta_1", "zeta_2")]
    mean, up, down = near[0, columns], near[1 : 1 + len(values), columns], near[1 + len(values) :, columns]
    moving = steps > 0
    slopes = (up - down)[moving] / (2 * steps[moving, None])
    spread = slopes.T @ covariance[np.ix_(moving, moving)] @ slopes
    return mean, np.sqrt(np.diag(spread))


TABLE = "cycle"
"""Name of the table of all rounds."""

Step = Callable[[Job, Sequence[Outcome]], Work]


def _of_new_recordings(work: Callable[[Job], Work], job: Job, _: Sequence[Outcome]) -> Work:
    """Return the tasks of a round that use recordings in closed loop."""
    new = {name for name, planned in job.experiment.recordings.items() if planned.controller}
    return [task for task in work(job) if isinstance(task, Task) and new & set(task.recordings)]


def _fits_of_surfaces(job: Job) -> Work:
    return fit_tasks(job, needed(job.experiment.spec.lpv, "lpv").fit)


def _steps_of(stage: Stage) -> tuple[Step, ...]:
    return (lambda job, _: stage.work(job), *stage.then)


_TRIALS = _steps_of(IMPACT)[:2]  # recordings and studies; the cycle has a table of its own
_STEPS: tuple[Step, ...] = (
    *(partial(_of_new_recordings, work) for work in (RIG.work, PREFILTER.work, _fits_of_surfaces)),
    *_steps_of(LPV),
    *_steps_of(TUNE),
    *_TRIALS,
)
"""Steps of a round, each on the results of those before."""


def round_job(job: Job, number: int) -> Job:
    """Return the job of a round of the cycle."""
    return replace(job, experiment=round_experiment(job.experiment, number))


def _next(step: Step, number: int, job: Job, outcomes: Sequence[Outcome]) -> Work:
    """Return the work of a step of a round; empty after a failure, because later steps need the failed result."""
    rounds = needed(job.experiment.spec.cycle, "cycle").rounds
    if number > rounds or any(outcome.state == "failed" for outcome in outcomes):
        return []
    done = {outcome.path for outcome in outcomes}
    return [_in_round(number, work) for work in step(round_job(job, number), outcomes) if work.path not in done]


def _in_round(number: int, work: Task | Outcome) -> Task | Outcome:
    """Return work of a round's experiment as work of the main experiment, with the round in its names."""
    item = replace(work.item, stage=f"cycle {work.item.stage}", round=f"round{number}")
    if isinstance(work, Outcome):
        return replace(work, item=item)
    return replace(work, item=item, write=partial(_write_in_round, number=number, write=work.write))


def _write_in_round(job: Job, part: Path, number: int, write: Callable[[Job, Path], Made | None]) -> Made | None:
    return write(round_job(job, number), part)


def first_tasks(job: Job) -> Work:
    """Return the tasks of the impacts with the initial design; a failed outcome if the design is missing."""
    path = job.path(FOLDER, TABLE, ending=".csv")
    try:
        name = cycle_design(job.experiment)
        missing = read_designs(job)[1].get(name)
        if missing is None:
            return _next(_TRIALS[0], 0, job, ())
        return [Outcome(Item("cycle impact", "round0"), path, "failed", f"design {name}: {missing}", cause="input")]
    except GbidError as error:
        return [Outcome(Item("cycle impact", "round0"), path, "failed", str(error), cause=cause_of(error))]


def _table_tasks(job: Job, outcomes: Sequence[Outcome]) -> list[Task]:
    return [] if any(outcome.state == "failed" for outcome in outcomes) else [table_task(job)]


def table_task(job: Job) -> Task:
    """Return the task of the table of all rounds.

    Raises
    ------
    DataError
        When surfaces or design of a round are missing.
    """
    sources: list[Result] = []
    for each in _rounds(job):
        designs = design_tasks(each)
        sources += [Surfaces(each).result(TABLE), *(task for task in designs if isinstance(task, Task))]
        sources += study_tasks(each)
        for failed in (work for work in designs if isinstance(work, Outcome)):
            raise InputError(failed.text)
    result = job.experiment.result(Item("cycle table", TABLE), FOLDER, {}, sources, ending=".csv")
    return Task.of(result, _write_table)


def made_rows(job: Job) -> list[CycleRow]:
    """Return the rows of the cycle from existing results; empty if some are missing.

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
    return read_values(task.path, CycleRow) if task.is_made else []


def _write_table(job: Job, part: Path) -> None:
    rows = []
    for number, each in enumerate(_rounds(job)):
        fit = load(each.path("lpv", needed(each.experiment.spec.lpv, "lpv").fit), lpv.LPVFit)
        design = load_design(each.path(TUNED, cycle_design(job.experiment)))
        rows += [_row(number, fit, design, load(task.path, control.ImpactStudy)) for task in study_tasks(each)]
    write_csv(cycle_table(rows), part)


def _rounds(job: Job) -> list[Job]:
    """Return the jobs of all rounds."""
    return [round_job(job, number) for number in range(needed(job.experiment.spec.cycle, "cycle").rounds + 1)]


CYCLE = Stage(
    "cycle",
    "cycle",
    (cycle_can_run,),
    first_tasks,
    (
        partial(_next, _TRIALS[1], 0),
        *(partial(_next, step, number) for number in range(1, MOST_ROUNDS + 1) for step in _STEPS),
        _table_tasks,
    ),
    in_run=lambda experiment: experiment.spec.cycle is None or experiment.spec.cycle.in_run,
)
"""``cycle/round<n>`` with surfaces, controller and impacts of each round, and ``cycle/cycle.csv``."""
