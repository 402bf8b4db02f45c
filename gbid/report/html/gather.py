"""Read what there is of an experiment; nothing is made or changed."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np

from gbid.control import ControllerDesign, load_controller
from gbid.control.assessment.tuned_design import TunedDesign
from gbid.errors import DataError, GbidError, UsageError
from gbid.experiment.run.job import Job, Task
from gbid.experiment.run.perform import standing
from gbid.experiment.stages.crossval.pairing import validate_pair
from gbid.experiment.stages.crossval.rows import CrossvalRow, scores_of_rows
from gbid.experiment.stages.crossval.stage import read_crossval
from gbid.experiment.stages.fit.plan import recordings_of
from gbid.experiment.stages.fit.stage import fit_tasks, load_made_fit
from gbid.experiment.stages.fit.structures import make_structure
from gbid.experiment.stages.fit.truth import true_model, true_values
from gbid.experiment.stages.importing.stage import import_tasks
from gbid.experiment.stages.lpv.stage import read_surfaces
from gbid.experiment.stages.prefilter.stage import FOLDER as PREFILTERED
from gbid.experiment.stages.prefilter.stage import prefilter_tasks
from gbid.experiment.stages.rig.model import rig_model
from gbid.experiment.stages.rig.stage import rig_tasks
from gbid.experiment.stages.tune.stage import read_designs
from gbid.identify import FitResult, TableEntry, tabulate
from gbid.lpv import LPVFit, LPVModel
from gbid.prefilter.store import read_report
from gbid.recording import Recording, find_problems, load_recording
from gbid.report.html.traces import trace
from gbid.report.tables.fit_document import Row, fit_document
from gbid.report.tables.recording_tables import prefilter_rows
from gbid.validate import NominalActuator, ValidationSummary, nominal_actuator, summarise

State = Literal["there", "failed", "missing", "stale"]
DESIGNS = "controller"
"""Folder of the results with the controllers that were designed."""


@dataclass(frozen=True)
class Found:
    """One result file that the experiment asks for.

    Attributes
    ----------
    stage, item : str
    state : {"there", "failed", "missing", "stale"}
        Stale: made with other settings or data.
    text : str
        Why it is not there; of a fit that is, its status.
    converged : bool
    """

    stage: str
    item: str
    state: State
    text: str = ""
    converged: bool = True


@dataclass(frozen=True, eq=False)
class FoundFit:
    """A fit that is there.

    Attributes
    ----------
    fit, model, point : str
    result : FitResult
    document : dict
        From `gbid.report.tables.fit_document.fit_document`.
    traces : tuple of dict
        From `gbid.report.html.traces.trace`, one for each of its recordings.
    no_trace : str
        Why there are none.
    """

    fit: str
    model: str
    point: str
    result: FitResult
    document: Row
    traces: tuple[dict[str, Any], ...]
    no_trace: str = ""


@dataclass(frozen=True, eq=False)
class FoundRecording:
    """What the signals of a recording are like.

    Attributes
    ----------
    name, kind, point : str
    n_samples : int
    duration : float
        [s]
    signals : dict of str to tuple of (channel, rms, largest)
        About the mean, in `units`.
    units : dict of str to str
    alike : float or None
        Correlation of the two channels of the excitation.
    problems : tuple of str
    """

    name: str
    kind: str
    point: str
    n_samples: int
    duration: float
    signals: Mapping[str, tuple[tuple[str, float, float], ...]]
    units: Mapping[str, str]
    alike: float | None
    problems: tuple[str, ...]


class Gathered:
    """The results of an experiment, each read when it is first asked for.

    Parameters
    ----------
    job : Job
        Its engine is not used.
    """

    def __init__(self, job: Job) -> None:
        self.job = job
        self.experiment = job.experiment

    @cached_property
    def standings(self) -> list[Found]:
        """Recordings, prefiltered recordings and fits, in this order."""
        tasks = [*rig_tasks(self.job), *import_tasks(self.job), *prefilter_tasks(self.job), *fit_tasks(self.job)]
        return [self._found(task) for task in tasks]

    @cached_property
    def recordings(self) -> list[FoundRecording]:
        """Excited recordings that are there."""
        there = {f.item for f in self.standings if f.stage in ("rig", "import") and f.state == "there"}
        return [
            _described(self.job, name) for name, q in self.experiment.recordings.items() if q.excited & (name in there)
        ]

    @cached_property
    def prefiltered(self) -> list[Row]:
        """What the prefilter took out of each channel."""
        rows: list[Row] = []
        for found in self.standings:
            if found.stage == "prefilter" and found.state == "there":
                rows += prefilter_rows([read_report(self.job.path(PREFILTERED, found.item))])
        return rows

    @cached_property
    def fits(self) -> list[FoundFit]:
        """Fits that are there."""
        return list(self._fits())

    @cached_property
    def crossval(self) -> dict[str, tuple[list[CrossvalRow], ValidationSummary]]:
        """Rows and summary of each cross-validation that is there, by fit."""
        found = {}
        for name in self.experiment.spec.crossval:
            rows = read_crossval(self.job, name)
            if rows:
                found[name] = rows, summarise(scores_of_rows(self.job, rows))
        return found

    @cached_property
    def nominal(self) -> NominalActuator | str | None:
        """The nominal actuator, why there is none, or None when nobody asked for one."""
        section = self.experiment.spec.nominal
        if section is None:
            return None
        entries = [
            TableEntry(q.fit, q.model, q.result.recordings, {}, q.result) for q in self.fits if q.fit == section.fit
        ]
        try:
            return nominal_actuator(tabulate(entries))
        except GbidError as error:
            return str(error)

    @cached_property
    def surfaces(self) -> dict[str, LPVFit]:
        """Surfaces over pressure and speed that are there, by item."""
        return read_surfaces(self.job)

    @cached_property
    def rig(self) -> LPVModel | None:
        """The model behind the rig; None for recordings of a real machine."""
        return None if self.experiment.spec.rig is None else rig_model(self.experiment)

    @property
    def published(self) -> bool:
        """Whether the machine is the paper's."""
        return self.rig is not None and self.rig.name == "theisen2016"

    @cached_property
    def designs(self) -> tuple[list[ControllerDesign], list[str]]:
        """Controllers in the results, and what is wrong with those that cannot be read."""
        designs, faults = [], []
        for path in sorted((self.experiment.results / DESIGNS).glob("*.yaml")):
            try:
                designs.append(load_controller(path))
            except GbidError as error:
                faults.append(str(error))
        return designs, faults

    @cached_property
    def tuned(self) -> tuple[dict[str, TunedDesign], dict[str, str]]:
        """What the tuning made, by name, and why designs are not there."""
        try:
            return read_designs(self.job)
        except GbidError as error:
            return {}, dict.fromkeys(self.experiment.spec.controller, str(error))

    def _found(self, task: Task) -> Found:
        try:
            outcome = standing(self.job, task)
        except UsageError:
            return Found(task.stage, task.item, "stale", "made with other settings or data, or by another gbid")
        if outcome is None:
            return Found(task.stage, task.item, "missing", "not made yet")
        state: State = "failed" if outcome.state == "failed" else "there"
        return Found(task.stage, task.item, state, outcome.text, outcome.converged)

    def _fits(self) -> Iterator[FoundFit]:
        for found in self.standings:
            if found.stage != "fit" or found.state != "there":
                continue
            fit, _, model = found.item.partition("/")
            result, structure = load_made_fit(self.job, fit, model), make_structure(self.experiment, fit)
            truth = true_values(self.experiment, result.recordings, structure)
            document = fit_document(result, truth, true_model(structure, truth, result.model))
            shown, traces, reason = self.experiment.spec.figures.get(fit), [], ""
            for recording in recordings_of(self.experiment, fit, model):
                try:
                    validation = validate_pair(self.job, fit, model, recording)
                except (DataError, OSError) as error:
                    reason = str(error)
                else:
                    traces.append(trace(validation, shown.from_s if shown else None))
            points = dict.fromkeys(self.experiment.recordings[name].point for name in result.recordings)
            point = next(iter(points)) if len(points) == 1 else ""
            yield FoundFit(fit, model, point, result, document, tuple(traces), reason)


def _described(job: Job, name: str) -> FoundRecording:
    planned = job.experiment.recordings[name]
    recording = load_recording(job.path("recordings", name))
    signals = {
        signal: tuple(
            (channel, float(column.std()), float(abs(column - column.mean()).max()))
            for channel, column in zip(recording.channels[signal], values.T, strict=True)
        )
        for signal, values in recording.signals.items()
        if signal not in ("phi",)
    }
    problems = tuple(problem.text for problem in find_problems(recording, [s for s in recording.signals if s != "phi"]))
    return FoundRecording(
        name,
        planned.kind,
        planned.point,
        recording.n_samples,
        recording.duration,
        signals,
        dict(recording.units),
        _alike(recording),
        problems,
    )


def _alike(recording: Recording) -> float | None:
    """Correlation of the two channels of r, or of u."""
    for signal in ("r", "u"):
        values = recording.signals.get(signal)
        if values is not None and values.shape[1] == 2 and values.std(axis=0).min() > 0:
            return float(np.asarray(np.corrcoef(values.T))[0, 1])
    return None
