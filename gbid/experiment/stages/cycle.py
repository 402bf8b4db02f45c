"""Checks of the cycle section: rig, surfaces, design and operating points."""

from __future__ import annotations

import csv
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, fields
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from gbid.control.assess import TunedDesign
from gbid.control.impact.study import ImpactStudy, study_impacts
from gbid.core.arrays import FloatArray
from gbid.core.errors import GbidError, UsageError
from gbid.core.hdf5 import load, save
from gbid.core.tables import Table, plain_table, write_csv
from gbid.core.units import SIGNALS
from gbid.experiment.controllers import (
    TUNED,
    controller_section,
    hammer_of,
    loop_controller,
    loop_of,
    loop_settings,
    surfaces_item,
    tuned_design,
)
from gbid.experiment.experiment import RIG_SIGNALS, Experiment, PlannedRecording
from gbid.experiment.fields import Found, content_key, stored_key
from gbid.experiment.machine import as_settings, machine_at, record_options, rig_model
from gbid.experiment.recordings import refuse_bad_signals
from gbid.experiment.run import Job, Made, Outcome, Stage, Task, Work, cause_of, load_checked
from gbid.experiment.schema import MOST_ROUNDS, CycleSection, ImpactPoint
from gbid.experiment.stages.fit import fit_settings, fitted, read_fit_summary, save_made_fit
from gbid.experiment.stages.impact import made_study, read_made_study, timing_problems
from gbid.experiment.stages.lpv import Surfaces, read_status, write_model_beside, write_surfaces
from gbid.experiment.stages.prefilter import filtered_input, stationary_keys
from gbid.experiment.stages.tune import (
    designed,
    key_from_surfaces,
    plant_of_surfaces,
    read_design_summary,
    read_designs,
    save_design,
    write_controller_of,
)
from gbid.experiment.structures import fit_channels
from gbid.identify import TableEntry, load_fit
from gbid.lpv import CHARACTERISTICS, LPVFit, load_lpv_fit, load_model
from gbid.lpv.model import characteristics
from gbid.recording import Recording, save_recording
from gbid.rig import Hammer, Prbs, record
from gbid.structure import KEY_PARAMETERS

# ---- Plan of the cycle: folders of the rounds, recordings in closed loop, and the controller of each round.

FOLDER = "cycle"
DESIGN, SURFACES = "controller", "surfaces"
"""Names of the files of a round."""


@dataclass(frozen=True)
class RoundRecording:
    """Planned recording of a round.

    Attributes
    ----------
    planned : PlannedRecording
        Recording of the rig.
    point : ImpactPoint
        Operating point.
    number : int
        The round; 0 is the design of the experiment.
    axis : str
        Axis of the impacts; empty for a recording with moving references.
    """

    planned: PlannedRecording
    point: ImpactPoint
    number: int
    axis: str = ""


def cycle_section(experiment: Experiment) -> CycleSection:
    """Return the cycle section.

    Raises
    ------
    UsageError
        When the experiment has no such section.
    """
    if experiment.spec.cycle is None:
        raise UsageError(f"{experiment.file.path}: no section 'cycle'; add one")
    return experiment.spec.cycle


def cycle_design(experiment: Experiment) -> str:
    """Return the name of the design.

    Raises
    ------
    UsageError
        When there is none, or several and the section names none.
    """
    name = cycle_section(experiment).design
    return tuned_design(experiment, f"tuned:{name}" if name else "tuned")


def round_folder(number: int) -> str:
    """Return the folder of a round in the results."""
    return f"{FOLDER}/round{number}"


def controller_file(job: Job, number: int) -> Path:
    """Return the path of the controller of a round."""
    if number == 0:
        return job.path(TUNED, cycle_design(job.experiment), ".yaml")
    return job.path(round_folder(number), DESIGN, ".yaml")


