"""Surfaces of an experiment, made by `gbid.fit_lpv` from its fits."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property

from gbid.errors import UsageError
from gbid.experiment.keys import content_key
from gbid.experiment.run.inputs import InputError
from gbid.experiment.run.job import Job
from gbid.experiment.stages.fit.stage import fit_arguments, fit_entries, model_key
from gbid.experiment.stages.fit.structures import make_structure
from gbid.experiment.stages.lpv.plan import lpv_actuators
from gbid.experiment.stages.prefilter.stage import load_fit_input
from gbid.identify import TableEntry, tabulate
from gbid.lpv import LPVFit, fit_lpv, fit_lpv_direct, lpv_of
from gbid.lpv.model import ACTUATOR_PARAMETERS
from gbid.structure import NonlinearStructure, Plant, RotorBearing, ScheduledStructure
from gbid.validate.validation_store import load_actuators

DIRECT = "_direct"
"""Suffix of the name of the direct LPV fit."""


class Surfaces:
    """Surfaces of one job; each is made at its first use.

    Parameters
    ----------
    job : Job
        The job.
    more : dict of str to TableEntry
        Fits besides those of the experiment, such as those of recordings in closed loop, by their content keys.

    Raises
    ------
    UsageError
        When the experiment has no section ``lpv``.
    """

    def __init__(self, job: Job, more: Mapping[str, TableEntry] | None = None) -> None:
        self._job, self._more = job, more or {}
        section = job.experiment.spec.lpv
        if section is None:
            raise UsageError("no section 'lpv'; add one")
        self._section = section

    @cached_property
    def key(self) -> str:
        """Content key of the section, the existing fits, and the actuators."""
        there = [entry.model for entry in self._entries if entry.result is not None]
        keys = [model_key(self._job.experiment, self._section.fit, model) for model in there] + list(self._more)
        settings = {**self._section.model_dump(), "models": there, "found_actuators": self._actuators}
        return content_key("lpv", settings, keys)

    def make(self, item: str) -> LPVFit:
        """Return the surfaces of one item: those of the fit, or of its direct LPV fit."""
        return self._two_step if item == self._section.fit else self._direct()

    @cached_property
    def _entries(self) -> list[TableEntry]:
        return fit_entries(self._job, self._section.fit)

    @cached_property
    def _two_step(self) -> LPVFit:
        """Surfaces fitted to the estimates of the fits."""
        section, experiment = self._section, self._job.experiment
        if all(entry.result is None for entry in self._entries):
            raise InputError(f"fit {section.fit!r} has no results; run `gbid fit` or `gbid run` first")
        structure = make_structure(experiment, section.fit)
        if isinstance(structure, ScheduledStructure):
            return self._of_scheduled()
        return fit_lpv(
            tabulate([*self._entries, *self._more.values()]),
            weighting=section.weighting,
            order=section.order,
            robust=section.robust,
            actuators=self._actuators,
            pade_order=self._pade_order,
            name=experiment.spec.name,
            title=experiment.spec.title,
            source=f"experiment {experiment.spec.name}, fit {section.fit}",
        )

    def _of_scheduled(self) -> LPVFit:
        """Return the surfaces that the fit of a scheduled structure found."""
        (entry,), experiment = self._entries, self._job.experiment
        assert entry.result is not None
        return lpv_of(
            entry.result,
            actuators=self._actuators or None,
            name=experiment.spec.name,
            title=experiment.spec.title,
            source=f"experiment {experiment.spec.name}, fit {self._section.fit}",
        )

    def _direct(self) -> LPVFit:
        """Return the surfaces estimated directly from the recordings."""
        experiment, name = self._job.experiment, self._section.fit
        spec = experiment.spec.fits[name]
        recordings = [load_fit_input(self._job, planned) for planned in experiment.fit_recordings(name)]
        hold = fit_arguments(experiment, name, recordings)["intersample"]
        structure = make_structure(experiment, name)
        if isinstance(structure, NonlinearStructure | ScheduledStructure):
            raise UsageError(
                f"fit {name!r}: surfaces straight from the recordings are for linear structures with constant "
                "parameters"
            )
        return fit_lpv_direct(
            recordings,
            self._two_step,
            structure=structure,
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
