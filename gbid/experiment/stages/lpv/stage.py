"""Stage that draws the surfaces over pressure and speed (paper, Sec. 4)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cached_property
from pathlib import Path

from gbid import hdf5
from gbid.errors import DataError, GbidError, UsageError
from gbid.experiment.keys import content_key, stored_key
from gbid.experiment.run.job import Job
from gbid.experiment.run.outcome import Outcome
from gbid.experiment.run.perform import produce
from gbid.experiment.stages.fit.plan import fit_models
from gbid.experiment.stages.fit.stage import fit_arguments, load_made_fit, model_key
from gbid.experiment.stages.fit.structures import make_structure
from gbid.experiment.stages.lpv.plan import lpv_actuators
from gbid.experiment.stages.prefilter.stage import load_fit_input
from gbid.identify import TableEntry, tabulate
from gbid.lpv import LPVFit, fit_lpv, fit_lpv_direct, load_lpv_fit
from gbid.lpv.load import write_model
from gbid.lpv.model import ACTUATOR_PARAMETERS
from gbid.lpv.surface_fit.lpv_fit_store import KIND, write_uncertainty
from gbid.structure import Plant, RotorBearing
from gbid.validate.store import load_actuators

FOLDER = "lpv"
DIRECT = "_direct"


def draw_surfaces(job: Job) -> list[Outcome]:
    """Write ``lpv/<fit>.yaml`` and ``.h5``, and ``lpv/<fit>_direct.*`` where the direct LPV fit is asked for.

    Returns
    -------
    list of Outcome
        Empty without a section ``lpv``. A model is an outcome of its own beside its uncertainty.
    """
    section = job.experiment.spec.lpv
    if section is None:
        return []
    making = _Making(job)
    outcomes = _stored(job, section.fit, making.key, lambda: making.two_step)
    if section.direct and all(o.state != "failed" for o in outcomes):
        outcomes += _stored(job, f"{section.fit}{DIRECT}", making.key, lambda: making.one_shot)
    return outcomes


def made_surfaces(outcomes: list[Outcome]) -> dict[str, LPVFit]:
    """Load the surfaces that are there, by item; the two-step ones first."""
    return {
        o.item: load_lpv_fit(o.path)
        for o in outcomes
        if o.stage == "lpv" and o.state != "failed" and o.path.suffix == ".yaml"
    }


def read_surfaces(job: Job) -> dict[str, LPVFit]:
    """Read the surfaces that are there, made from the present fits, by item; empty when there are none."""
    section = job.experiment.spec.lpv
    if section is None:
        return {}
    try:
        key = _Making(job).key
    except (GbidError, OSError):
        return {}
    paths = {item: job.path(FOLDER, item, ".yaml") for item in (section.fit, f"{section.fit}{DIRECT}")}
    return {item: load_lpv_fit(path) for item, path in paths.items() if stored_key(path) == key}


class _Making:
    """Fits of surfaces of one job, each made when it is first needed."""

    def __init__(self, job: Job) -> None:
        self._job = job
        section = job.experiment.spec.lpv
        if section is None:
            raise UsageError("no section 'lpv'; add one")
        self._section = section

    @cached_property
    def key(self) -> str:
        """Content key: the section, the fits that are there, and the actuators."""
        there = [entry.model for entry in self._entries if entry.result is not None]
        keys = [model_key(self._job.experiment, self._section.fit, model) for model in there]
        settings = {**self._section.model_dump(), "models": there, "found_actuators": self._actuators}
        return content_key("lpv", settings, keys)

    @cached_property
    def _entries(self) -> list[TableEntry]:
        """Fits, with the reason for those that are not there."""
        section, experiment = self._section, self._job.experiment
        entries = []
        for model, recordings in fit_models(experiment, section.fit).items():
            conditions = experiment.recordings[recordings[0]].conditions
            try:
                result, failure = load_made_fit(self._job, section.fit, model), ""
            except DataError as error:
                result, failure = None, str(error)
            entries.append(TableEntry(section.fit, model, tuple(recordings), conditions, result, failure))
        return entries

    @cached_property
    def two_step(self) -> LPVFit:
        """Surfaces through the estimates of the fits."""
        section, experiment = self._section, self._job.experiment
        if all(entry.result is None for entry in self._entries):
            raise DataError(f"no fit {section.fit!r} is there; run `gbid fit` or `gbid run` first")
        return fit_lpv(
            tabulate(self._entries),
            weighting=section.weighting,
            order=section.order,
            robust=section.robust,
            actuators=self._actuators,
            pade_order=self._pade_order,
            name=experiment.spec.name,
            title=experiment.spec.title,
            source=f"experiment {experiment.spec.name}, fit {section.fit}",
        )

    @cached_property
    def one_shot(self) -> LPVFit:
        """Surfaces straight from the recordings."""
        experiment, name = self._job.experiment, self._section.fit
        spec = experiment.spec.fits[name]
        recordings = [load_fit_input(self._job, planned) for planned in experiment.fit_recordings(name)]
        hold = fit_arguments(experiment, name, recordings)["intersample"]
        return fit_lpv_direct(
            recordings,
            self.two_step,
            structure=make_structure(experiment, name),
            focus=spec.focus,
            intersample=hold,
            fixed=spec.fixed,
            engine=spec.engine,
            name=f"{experiment.spec.name}{DIRECT}",
            progress=self._job.reporter.iteration,
        )

    @cached_property
    def _actuators(self) -> dict[str, float]:
        known, nominal = lpv_actuators(self._job.experiment, self._section), self._job.experiment.spec.nominal
        if known is not None or nominal is None:
            return known or {}
        values = load_actuators(self._job.path("nominal", nominal.fit, ".yaml"))
        return {name: values[name] for name in ACTUATOR_PARAMETERS}

    @property
    def _pade_order(self) -> int:
        structure = make_structure(self._job.experiment, self._section.fit)
        bearing = structure.bearing if isinstance(structure, Plant) else structure
        return bearing.pade_order if isinstance(bearing, RotorBearing) else 1


def _stored(job: Job, item: str, key: str, make: Callable[[], LPVFit]) -> list[Outcome]:
    """Write the uncertainty, then the model; a model is there only with its uncertainty."""

    def write_h5(part: Path) -> str:
        fit = make()
        with hdf5.writing(part, KIND, overwrite=True) as file:
            write_uncertainty(fit, file, key)
        return fit.status

    def write_yaml(part: Path) -> str:
        fit = make()
        write_model(fit.model, part, comment=f"content_key: {key}")
        return fit.status

    first = produce(job, "lpv", f"{item} uncertainty", job.path(FOLDER, item), key, write_h5)
    if first.state == "failed":
        return [first]
    model = produce(job, "lpv", item, job.path(FOLDER, item, ".yaml"), key, write_yaml)
    if model.state == "failed":
        return [first, model]
    with hdf5.reading(first.path, KIND) as file:
        converged, text = (hdf5.read_attribute(file, name) for name in ("success", "status"))
    return [first, replace(model, converged=bool(converged), text=str(text))]