def surfaces_file(job: Job, number: int) -> Path:
    """Return the path of the surfaces of a round."""
    if number == 0:
        assert job.experiment.spec.lpv is not None
        return job.path("lpv", job.experiment.spec.lpv.fit, ".yaml")
    return job.path(round_folder(number), SURFACES, ".yaml")


def excitation(experiment: Experiment) -> Prbs:
    """Return the references of the new recordings."""
    section, rig = cycle_section(experiment), experiment.spec.rig
    assert rig is not None
    return Prbs(
        section.duration_s or rig.duration_s,
        section.amplitude_m or rig.prbs.amplitude_m,
        section.hold_s or rig.prbs.hold_s,
    )


def recording_points(experiment: Experiment) -> tuple[ImpactPoint, ...]:
    """Return the operating points of the new recordings."""
    section, rig = cycle_section(experiment), experiment.spec.rig
    if section.operating_points is not None:
        return section.operating_points
    points = rig.operating_points if rig is not None else ()
    return tuple(ImpactPoint(pressure_bar=q.pressure_bar, speed_rpm=q.speed_rpm) for q in points)


def trial_points(experiment: Experiment) -> tuple[ImpactPoint, ...]:
    """Return the operating points of the impacts."""
    return cycle_section(experiment).impacts.operating_points or recording_points(experiment)


def round_recordings(experiment: Experiment, number: int) -> dict[str, RoundRecording]:
    """Return the recordings of a round in closed loop by name, e.g. ``round1_p4_n0_prbs1``."""
    found = {}
    for point in recording_points(experiment):
        for i in range(cycle_section(experiment).recordings):
            name = f"round{number}_{_label(point)}_prbs{i + 1}"
            planned = PlannedRecording(name, True, _conditions(point), RIG_SIGNALS, ("cycle",), run=("prbs",))
            found[name] = RoundRecording(planned, point, number)
    return found


def trial_recordings(experiment: Experiment, number: int) -> dict[str, RoundRecording]:
    """Return the recordings with impacts of a round by name, e.g. ``round1_p4_n0_x``."""
    found = {}
    for point in trial_points(experiment):
        for axis in cycle_section(experiment).impacts.axes:
            name = f"{trial_name(point, number)}_{axis}"
            signals = {**RIG_SIGNALS, "f": SIGNALS["f"].channels}
            planned = PlannedRecording(
                name, False, _conditions(point), signals, ("cycle", "impacts"), run=("impact", axis)
            )
            found[name] = RoundRecording(planned, point, number, axis)
    return found


def trial_name(point: ImpactPoint, number: int) -> str:
    """Return the name of the impact study of a round at an operating point, e.g. ``round1_p4_n0``."""
    return f"round{number}_{_label(point)}"


def round_of(item: str) -> int:
    """Return the round of an item, e.g. 1 of ``round1_p4_n0_x``."""
    return int(item.removeprefix("round").partition("_")[0])


def _label(point: ImpactPoint) -> str:
    return f"p{point.pressure_bar:g}_n{point.speed_rpm:g}"


def _conditions(point: ImpactPoint) -> dict[str, float]:
    return {"pressure_bar": point.pressure_bar, "speed_rpm": point.speed_rpm}


def cycle_can_run(experiment: Experiment) -> Found:
    """Yield problems of the cycle: what it needs, and operating points that have no map or lie outside."""
    section, spec = experiment.spec.cycle, experiment.spec
    if section is None:
        return
    for needed, why in (("rig", "runs on it"), ("lpv", "fits its surfaces again"), ("controller", "tunes it again")):
        if not getattr(spec, needed):
            yield ("cycle",), f"there is no section {needed!r}; add one, because the cycle {why}"
    if spec.rig is None or spec.lpv is None or not spec.controller:
        return
    yield from timing_problems(section.impacts, spec.rig.sample_time_s, ("cycle", "impacts"))
    try:
        name = cycle_design(experiment)
        if surfaces_item(experiment, controller_section(experiment, name)) != spec.lpv.fit:
            yield ("cycle", "design"), f"design {name!r} does not use the surfaces; write model: lpv, or choose another"
    except GbidError as error:
        yield ("cycle", "design"), str(error)
    yield from _point_problems(experiment)


