"""Stage of the surfaces over pressure and speed: checks, two-step and direct fits, files."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path

import numpy as np

from gbid import lpv, validate
from gbid.core import hdf5
from gbid.core.errors import GbidError, UsageError
from gbid.core.files import scratch_folder
from gbid.experiment.experiment import Experiment
from gbid.experiment.fields import Found, InputError, Item, Location, Result, needed, refusal, stored_key
from gbid.experiment.machine import machine_data
from gbid.experiment.run import Job, Made, Outcome, Stage, Task, Work, cause_of
from gbid.experiment.schema import LpvSection
from gbid.experiment.stages.fit import a_fit_is_named, fit_arguments, fit_entries, fit_result
from gbid.experiment.stages.prefilter import load_fit_input
from gbid.experiment.structures import make_structure, structure_or_none
from gbid.identify.table import TableEntry, tabulate
from gbid.lpv.estimates import check_points, chosen_exponents
from gbid.lpv.model import ACTUATOR_PARAMETERS
from gbid.lpv.model_file import write_model
from gbid.structure import KEY_PARAMETERS, ScheduledStructure
from gbid.structure.built_in import pade_order_of
from gbid.structure.kinds import kind_of
from gbid.structure.scheduling import SCHEDULING


def surfaces_can_be_drawn(experiment: Experiment) -> Found:
    """Yield problems of the lpv section: fit, key parameters, actuators, and operating points for the order."""
    section = needed(experiment.spec.lpv, "lpv")
    where: Location = ("lpv", "fit")
    structure = structure_or_none(experiment, section.fit) if section.fit in experiment.spec.fits else None
    if structure and (scheduled := kind_of(structure).scheduled):
        yield from _of_scheduled(experiment, section, scheduled)
        return
    yield from a_fit_is_named(experiment, where, section.fit, KEY_PARAMETERS, "name a fit of rotor_bearing or plant")
    if section.fit not in experiment.spec.fits:
        return
    yield from refusal(("lpv", "actuators"), partial(lpv_actuators, experiment, section))
    if section.robust and section.weighting == "fits":
        yield ("lpv", "robust"), "needs weighting: scatter or ordinary"
    scheduling, points = section.scheduling, []
    if section.direct and scheduling != SCHEDULING:
        yield ("lpv", "direct"), "is for surfaces over pressure_bar and speed_rpm; leave it out"
    for planned in experiment.fit_recordings(section.fit):
        if not set(scheduling) <= set(planned.conditions):
            yield where, f"recording {planned.name!r} has no {' and '.join(scheduling)}; surfaces need both"
            return
        points.append([planned.conditions[name] for name in scheduling])
    if points and section.order != "auto":
        order = section.order
        yield from refusal(
            ("lpv", "order"), lambda: check_points(np.array(points), chosen_exponents(order, scheduling), scheduling)
        )


def surfaces_domain(experiment: Experiment) -> lpv.Domain | None:
    """Return the range of the scheduling variables over the recordings; None where a recording lacks one."""
    section = needed(experiment.spec.lpv, "lpv")
    recordings = experiment.fit_recordings(section.fit) if section.fit in experiment.spec.fits else ()
    rows = [[q.conditions.get(name, np.nan) for name in section.scheduling] for q in recordings]
    if not rows or np.isnan(rows).any():
        return None
    bounds = zip(np.min(rows, axis=0).tolist(), np.max(rows, axis=0).tolist(), strict=True)
    return lpv.Domain(*bounds, variables=section.scheduling)


def _of_scheduled(experiment: Experiment, section: LpvSection, structure: ScheduledStructure) -> Found:
    """Yield problems of the lpv section for a scheduled structure, whose fit already gives surfaces."""
    if not experiment.spec.fits[section.fit].together:
        text = f"{structure.name} has one model for all recordings; write together: true"
        yield ("fits", section.fit, "together"), text
    if section.direct:
        yield ("lpv", "direct"), f"{structure.name} gives the surfaces straight from the recordings already; remove it"
    yield from refusal(("lpv", "actuators"), partial(lpv_actuators, experiment, section))


def lpv_actuators(experiment: Experiment, section: LpvSection) -> dict[str, float] | None:
    """Return the actuator parameters for the surfaces; None if the nominal stage will choose them.

    Raises
    ------
    UsageError
        When the nominal actuators are wanted without a section nominal, or the model is missing or has no actuators.
    """
    wanted = section.actuators
    if wanted is None:
        return {}
    if wanted == "nominal":
        if experiment.spec.nominal is None:
            raise UsageError("there is no section 'nominal'; add one, or name a model or its file")
        return None
    beside = experiment.folder / wanted
    try:
        actuators = lpv.load_model(beside if beside.suffix in (".yaml", ".yml") else wanted).actuators
    except UsageError as error:
        raise UsageError(f"expected the word nominal, a model name or a model file; {error}") from None
    if not actuators:
        raise UsageError(f"model {wanted!r} has no actuators; name another, or write nominal")
    return dict(actuators)


FOLDER = "lpv"
DIRECT = "_direct"
"""Suffix of the name of the direct LPV fit."""
UNCERTAINTY = "{} uncertainty"
"""How an item is written whose file is the uncertainty of surfaces, not the model."""


class Surfaces:
    """Surfaces of one job, each computed at its first use.

    Parameters
    ----------
    job : Job
        The job.

    Raises
    ------
    UsageError
        When the experiment has no section ``lpv``.
    """

    def __init__(self, job: Job) -> None:
        self._job = job
        self._section = needed(job.experiment.spec.lpv, "lpv")

    def result(self, item: str) -> Result:
        """Return the result file of surfaces; its key depends on section, existing fits and actuators."""
        experiment, fit = self._job.experiment, self._section.fit
        models = [entry.model for entry in self._entries if entry.result is not None]
        dumped = self._section.model_dump()
        if self._section.scheduling == SCHEDULING:  # the key of files of earlier versions
            del dumped["scheduling"]
        settings = {**dumped, "models": models, "found_actuators": self._actuators}
        known = machine_data(experiment)
        settings |= {"machine": known} if known != lpv.MachineData() else {}
        sources = [fit_result(experiment, fit, model) for model in models]
        return experiment.result(Item("lpv", item, form=UNCERTAINTY), FOLDER, settings, sources)

    def make(self, item: str) -> lpv.LPVFit:
        """Return the surfaces of one item: from the fit, or from its direct LPV fit."""
        fit = self._two_step if item == self._section.fit else self._direct()
        return replace(fit, model=replace(fit.model, machine=machine_data(self._job.experiment)))

    @cached_property
    def _entries(self) -> list[TableEntry]:
        return fit_entries(self._job, self._section.fit)

    @cached_property
    def _two_step(self) -> lpv.LPVFit:
        """Return surfaces fitted to the estimates of the fits; for a scheduled structure the surfaces of its fit."""
        section, spec = self._section, self._job.experiment.spec
        results = [entry.result for entry in self._entries if entry.result is not None]
        if not results:
            raise InputError(f"fit {section.fit!r} has no results; run `gbid fit` or `gbid run` first")
        source = f"experiment {spec.name}, fit {section.fit}"
        structure = make_structure(self._job.experiment, section.fit)
        if kind_of(structure).scheduled:
            actuators = self._actuators or None
            return lpv.lpv_of(results[0], actuators=actuators, name=spec.name, title=spec.title, source=source)
        over = section.scheduling
        points = [[entry.conditions.get(name, np.nan) for name in over] for entry in self._entries]
        return lpv.fit_lpv(
            tabulate(self._entries),
            None if over == SCHEDULING else points,
            scheduling=over,
            weighting=section.weighting,
            order=section.order,
            robust=section.robust,
            actuators=self._actuators,
            pade_order=pade_order_of(structure),
            name=spec.name,
            title=spec.title,
            source=source,
        )

    def _direct(self) -> lpv.LPVFit:
        """Return the surfaces estimated directly from the recordings."""
        experiment, name = self._job.experiment, self._section.fit
        spec = experiment.spec.fits[name]
        recordings = [load_fit_input(self._job, planned) for planned in experiment.fit_recordings(name)]
        hold = fit_arguments(experiment, name, recordings)["intersample"]
        structure = kind_of(make_structure(experiment, name)).linear
        if structure is None:
            text = "surfaces straight from the recordings are for linear structures with constant parameters"
            raise UsageError(f"fit {name!r}: {text}")
        return lpv.fit_lpv_direct(
            recordings,
            self._two_step,
            structure=structure,
            focus=spec.focus,
            intersample=hold,
            fixed=spec.fixed,
            name=f"{experiment.spec.name}{DIRECT}",
            progress=self._job.reporter.iteration,
        )

    @cached_property
    def _actuators(self) -> dict[str, float]:
        known, nominal = lpv_actuators(self._job.experiment, self._section), self._job.experiment.spec.nominal
        if known is not None or nominal is None:
            return known or {}
        values = validate.load_actuators(self._job.path("nominal", nominal.fit, ending=".yaml"))
        return {name: values[name] for name in ACTUATOR_PARAMETERS}


_MODEL = "model_file"  # attribute with the model's YAML: the surfaces are then computed once for both files


def lpv_tasks(job: Job) -> Work:
    """Return the task of the lpv section; model file and direct LPV fit follow it."""
    fit = needed(job.experiment.spec.lpv, "lpv").fit
    try:
        return [_uncertainty_task(job, fit)]
    except GbidError as error:
        path = job.path(FOLDER, fit)
        return [Outcome(Item("lpv", fit, form=UNCERTAINTY), path, "failed", str(error), cause=cause_of(error))]


def model_task(suffix: str, job: Job, outcomes: Sequence[Outcome]) -> list[Task]:
    """Return the task of a model file; it follows the uncertainty task and has the content key of the surfaces."""
    item = f"{needed(job.experiment.spec.lpv, 'lpv').fit}{suffix}"
    source = job.path(FOLDER, item)
    if not any(outcome.path == source and outcome.state != "failed" for outcome in outcomes):
        return []
    file = Result(Item("lpv", item), source.with_suffix(".yaml"), stored_key(source))
    return [Task.of(file, partial(_write_model, source=source), read=_read_status)]


def _direct_tasks(job: Job, outcomes: Sequence[Outcome]) -> list[Task]:
    section = needed(job.experiment.spec.lpv, "lpv")
    if not section.direct or any(outcome.state == "failed" for outcome in outcomes):
        return []
    return [_uncertainty_task(job, f"{section.fit}{DIRECT}")]


def _uncertainty_task(job: Job, item: str) -> Task:
    return Task.of(Surfaces(job).result(item), partial(_write_uncertainty, item=item))


def read_surfaces(job: Job) -> dict[str, lpv.LPVFit]:
    """Return the existing surfaces of the present fits by item; empty without any."""
    section = job.experiment.spec.lpv
    if section is None:
        return {}
    fits: dict[str, lpv.LPVFit] = {}
    with suppress(GbidError, OSError):
        surfaces = Surfaces(job)
        for item in (section.fit, f"{section.fit}{DIRECT}"):
            result = surfaces.result(item)
            path = result.path.with_suffix(".yaml")
            if stored_key(path) == result.key:
                fits[item] = hdf5.load(path.with_suffix(".h5"), lpv.LPVFit)
    return fits


def _write_uncertainty(job: Job, part: Path, item: str) -> Made:
    """Write the uncertainty of surfaces with the text of the model file."""
    surfaces = Surfaces(job)
    fit = surfaces.make(item)
    with scratch_folder(part) as folder:
        file = folder / "model.yaml"
        write_model(fit.model, file)
        text = file.read_text(encoding="utf-8")
    with hdf5.writing(part, lpv.LPVFit.FILE, overwrite=True) as h5:
        fit.to_hdf5(h5)
        h5.attrs.update({"key": surfaces.result(item).key, _MODEL: text})
    return Made(fit.status)


def _write_model(_: Job, part: Path, source: Path) -> Made:
    with hdf5.reading(source, lpv.LPVFit.FILE) as file:
        part.write_text(str(hdf5.read_attribute(file, _MODEL)), encoding="utf-8")
    return _read_status(source)


def _read_status(path: Path) -> Made:
    with hdf5.reading(path.with_suffix(".h5"), lpv.LPVFit.FILE) as file:
        success, status = (hdf5.read_attribute(file, name) for name in ("success", "status"))
    return Made(str(status), bool(success))


LPV = Stage(
    "lpv",
    "lpv",
    (surfaces_can_be_drawn,),
    lpv_tasks,
    (partial(model_task, ""), _direct_tasks, partial(model_task, DIRECT)),
)
"""``lpv/<fit>.yaml`` and ``.h5``, and ``lpv/<fit>_direct.*`` when the direct LPV fit is wanted.

A model and its uncertainty are separate outcomes.
"""
