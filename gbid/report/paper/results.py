"""What an experiment has to show for the paper's figures and tables; nothing is made or changed here."""

from __future__ import annotations

from functools import cached_property
from typing import TypeVar

from gbid.characterise import PiezoCurve, StaticMap, load_static
from gbid.control import GainResult, p_controller, sensitivities, tune
from gbid.control.assessment.tuned_design import TunedDesign
from gbid.control.impact.impact_store import load_impacts
from gbid.control.impact.study import ImpactStudy
from gbid.errors import DataError, GbidError, UsageError
from gbid.experiment.recordings import load_made
from gbid.experiment.run.job import Job, Task
from gbid.experiment.run.perform import standing
from gbid.experiment.stages.crossval.rows import scores_of_rows
from gbid.experiment.stages.crossval.stage import read_crossval
from gbid.experiment.stages.fit.plan import fit_models
from gbid.experiment.stages.fit.stage import fit_path, load_made_fit
from gbid.experiment.stages.impact.stage import study_tasks
from gbid.experiment.stages.lpv.stage import read_surfaces
from gbid.experiment.stages.rig.model import rig_model
from gbid.experiment.stages.static.schema import wanted_signals
from gbid.experiment.stages.static.stage import static_tasks
from gbid.experiment.stages.tune.stage import read_designs
from gbid.identify import TableEntry, tabulate
from gbid.lpv import LPVFit, LPVModel
from gbid.lpv.tables import ProportionalDesign
from gbid.recording import Recording
from gbid.structure import LinearModel
from gbid.validate import NominalActuator, ValidationSummary, nominal_actuator, summarise

POINT = (6.0, 0.0)
"""Where the paper shows static map, controller and impacts: pressure [bar], speed [rpm]."""
PUBLISHED = "theisen2016"
Stored = TypeVar("Stored", StaticMap, PiezoCurve)