def _point_problems(experiment: Experiment) -> Found:
    section, rig = experiment.spec.cycle, experiment.spec.rig
    assert section is not None
    assert rig is not None
    at = [(q.pressure_bar, q.speed_rpm) for q in rig.operating_points]
    if experiment.spec.prefilter is not None and experiment.spec.prefilter.method != "none":
        for i, point in enumerate(section.operating_points or ()):
            if (point.pressure_bar, point.speed_rpm) not in at:
                text = "is no operating point of the section rig, so it has no run-out map; choose one of those"
                yield ("cycle", "operating_points", i), text
    try:
        model = rig_model(experiment)
    except GbidError:
        return  # the checks of the rig section report this
    recorded, hit = recording_points(experiment), trial_points(experiment)
    for where, points in ((("cycle", "operating_points"), recorded), (("cycle", "impacts", "operating_points"), hit)):
        for q in points:
            try:
                model.domain.check((q.pressure_bar, q.speed_rpm), f"model {model.name!r}")
            except GbidError as error:
                yield where, str(error)


# ---- Recordings of a round in closed loop, and the fits to them.

RECORDINGS, FITS = "recordings", "fits"


def recording_tasks(job: Job, planned: dict[str, RoundRecording]) -> list[Task]:
    """Return the tasks that record with the controllers of the rounds; their files must exist."""
    return [
        Task("cycle recording", name, recording_path(job, one), recording_key(job, one), _write_recording, (name,))
        for name, one in planned.items()
    ]


def fit_tasks(job: Job, number: int) -> list[Task]:
    """Return the tasks of the fits to the recordings of a round."""
    return [
        Task("cycle fit", name, fit_path(job, one), fit_key(job, one), _write_fit, (name,), read_fit_summary)
        for name, one in round_recordings(job.experiment, number).items()
    ]


def recording_path(job: Job, one: RoundRecording) -> Path:
    """Return the path of a recording."""
    return job.path(f"{round_folder(one.number)}/{RECORDINGS}", one.planned.name)


def fit_path(job: Job, one: RoundRecording) -> Path:
    """Return the path of the fit to a recording."""
    return job.path(f"{round_folder(one.number)}/{FITS}", one.planned.name)


def load_closed(job: Job, one: RoundRecording) -> Recording:
    """Return a recording after a check that it was made from the present settings.

    Raises
    ------
    DataError
        When it is missing or was made from other settings.
    """
    return load_checked(recording_path(job, one), recording_key(job, one), "gbid cycle")


def recording_key(job: Job, one: RoundRecording) -> str:
    """Return the content key of a recording: rig, excitation, and the controller that runs."""
    experiment = job.experiment
    settings: dict[str, Any] = {
        **as_settings(record_options(experiment, one.planned)),
        "experiment": asdict(_experiment(job, one)),
        "machine": asdict(machine_at(experiment, one.planned, rig_model(experiment))),
        **loop_settings(experiment),
    }
    return content_key("cycle recording", settings, [stored_key(_running(job, one))])


def fit_key(job: Job, one: RoundRecording) -> str:
    """Return the content key of the fit to a recording."""
    experiment, name = job.experiment, _fit_name(job)
    section = experiment.spec.prefilter
    settings = {
        **fit_settings(experiment, name, [one.planned.name]),
        "prefilter": None if section is None else section.model_dump(),
    }
    return content_key(
        "cycle fit", settings, [recording_key(job, one), *stationary_keys(experiment, one.planned.point)]
    )


