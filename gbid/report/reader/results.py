"""Results of an experiment: each is loaded at its first use; nothing is computed."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TypeVar

from gbid.characterise import PiezoCurve, StaticMap
from gbid.control.assessment.tuned_design import TunedDesign
from gbid.control.impact.impact_store import load_impacts
from gbid.control.impact.study import ImpactStudy
from gbid.errors import DataError, GbidError, UsageError
from gbid.experiment.experiment import Experiment
from gbid.experiment.recordings import load_made
from gbid.experiment.run.job import Job
from gbid.experiment.stages.crossval.rows import CrossvalRow
from gbid.experiment.stages.crossval.stage import read_crossval, read_summary
from gbid.experiment.stages.cycle.rows import CycleRow
from gbid.experiment.stages.cycle.stage import made_rows
from gbid.experiment.stages.impact.stage import loops_without_controller, study_tasks
from gbid.experiment.stages.loop.cost import LoopCostRow, made_costs
from gbid.experiment.stages.lpv.stage import read_surfaces
from gbid.experiment.stages.nominal.stage import nominal_of
from gbid.experiment.stages.prefilter.stage import FOLDER as PREFILTERED
from gbid.experiment.stages.rig.model import rig_model
from gbid.experiment.stages.static.schema import wanted_signals
from gbid.experiment.stages.static.stage import load_made_static, static_tasks
from gbid.experiment.stages.tune.stage import read_designs
from gbid.lpv import LPVFit, LPVModel
from gbid.prefilter.prefilter_store import read_report
from gbid.recording import Recording
from gbid.report.reader.designs import AssessedDesign, assessed_designs, assessed_published
from gbid.report.reader.fits import MadeFit, read_fit
from gbid.report.reader.signals import RecordingSignals, read_signals
from gbid.report.reader.standings import StageResults, Standing, read_standings, read_tasks
from gbid.report.tables.fit_document import Row
from gbid.report.tables.recording_tables import prefilter_rows
from gbid.validate import NominalActuator, ValidationSummary

PUBLISHED = "theisen2016"
Value = TypeVar("Value")
Kind = TypeVar("Kind", StaticMap, PiezoCurve)


@dataclass(frozen=True, eq=False)
class Results:
    """Stored results of an experiment.

    Properties with a plural name return what exists, and may be empty. Those of a single result raise `DataError` when
    it is missing or outdated; the text says what to do.

    Parameters
    ----------
    job : Job
        The job; its engine is not used.
    """

    job: Job

    @property
    def experiment(self) -> Experiment:
        """The experiment."""
        return self.job.experiment

    # ------------------------------------------------------------ machine

    @cached_property
    def rig(self) -> LPVModel | None:
        """Model behind the rig; None for recordings of a real machine."""
        return None if self.experiment.spec.rig is None else rig_model(self.experiment)

    @property
    def machine(self) -> LPVModel:
        """Model behind the rig, which must exist."""
        if self.rig is None:
            raise DataError("this experiment has no virtual rig, so there is no description of the machine")
        return self.rig

    @property
    def published(self) -> bool:
        """Whether the machine is that of the paper."""
        return self.rig is not None and self.rig.name == PUBLISHED

    # ------------------------------------------------------------ recordings and fits

    @cached_property
    def standings(self) -> tuple[Standing, ...]:
        """States of recordings, prefiltered recordings and fits, in this order."""
        return read_standings(self.job)

    @cached_property
    def recordings(self) -> tuple[RecordingSignals, ...]:
        """Signals of the existing excited recordings."""
        there = {f.item for f in self.standings if f.stage in ("rig", "import") and f.state == "there"}
        planned = self.experiment.recordings.items()
        return tuple(read_signals(self.job, name) for name, q in planned if q.excited and name in there)

    @cached_property
    def prefiltered(self) -> list[Row]:
        """Corrections by the prefilter, for each channel."""
        there = [f.item for f in self.standings if f.stage == "prefilter" and f.state == "there"]
        return [row for item in there for row in prefilter_rows([read_report(self.job.path(PREFILTERED, item))])]

    @cached_property
    def fits(self) -> tuple[MadeFit, ...]:
        """Existing fits."""
        there = [f.item.partition("/") for f in self.standings if f.stage == "fit" and f.state == "there"]
        return tuple(read_fit(self.job, fit, model) for fit, _, model in there)

    def fit_with(self, structure: str) -> str:
        """Return the name of the first fit with a structure."""
        for name, section in self.experiment.spec.fits.items():
            if section.structure == structure:
                return name
        raise DataError(f"no fit with structure {structure!r}; add one to section 'fits'")

    # ------------------------------------------------------------ cross-validation and nominal actuator

    @cached_property
    def crossval(self) -> dict[str, tuple[list[CrossvalRow], ValidationSummary]]:
        """Rows and summary of each existing cross-validation, by fit."""
        found = {}
        for name in self.experiment.spec.crossval:
            rows = read_crossval(self.job, name)
            summary = read_summary(self.job, name) if rows else None
            if summary is not None:
                found[name] = rows, summary
        return found

    def summary(self, structure: str) -> ValidationSummary:
        """Return the cross-validation of the first fit with a structure."""
        name = self.fit_with(structure)
        if name not in self.experiment.spec.crossval:
            raise DataError(f"no cross-validation of fit {name!r}; add it to section 'crossval'")
        if name not in self.crossval:
            raise DataError(f"the cross-validation of fit {name!r} is missing; run `gbid crossval` or `gbid run`")
        return self.crossval[name][1]

    @cached_property
    def nominal(self) -> NominalActuator:
        """The nominal actuator."""
        return nominal_of(self.job)[0]

    # ------------------------------------------------------------ surfaces

    @cached_property
    def surfaces(self) -> dict[str, LPVFit]:
        """Existing surfaces over pressure and speed, by item."""
        return read_surfaces(self.job)

    @property
    def surface_fit(self) -> LPVFit:
        """Surfaces fitted to the fits."""
        if self.experiment.spec.lpv is None:
            raise DataError("no section 'lpv'; add one")
        return _first(self.surfaces.values(), "there are no surfaces of the present fits; run `gbid lpv` or `gbid run`")

    @property
    def identified(self) -> LPVModel:
        """Identified model of bearing and actuators."""
        model = self.surface_fit.model
        if not model.actuators:
            raise DataError("the surfaces have no actuators; write `actuators: nominal` into section 'lpv'")
        return model

    # ------------------------------------------------------------ static characterisation

    @cached_property
    def statics(self) -> StageResults[StaticMap | PiezoCurve]:
        """Static characterisations."""
        return read_tasks(self.job, static_tasks(self.job), "gbid static", lambda t: load_made_static(self.job, t.item))

    @property
    def static_map(self) -> StaticMap:
        """First static characterisation of the bearing."""
        return next(iter(self._statics("bearing", StaticMap).values()))

    @property
    def piezos(self) -> list[tuple[PiezoCurve, Recording, str, str | None]]:
        """Characterised piezos with recording, and signal and channel of the command."""
        found = []
        for name, curve in self._statics("piezo", PiezoCurve).items():
            section = self.experiment.spec.static[name]
            recording = load_made(self.job, self.experiment.matching(section.recordings)[0])
            found.append((curve, recording, wanted_signals(section)["command"], section.command_channel))
        return found

    def _statics(self, kind: str, result: type[Kind]) -> dict[str, Kind]:
        """Return all characterisations of a kind; at least one must be planned, and all must exist."""
        asked = [name for name, section in self.experiment.spec.static.items() if section.kind == kind]
        if not asked:
            raise DataError(f"no static characterisation with kind: {kind}; add one to section 'static'")
        _all_there({name: why for name, why in self.statics.missing.items() if name in asked})
        return {name: q for name, q in self.statics.found.items() if isinstance(q, result)}

    # ------------------------------------------------------------ designs and impacts

    @cached_property
    def designs(self) -> StageResults[TunedDesign]:
        """Tuned designs."""
        try:
            return StageResults(*read_designs(self.job))
        except GbidError as error:
            return StageResults({}, dict.fromkeys(self.experiment.spec.controller, str(error)))

    @property
    def tuned(self) -> Mapping[str, TunedDesign]:
        """Tuned designs by name, at least one."""
        if not self.experiment.spec.controller:
            raise DataError("no section 'controller'; add one")
        if not self.designs.found:
            raise DataError("; ".join(f"design {name}: {why}" for name, why in self.designs.missing.items()))
        return self.designs.found

    @cached_property
    def assessed(self) -> tuple[AssessedDesign, ...]:
        """Tuned designs and published controllers with their stored figures."""
        if self.experiment.spec.controller:
            return assessed_designs(self.job, self.designs.found)
        return assessed_published(self.job, self.loop_model)

    @property
    def loop_model(self) -> LPVModel | None:
        """Model for closed loops: the surfaces, else the model behind the rig, if they have actuators."""
        models = [*(fit.model for fit in self.surfaces.values()), *([self.rig] if self.rig else [])]
        return next((model for model in models if model.actuators), None)

    @cached_property
    def studies(self) -> StageResults[ImpactStudy]:
        """Impact studies; loops without controller are among the missing."""
        if self.experiment.spec.impacts is None:
            return StageResults({}, {})
        try:
            idle = loops_without_controller(self.experiment)
            found = read_tasks(self.job, study_tasks(self.job), "gbid impact", lambda task: load_impacts(task.path))
        except UsageError as error:  # their controller or model is missing
            return StageResults({}, {"impacts": str(error)})
        return StageResults(
            found.found, {**{loop: f"{loop} loop: {why}" for loop, why in idle.items()}, **found.missing}
        )

    @cached_property
    def loop_costs(self) -> list[LoopCostRow]:
        """Standard deviations in the loop beside those without controller; empty while they are not made."""
        return made_costs(self.job)

    @cached_property
    def cycle(self) -> list[CycleRow]:
        """Rounds of the identification-for-control cycle; empty while it is not complete."""
        return made_rows(self.job)

    @property
    def loops(self) -> list[dict[str, ImpactStudy]]:
        """Impact studies by loop, for each operating point."""
        points: dict[tuple[float, float], dict[str, ImpactStudy]] = {}
        for study in self.studies.found.values():
            point = study.conditions["pressure_bar"], study.conditions["speed_rpm"]
            points.setdefault(point, {})[study.loop] = study
        return list(points.values())

    def impacts_at(self, rotating: bool) -> dict[str, ImpactStudy]:
        """Return the impact studies of both loops at the first operating point at rest, or with a turning shaft."""
        there = [loops for loops in self.loops if {"open", "closed"} <= set(loops)]
        return self._loops_at(there, rotating, "in open and closed loop ")

    def beside_at(self, rotating: bool) -> dict[str, ImpactStudy]:
        """Return the impact studies with further controllers at such a point, by their labels in figures."""
        return self._loops_at(self.beside, rotating, "")

    @property
    def beside(self) -> list[dict[str, ImpactStudy]]:
        """Impact studies of the points with further controllers, by their labels in figures."""
        self._need_impacts()
        points = [self.labelled(loops) for loops in self.loops if set(loops) - {"open", "closed"}]
        if not points:
            raise DataError("no impacts with further controllers; name some under 'beside' in section 'impacts'")
        return points

    def labelled(self, loops: Mapping[str, ImpactStudy]) -> dict[str, ImpactStudy]:
        """Return the impact studies of one point by their labels in figures."""
        section = self.experiment.spec.impacts
        paper = "published gains" if section is not None and section.controller == "paper" else "closed loop"
        names = {"open": "open loop", "closed": paper}
        return {names.get(loop, loop): study for loop, study in loops.items()}

    def _loops_at(self, points: list[dict[str, ImpactStudy]], rotating: bool, what: str) -> dict[str, ImpactStudy]:
        self._need_impacts()
        there = (q for q in points if bool(next(iter(q.values())).conditions["speed_rpm"]) == rotating)
        why = "".join(f"; {text}" for text in self.studies.missing.values())
        return _first(there, f"no impacts {what}{'with a turning shaft' if rotating else 'at rest'}{why}")

    def _need_impacts(self) -> None:
        if self.experiment.spec.impacts is None:
            raise DataError("no section 'impacts'; add one")
        if not self.studies.found:
            _all_there(self.studies.missing)


def _first(values: Iterable[Value], otherwise: str) -> Value:
    for value in values:
        return value
    raise DataError(otherwise)


def _all_there(missing: Mapping[str, str]) -> None:
    if missing:
        raise DataError("; ".join(missing.values()))