class Results:
    """Results of an experiment, each read when it is first asked for.

    Every property raises `DataError` that says what is missing when it is not there, or is not of the present settings.

    Parameters
    ----------
    job : Job
        Its engine is not used.
    """

    def __init__(self, job: Job) -> None:
        self.job = job
        self.experiment = job.experiment
        self._summaries: dict[str, ValidationSummary] = {}

    @cached_property
    def machine(self) -> LPVModel:
        """Model behind the rig."""
        if self.experiment.spec.rig is None:
            raise DataError("no virtual rig in this experiment, so no description of the machine")
        return rig_model(self.experiment)

    @property
    def published(self) -> bool:
        """Whether the machine is the paper's."""
        return self.experiment.spec.rig is not None and self.machine.name == PUBLISHED

    @cached_property
    def static_map(self) -> StaticMap:
        """Static characterisation of the bearing: the first that there is."""
        return self._static("bearing", StaticMap)[0][1]

    @cached_property
    def piezos(self) -> list[tuple[PiezoCurve, Recording, str, str | None]]:
        """Characterised piezos with recording, and signal and channel of the command."""
        found = []
        for name, curve in self._static("piezo", PiezoCurve):
            section = self.experiment.spec.static[name]
            recording = load_made(self.job, self.experiment.matching(section.recordings)[0])
            found.append((curve, recording, wanted_signals(section)["command"], section.command_channel))
        return found

    def summary(self, structure: str) -> ValidationSummary:
        """Cross-validation of the first fit with a structure."""
        if structure in self._summaries:
            return self._summaries[structure]
        name = self.fit_with(structure)
        if name not in self.experiment.spec.crossval:
            raise DataError(f"no cross-validation of fit {name!r}; add it to section 'crossval'")
        rows = read_crossval(self.job, name)
        if not rows:
            raise DataError(f"the cross-validation of fit {name!r} is not there; run `gbid crossval` or `gbid run`")
        self._summaries[structure] = summarise(scores_of_rows(self.job, rows))
        return self._summaries[structure]

    def fit_with(self, structure: str) -> str:
        """Name of the first fit with a structure."""
        for name, section in self.experiment.spec.fits.items():
            if section.structure == structure:
                return name
        raise DataError(f"no fit with structure {structure!r}; add one to section 'fits'")

    @cached_property
    def nominal(self) -> NominalActuator:
        """The most central actuator."""
        section = self.experiment.spec.nominal
        if section is None:
            raise DataError("no section 'nominal'; add one")
        entries = []
        for model, recordings in fit_models(self.experiment, section.fit).items():
            conditions = self.experiment.recordings[recordings[0]].conditions
            try:
                result, why = load_made_fit(self.job, section.fit, model), ""
            except DataError as error:
                result, why = None, str(error)
            entries.append(TableEntry(section.fit, model, tuple(recordings), conditions, result, why))
        return nominal_actuator(tabulate(entries))

    @cached_property
    def surfaces(self) -> LPVFit:
        """Surfaces over pressure and speed, through the fits."""
        if self.experiment.spec.lpv is None:
            raise DataError("no section 'lpv'; add one")
        found = read_surfaces(self.job)
        if not found:
            raise DataError("no surfaces of the present fits are there; run `gbid lpv` or `gbid run`")
        return next(iter(found.values()))

    @cached_property
    def identified(self) -> LPVModel:
        """Identified model of bearing and actuators."""
        model = self.surfaces.model
        if not model.actuators:
            raise DataError("the surfaces come without actuators; write `actuators: nominal` into section 'lpv'")
        return model

    @property
    def point(self) -> tuple[float, float]:
        """Operating point at which the loop is shown: the paper's, or the first where the model does not hold there."""
        domain = self.identified.domain
        inside = all(
            low <= v <= high for v, (low, high) in zip(POINT, (domain.pressure_bar, domain.speed_rpm), strict=True)
        )
        return POINT if inside else self.identified.operating_points[0]

    @cached_property
    def design(self) -> ProportionalDesign:
        """Gains and low-pass that come with the machine."""
        if self.machine.controller is None:
            raise DataError(f"machine {self.machine.name!r} comes with no controller; add one to its model file")
        return self.machine.controller

    @property
    def controller(self) -> LinearModel:
        """The controller of `design`."""
        d = self.design
        return p_controller(d.kappa_x, d.kappa_y, d.lowpass_hz, d.lowpass_order)

    @cached_property
    def retuned(self) -> GainResult:
        """Gains tuned on the published model at the paper's point, under the peak of S_o that its own gains have."""
        cap = sensitivities(self.machine.plant_at(*POINT), self.controller).peak("output").value
        return tune(self.machine, operating_points=[POINT], peak_sensitivity=cap)

    @cached_property
    def impacts(self) -> dict[tuple[float, float], dict[str, ImpactStudy]]:
        """Impact studies by operating point and loop."""
        if self.experiment.spec.impacts is None:
            raise DataError("no section 'impacts'; add one")
        found: dict[tuple[float, float], dict[str, ImpactStudy]] = {}
        for task in study_tasks(self.job):
            self._need(task, "gbid impact")
            study = load_impacts(task.path)
            point = study.conditions["pressure_bar"], study.conditions["speed_rpm"]
            found.setdefault(point, {})[study.loop] = study
        return found

    def impacts_at(self, rotating: bool) -> dict[str, ImpactStudy]:
        """Impact studies of both loops at the first operating point at rest, or with a turning shaft."""
        for (_, speed), loops in self._there().items():
            if bool(speed) == rotating and {"open", "closed"} <= set(loops):
                return loops
        raise DataError(f"no impacts in open and closed loop {'with a turning shaft' if rotating else 'at rest'}")

    @property
    def loops(self) -> list[dict[str, ImpactStudy]]:
        """Impact studies of all loops by the label that a figure gives them, operating point by operating point."""
        section = self.experiment.spec.impacts
        paper = "published gains" if section is not None and section.controller == "paper" else "closed loop"
        names = {"open": "open loop", "closed": paper}
        points = [loops for loops in self._there().values() if set(loops) - set(names)]
        if not points:
            raise DataError("no impacts with further controllers; name some under 'beside' in section 'impacts'")
        return [{names.get(loop, loop): study for loop, study in loops.items()} for loops in points]

    def loops_at(self, rotating: bool) -> dict[str, ImpactStudy]:
        """Those of the first operating point at rest, or with a turning shaft."""
        for loops in self.loops:
            if bool(next(iter(loops.values())).conditions["speed_rpm"]) == rotating:
                return loops
        raise DataError(f"no impacts {'with a turning shaft' if rotating else 'at rest'}")

    def _there(self) -> dict[tuple[float, float], dict[str, ImpactStudy]]:
        try:
            return self.impacts
        except UsageError as error:  # the controller or model that they need is not there
            raise DataError(str(error)) from None

    @cached_property
    def designs(self) -> dict[str, TunedDesign]:
        """Tuned designs by name, at least one."""
        if not self.experiment.spec.controller:
            raise DataError("no section 'controller'; add one")
        found, missing = read_designs(self.job)
        if not found:
            raise DataError("; ".join(f"design {name}: {why}" for name, why in missing.items()))
        return found

    def shown_fit(self) -> tuple[str, str]:
        """Fit of the bearing and model that Fig. 7 shows: of the paper's operating point, or the first."""
        name = self.fit_with("rotor_bearing")
        models = list(fit_models(self.experiment, name))
        there = [model for model in models if fit_path(self.job, name, model).is_file()]
        if not there:
            raise DataError(f"no model of fit {name!r} is there; run `gbid fit` or `gbid run`")
        return name, next((m for m in there if m.startswith("p5_n6000_")), there[0])

    def _static(self, kind: str, result: type[Stored]) -> list[tuple[str, Stored]]:
        """Characterisations of a kind, at least one."""
        found: list[tuple[str, Stored]] = []
        for task in static_tasks(self.job):
            if self.experiment.spec.static[task.item].kind == kind:
                self._need(task, "gbid static")
                found.append((task.item, load_static(task.path, result)))
        if not found:
            raise DataError(f"no static characterisation with kind: {kind}; add one to section 'static'")
        return found

    def _need(self, task: Task, verb: str) -> None:
        """Refuse a result that is not there."""
        try:
            outcome = standing(self.job, task)
        except GbidError as error:
            raise DataError(str(error)) from None
        if outcome is None or outcome.state == "failed":
            why = f"failed: {outcome.text}" if outcome else f"not there; run `{verb}` or `gbid run`"
            raise DataError(f"{task.stage} {task.item} {why}")