def closed_entries(job: Job, last: int) -> dict[str, TableEntry]:
    """Return the fits of the rounds 1 to `last` by their content keys."""
    found = {}
    for number in range(1, last + 1):
        for name, one in round_recordings(job.experiment, number).items():
            result = load_fit(fit_path(job, one))
            found[fit_key(job, one)] = TableEntry(_fit_name(job), name, (name,), one.planned.conditions, result, "")
    return found


def _write_recording(job: Job, name: str, part: Path) -> None:
    experiment, number = job.experiment, round_of(name)
    one = {**round_recordings(experiment, number), **trial_recordings(experiment, number)}[name]
    machine = machine_at(experiment, one.planned, rig_model(experiment))
    options = record_options(experiment, one.planned)
    running = loop_of(experiment, loop_controller(experiment, _running(job, one), one.point), machine, options)
    save_recording(record(machine, _experiment(job, one), **options, controller=running), part, overwrite=True)


def _write_fit(job: Job, name: str, part: Path) -> Made:
    one = round_recordings(job.experiment, round_of(name))[name]
    raw, (inputs, outputs) = load_closed(job, one), fit_channels(job.experiment, _fit_name(job))
    refuse_bad_signals(one.planned, raw, [*inputs, *outputs], driving=inputs)
    return save_made_fit(fitted(job, _fit_name(job), [filtered_input(job, one.planned, raw)]), part)


def _experiment(job: Job, one: RoundRecording) -> Hammer | Prbs:
    rig = job.experiment.spec.rig
    assert rig is not None
    if one.axis:
        return hammer_of(cycle_section(job.experiment).impacts, one.axis, rig.sample_time_s)
    return excitation(job.experiment)


def _running(job: Job, one: RoundRecording) -> Path:
    """Return the file of the controller that runs: of impacts that of their round, else that of the round before."""
    return controller_file(job, one.number if one.axis else one.number - 1)


def _fit_name(job: Job) -> str:
    assert job.experiment.spec.lpv is not None
    return job.experiment.spec.lpv.fit


# ---- Surfaces and controller of a round, from all recordings so far.


def surfaces_task(job: Job, number: int) -> Task:
    """Return the task of the surfaces of a round; its fits must exist."""
    path = job.path(round_folder(number), SURFACES)
    return Task("cycle surfaces", f"round{number}", path, _surfaces(job, number).key, _write_surfaces)


def model_task(job: Job, number: int) -> Task:
    """Return the task of the model file of these surfaces, which is written after them."""
    path = job.path(round_folder(number), SURFACES)
    return Task(
        "cycle model", f"round{number}", path.with_suffix(".yaml"), stored_key(path), _write_model, (), read_status
    )


def design_task(job: Job, number: int) -> Task:
    """Return the task of the design of a round; its surfaces must exist."""
    section = controller_section(job.experiment, cycle_design(job.experiment))
    key = key_from_surfaces(job.experiment, section, surfaces_file(job, number))
    path = job.path(round_folder(number), DESIGN)
    return Task("cycle design", f"round{number}", path, key, _write_design, (), read_design_summary)


def controller_task(job: Job, number: int) -> Task:
    """Return the task of the controller file of a round; its design must exist."""
    path = job.path(round_folder(number), DESIGN)
    return Task("cycle controller", f"round{number}", path.with_suffix(".yaml"), stored_key(path), _write_controller)


def _surfaces(job: Job, number: int) -> Surfaces:
    return Surfaces(job, closed_entries(job, number))


def _write_surfaces(job: Job, item: str, part: Path) -> Made:
    assert job.experiment.spec.lpv is not None
    surfaces = _surfaces(job, round_of(item))
    return write_surfaces(surfaces.make(job.experiment.spec.lpv.fit), part, surfaces.key)


def _write_model(job: Job, item: str, part: Path) -> Made:
    return write_model_beside(job.path(round_folder(round_of(item)), SURFACES), part)


