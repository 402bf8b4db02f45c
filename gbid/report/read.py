"""Stored results of an experiment for report and tables: designs, fits, states of files, missing results."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from math import nan
from typing import TYPE_CHECKING, Generic, TypeVar

from gbid import control, lpv, validate
from gbid.control.assessment import assessed_alike, sampling_words
from gbid.core.arrays import Point, point_label
from gbid.core.errors import DataError, GbidError, UsageError
from gbid.core.hdf5 import load
from gbid.core.tables import Row
from gbid.experiment.controllers import (
    design_structure,
    is_fitted,
    peak_cap,
    published_design,
    published_structure,
    sample_time,
)
from gbid.experiment.experiment import Experiment, recordings_of
from gbid.experiment.fields import Item, content_key, stored_key
from gbid.experiment.machine import rig_model
from gbid.experiment.recordings import RecordingSignals, read_signals
from gbid.experiment.run import Job, Outcome, Task, standing
from gbid.experiment.schema import ControllerSection
from gbid.experiment.stages.crossval import CrossvalRow, nominal_of, read_crossval, read_summary
from gbid.experiment.stages.cycle import CycleRow, made_rows
from gbid.experiment.stages.fit import FIT, made_document
from gbid.experiment.stages.impact import loops_without_controller, study_tasks
from gbid.experiment.stages.importing import IMPORT
from gbid.experiment.stages.lpv import read_surfaces
from gbid.experiment.stages.prefilter import FOLDER as PREFILTERED
from gbid.experiment.stages.prefilter import PREFILTER
from gbid.experiment.stages.rig import RIG
from gbid.experiment.stages.static import load_made_static, static_tasks
from gbid.experiment.stages.tune import assess_published, design_plant, impact, read_designs
from gbid.prefilter import PiezoCurve, StaticMap
from gbid.prefilter.filtering import correction_rows, read_report
from gbid.structure import LinearModel
from gbid.structure.linear import Structure

if TYPE_CHECKING:
    from gbid.control.assessment import DesignFigures, TunedDesign
    from gbid.control.loop.close import Method

KEPT = 0.8
"""Smallest share of its damping that a design keeps when sampled, without a warning."""


@dataclass(frozen=True, eq=False)
class AssessedDesign:
    """Controller with its stored performance figures, and the conditions of its assessment.

    Attributes
    ----------
    name : str
        Name of the design. With several groups, the name of the published controller contains that of the first design
        of its group.
    group : str
        First design of the group that was assessed under the same conditions.
    figures : DesignFigures
        Stored figures.
    structure : Structure or Scheduled
        Structure of the controller.
    plant : LPVModel
        Plant of the loop.
    impact : HalfSine
        Impact of the assessment.
    sample_time : float
        Sample time of the controller [s].
    method : {"tustin", "zoh"}
        Discretisation of the controller.
    cap : float or None
        Cap on the peak of S_o.
    for_sampling : bool
        Whether the cap is on the sampled loop, for which the controller was designed.
    is_published : bool
        Whether it is the published controller.
    """

    name: str
    group: str
    figures: DesignFigures
    structure: Structure | control.Scheduled
    plant: lpv.LPVModel
    impact: control.HalfSine
    sample_time: float
    method: Method
    cap: float | None
    for_sampling: bool = False
    is_published: bool = False

    def at(self, point: Point) -> LinearModel:
        """Return the controller at an operating point."""
        return control.controller_at(self.structure, self.figures.gains, *point)

    def warnings(self) -> list[str]:
        """Return the warnings of the design: stability, sampling, peak of S_o and travel."""
        worst = {name: value for name, (value, _) in self.figures.worst.items()}
        if not (self.for_sampling or self.figures.stable.all()):
            return ["not stable at every operating point"]
        texts = []
        if not self.figures.sampled_stable.all():
            texts.append(f"sampled loop not stable at every point, {sampling_words(self.sample_time, self.method)}")
        if worst["sampled_damping"] < KEPT * worst["damping"]:
            text = f"sampled, its smallest damping factor is {worst['sampled_damping']:.3f}"
            texts.append(f"{text}, not {worst['damping']:.3f}")
        peak = worst["sampled_peak_output" if self.for_sampling else "peak_output"]
        if self.cap is not None and peak > self.cap * (1 + 1e-4):
            texts.append(f"peak of S_o {peak:.3f}, above {self.cap:g}")
        if self.figures.exceeds_travel.any():
            texts.append("the reference impact asks for more travel than a stack has")
        return texts


def assessed_designs(job: Job, designs: Mapping[str, TunedDesign]) -> tuple[AssessedDesign, ...]:
    """Return tuned designs with structure and plant; the published controller follows each group."""
    experiment, groups = job.experiment, assessed_alike(designs)
    assessed: list[AssessedDesign] = []
    for group in groups:
        first = next(iter(group))
        for name, design in group.items():
            section = experiment.spec.controller[name]
            if is_fitted(experiment, section):  # no pressure and speed over which pictures are drawn
                continue
            plant, sampled = design_plant(job, section)[0], section.design_for == "sampled"
            conditions = plant, design.impact, design.sample_time, design.method, peak_cap(section), sampled
            for figures in design.performance[: None if name == first else 1]:
                published = None if figures is design.performance[0] else published_design(experiment, section)
                form = (
                    published_structure(published) if published else design_structure(experiment, section, plant.domain)
                )
                label = (
                    name if published is None else figures.name if len(groups) == 1 else f"{figures.name} (as {first})"
                )
                assessed.append(
                    AssessedDesign(label, first, figures, form, *conditions, is_published=published is not None)
                )
    return tuple(sorted(assessed, key=lambda q: q.name not in designs))


def assessed_published(job: Job, model: lpv.LPVModel | None) -> tuple[AssessedDesign, ...]:
    """Return the assessed published controller of a model, for an experiment without designs; empty if unknown."""
    published = None if model is None else published_design(job.experiment)
    figures = None if model is None else assess_published(job.experiment, model)
    if model is None or published is None or figures is None:
        return ()
    section = ControllerSection()
    conditions = (
        impact(section).on(model.machine),
        sample_time(job.experiment, section),
        section.method,
        peak_cap(section),
    )
    about = figures.name, figures.name, figures, published_structure(published), model
    return (AssessedDesign(*about, *conditions, is_published=True),)


@dataclass(frozen=True, eq=False)
class MadeFit:
    """Existing fit with the document that tables show.

    Attributes
    ----------
    fit, model : str
        Names of the fit and of its model.
    point : str
        Operating point of its recordings; empty when they have several.
    document : dict
        Document of `gbid.experiment.stages.fit.fit_document`, with true values for recordings of the rig.
    """

    fit: str
    model: str
    point: str
    document: Row

    @property
    def name(self) -> str:
        """Names of the fit and of its model, such as ``"bearing/p5_n6000_prbs1"``."""
        return f"{self.fit}/{self.model}"

    @property
    def smallest(self) -> float:
        """Smallest fit percent over its outputs; nan without outputs."""
        return min((row["fit_percent"] for row in self.document["fit_percent"]), default=nan)


def read_fit(job: Job, fit: str, model: str) -> MadeFit:
    """Return an existing fit from the document in its file."""
    document = made_document(job, fit, model)
    points = {job.experiment.recordings[name].point for name in recordings_of(job.experiment, fit, model)}
    return MadeFit(fit, model, points.pop() if len(points) == 1 else "", document)


def place_of(conditions: Mapping[str, float]) -> str:
    """Return the operating point of given conditions as text; empty if pressure or speed is unknown."""
    known = {"pressure_bar", "speed_rpm"} <= set(conditions)
    return point_label(conditions["pressure_bar"], conditions["speed_rpm"]) if known else ""


Value = TypeVar("Value")


@dataclass(frozen=True, eq=False)
class StageResults(Generic[Value]):
    """Results of one stage: existing results, and the reasons for missing results.

    Attributes
    ----------
    complete : dict of str to value
        Existing results by name.
    missing : dict of str to str
        Reason for each missing result, by name.
    """

    complete: Mapping[str, Value]
    missing: Mapping[str, str]


def read_standings(job: Job) -> tuple[Outcome, ...]:
    """Return the states of recordings, prefiltered recordings and fits, in this order."""
    standings = []
    work = [item for stage in (RIG, IMPORT, PREFILTER, FIT) for item in stage.work(job)]
    for task in (item for item in work if isinstance(item, Task)):
        missing = Outcome(task.item, task.path, "missing", "not made yet")
        try:
            standings.append(standing(job, task) or missing)
        except UsageError:
            text = "made with other settings or data, or by another gbid"
            standings.append(replace(missing, state="stale", text=text))
    return tuple(standings)


def read_tasks(job: Job, tasks: Sequence[Task], verb: str, load: Callable[[Task], Value]) -> StageResults[Value]:
    """Return the existing results of tasks, and the reasons for missing ones.

    Parameters
    ----------
    job : Job
        The job.
    tasks : sequence of Task
        Tasks of one stage.
    verb : str
        Command that makes the results, such as ``"gbid static"``.
    load : callable
        Function that loads the result of a task.
    """
    results: dict[str, Value] = {}
    missing: dict[str, str] = {}
    for task in tasks:
        try:
            outcome = standing(job, task)
            if outcome is None:
                missing[task.item.section] = f"{task.item.stage} {task.item} is missing; run `{verb}` or `gbid run`"
            elif outcome.state == "failed":
                missing[task.item.section] = f"{task.item.stage} {task.item} failed: {outcome.text}"
            else:
                results[task.item.section] = load(task)
        except GbidError as error:
            missing[task.item.section] = str(error)
    return StageResults(results, missing)


@dataclass(frozen=True, eq=False)
class Results:
    """Stored results of an experiment, each loaded at its first use; nothing is computed.

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
        """Experiment of the results."""
        return self.job.experiment

    @cached_property
    def rig(self) -> lpv.LPVModel | None:
        """Model of the virtual rig; None for recordings of a real machine."""
        return None if self.experiment.spec.rig is None else rig_model(self.experiment)

    @cached_property
    def standings(self) -> tuple[Outcome, ...]:
        """States of recordings, prefiltered recordings and fits, in this order."""
        return read_standings(self.job)

    @cached_property
    def recordings(self) -> tuple[RecordingSignals, ...]:
        """Signals of the existing excited recordings."""
        sections = {f.item.section for f in self.standings if f.item.stage in ("rig", "import") and f.state == "kept"}
        planned = self.experiment.recordings.items()
        return tuple(read_signals(self.job, name) for name, q in planned if q.excited and name in sections)

    @cached_property
    def prefiltered(self) -> list[Row]:
        """Corrections by the prefilter for each channel."""
        sections = [f.item.section for f in self.standings if f.item.stage == "prefilter" and f.state == "kept"]
        return [row for item in sections for row in correction_rows([read_report(self.job.path(PREFILTERED, item))])]

    @cached_property
    def fits(self) -> tuple[MadeFit, ...]:
        """Existing fits."""
        items = [f.item for f in self.standings if f.item.stage == "fit" and f.state == "kept"]
        return tuple(read_fit(self.job, item.section, item.model) for item in items)

    @cached_property
    def crossval(self) -> dict[str, tuple[list[CrossvalRow], validate.ValidationSummary]]:
        """Rows and summary of each existing cross-validation, by fit."""
        validated = {}
        for name in self.experiment.spec.crossval:
            rows = read_crossval(self.job, name)
            summary = read_summary(self.job, name) if rows else None
            if summary is not None:
                validated[name] = rows, summary
        return validated

    @cached_property
    def nominal(self) -> validate.NominalActuator:
        """Nominal actuator."""
        if self.experiment.spec.nominal is None:
            raise DataError("no section 'nominal'; add one")
        return nominal_of(self.job)[0]

    @cached_property
    def surfaces(self) -> dict[str, lpv.LPVFit]:
        """Existing surfaces over pressure and speed, by item."""
        return read_surfaces(self.job)

    @cached_property
    def statics(self) -> StageResults[StaticMap | PiezoCurve]:
        """Static characterisations."""
        return read_tasks(
            self.job, static_tasks(self.job), "gbid static", lambda t: load_made_static(self.job, t.item.section)
        )

    @cached_property
    def designs(self) -> StageResults[TunedDesign]:
        """Tuned designs."""
        try:
            return StageResults(*read_designs(self.job))
        except GbidError as error:
            return StageResults({}, dict.fromkeys(self.experiment.spec.controller, str(error)))

    @cached_property
    def assessed(self) -> tuple[AssessedDesign, ...]:
        """Tuned designs and published controllers with their stored performance figures."""
        if self.experiment.spec.controller:
            return assessed_designs(self.job, self.designs.complete)
        return assessed_published(self.job, self.loop_model)

    @property
    def loop_model(self) -> lpv.LPVModel | None:
        """Model for closed loops: the surfaces, else the model of the rig, if it has actuators."""
        models = (*(fit.model for fit in self.surfaces.values()), self.rig)
        return next((model for model in models if model is not None and model.actuators), None)

    @cached_property
    def studies(self) -> StageResults[control.ImpactStudy]:
        """Impact studies; loops without controller count as missing."""
        if self.experiment.spec.impacts is None:
            return StageResults({}, {})
        try:
            idle = loops_without_controller(self.experiment)
            studies = read_tasks(
                self.job, study_tasks(self.job), "gbid impact", lambda q: load(q.path, control.ImpactStudy)
            )
        except UsageError as error:  # their controller or model is missing
            return StageResults({}, {"impacts": str(error)})
        return StageResults(
            studies.complete, {**{loop: f"{loop} loop: {why}" for loop, why in idle.items()}, **studies.missing}
        )

    @cached_property
    def cycle(self) -> list[CycleRow]:
        """Rounds of the identification-for-control cycle; empty until the cycle is complete."""
        return made_rows(self.job)

    @property
    def loops(self) -> list[dict[str, control.ImpactStudy]]:
        """Impact studies by loop, for each operating point."""
        points: dict[tuple[float, float], dict[str, control.ImpactStudy]] = {}
        for study in self.studies.complete.values():
            point = study.conditions["pressure_bar"], study.conditions["speed_rpm"]
            points.setdefault(point, {})[study.loop] = study
        return list(points.values())

    def labelled(self, loops: Mapping[str, control.ImpactStudy]) -> dict[str, control.ImpactStudy]:
        """Return the impact studies of one operating point, keyed by their labels in figures."""
        section = self.experiment.spec.impacts
        paper = "published gains" if section is not None and section.controller.kind == "paper" else "closed loop"
        names = {"open": "open loop", "closed": paper}
        return {names.get(loop, loop): study for loop, study in loops.items()}


REPORT = "report.html"
_FOLDERS = ("static", "crossval", "lpv", "nominal", "impacts", "controller", "cycle", "loops")


def report_key(results: Results) -> str:
    """Return the content key of the report: the states of all results and the keys of their files."""
    experiment = results.experiment
    standings = [[f.item.stage, str(f.item), f.state, f.text] for f in results.standings]
    fits = [stored_key(results.job.path("fits", *f.item.names)) for f in results.standings if f.item.stage == "fit"]
    spec = {**experiment.spec.model_dump(mode="json", exclude={"rig", "imported"}), "standings": standings}
    return content_key("report", spec, [*fits, *made_keys(results)])


def made_keys(results: Results) -> list[str]:
    """Return the content keys of the results in the report other than recordings and fits."""
    folders = [results.experiment.results / folder for folder in _FOLDERS]
    return [stored_key(path) for folder in folders for path in sorted(folder.glob("*.*"))]


def kept_report(job: Job) -> Outcome | None:
    """Return the outcome of an up-to-date report, found without drawing; else None."""
    path = job.experiment.results / REPORT
    if stored_key(path) != report_key(Results(job)):
        return None
    outcome = Outcome(Item("report", REPORT), path, "kept")
    job.reporter.end(outcome)
    return outcome