def _write_design(job: Job, item: str, part: Path) -> Made:
    name = cycle_design(job.experiment)
    section = controller_section(job.experiment, name)
    fit = load_lpv_fit(surfaces_file(job, round_of(item)))
    return save_design(designed(job, name, *plant_of_surfaces(section, fit)), part)


def _write_controller(job: Job, item: str, part: Path) -> None:
    number = round_of(item)
    model = load_lpv_fit(surfaces_file(job, number)).model
    write_controller_of(job, cycle_design(job.experiment), job.path(round_folder(number), DESIGN), model, part)


# ---- Rows of the cycle: certainty of the model and damping of the loop, for each round and operating point.

_STEP = 1e-3  # of the difference quotients, in standard deviations of a parameter
_MODES = ("frequency_1_hz", "frequency_2_hz", "damping_1", "damping_2")
_READ: dict[str, Callable[[str], Any]] = {"int": int, "float": float, "bool": lambda text: text == "true"}


@dataclass(frozen=True)
class CycleRow:
    """One round at one operating point.

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
        """Smaller measured damping factor, and its standard deviation."""
        first = not self.damping_2 < self.damping_1
        return (self.damping_1, self.damping_1_std) if first else (self.damping_2, self.damping_2_std)


def rows_of_round(number: int, fit: LPVFit, design: TunedDesign, studies: Sequence[ImpactStudy]) -> list[CycleRow]:
    """Return the rows of a round, one for each impact study."""
    return [_row(number, fit, design, study) for study in studies]


def cycle_table(rows: Sequence[CycleRow]) -> Table:
    """Return the table of the rows, as in its CSV file."""
    notes = (
        "model_: modes of the bearing without controller, from the surfaces of the round; expected_damping: of the "
        "sampled loop, by the same surfaces; frequency and damping: of the loop on the rig, measured by impacts",
    )
    names = [field.name for field in fields(CycleRow)]
    return plain_table(names, [list(asdict(row).values()) for row in rows], notes)


def read_cycle(path: Path) -> list[CycleRow]:
    """Return the rows in the CSV file of a cycle."""
    with path.open(encoding="utf-8", newline="") as handle:
        table = list(csv.DictReader(line for line in handle if not line.startswith("#")))
    kinds = {field.name: _READ[str(field.type)] for field in fields(CycleRow)}
    return [CycleRow(**{name: kind(row[name]) for name, kind in kinds.items()}) for row in table]


def _row(number: int, fit: LPVFit, design: TunedDesign, study: ImpactStudy) -> CycleRow:
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
    """Return modes and their standard deviations as fields of a row."""
    pairs = zip(_MODES, mean.tolist(), std.tolist(), strict=True)
    return {f"{prefix}{name}{ending}": v for name, m, s in pairs for ending, v in (("", m), ("_std", s))}


def modes_of_surfaces(fit: LPVFit, pressure_bar: float, speed_rpm: float) -> tuple[FloatArray, FloatArray]:
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
    near = characteristics(np.vstack([values, values + np.diag(steps), values - np.diag(steps)]))
    columns = [CHARACTERISTICS.index(name) for name in ("omega_1", "omega_2", "zeta_1", "zeta_2")]
    mean, up, down = near[0, columns], near[1 : 1 + len(values), columns], near[1 + len(values) :, columns]
    moving = steps > 0
    slopes = (up - down)[moving] / (2 * steps[moving, None])
    spread = slopes.T @ covariance[np.ix_(moving, moving)] @ slopes
    return mean, np.sqrt(np.diag(spread))


# ---- Trial of a round: impacts on the rig in closed loop, and the damping that they show.

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
    return [load(study_path(job, name), ImpactStudy) for name in _groups(job, number)]


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
    save(study, part, overwrite=True)
    return made_study(study)


# ---- Stage of the identification-for-control cycle: record in closed loop, fit and tune again, and try it by impacts.

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
        design = load(controller_file(job, number).with_suffix(".h5"), TunedDesign)
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
