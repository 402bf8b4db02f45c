"""Stage of the fits: one model per recording, or one for all recordings together."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from math import inf
from pathlib import Path
from typing import Any

import numpy.typing as npt

from gbid.errors import DataError, GbidError
from gbid.experiment.experiment import Experiment
from gbid.experiment.keys import content_key
from gbid.experiment.recordings import refuse_bad_signals
from gbid.experiment.run.inputs import check_made
from gbid.experiment.run.job import Job, Task
from gbid.experiment.run.outcome import Made
from gbid.experiment.run.stage import Stage
from gbid.experiment.stages.fit.checks import FIT_CHECKS
from gbid.experiment.stages.fit.option_checks import OPTION_CHECKS
from gbid.experiment.stages.fit.plan import fit_models, recordings_of
from gbid.experiment.stages.fit.structures import fit_channels, make_structure, structure_settings
from gbid.experiment.stages.prefilter.schema import PrefilterSection
from gbid.experiment.stages.prefilter.stage import fit_input_key, load_fit_input
from gbid.hdf5 import read_attribute, read_dataset, reading
from gbid.identify import FitResult, TableEntry, fit, fit_multistart, load_fit, save_fit
from gbid.identify.fit_store import KIND
from gbid.recording import ProblemKind, Recording
from gbid.validate.shaft_lines import shaft_lines

FOLDER = "fits"
_OWN_KINDS: tuple[ProblemKind, ...] = ("constant", "saturated", "too_few_samples")
_AS_THEY_ARE = (
    *("inputs", "outputs", "focus", "criterion", "horizon", "output_weights", "window", "stop", "max_iterations"),
    *("engine", "start", "fixed", "local", "offsets", "trend", "hum", "robust", "robust_threshold"),
    *("std", "bootstrap_draws", "bootstrap_seed", "ipopt"),
)


def fit_tasks(job: Job, only: str | None = None) -> list[Task]:
    """Return the tasks of all fits, or of the one named."""
    tasks = []
    for name in job.experiment.spec.fits if only is None else [only]:
        for model, recordings in fit_models(job.experiment, name).items():
            path, key = fit_path(job, name, model), fit_key(job.experiment, name, recordings)
            tasks.append(Task("fit", f"{name}/{model}", path, key, _write_fit, tuple(recordings), read_fit_summary))
    return tasks


def read_fit_summary(path: Path) -> Made:
    """Return status and smallest fit percent of an existing result.

    Raises
    ------
    DataError
        When the file is damaged.
    """
    with reading(path, KIND) as file:
        percent = read_dataset(file, "fit_percent")
        return Made(str(read_attribute(file, "status")), bool(read_attribute(file, "success")), _smallest(percent))


def fit_path(job: Job, name: str, model: str) -> Path:
    """Return the path of a fit result."""
    return job.path(f"{FOLDER}/{name}", model)


def load_made_fit(job: Job, name: str, model: str) -> FitResult:
    """Return the result of a fit that was made from the present settings.

    Raises
    ------
    DataError
        When the result is missing or was made from other settings.
    """
    recordings = recordings_of(job.experiment, name, model)
    path = fit_path(job, name, model)
    check_made(path, fit_key(job.experiment, name, recordings), "gbid fit")
    return load_fit(path)


def fit_entries(job: Job, name: str) -> list[TableEntry]:
    """Return the rows of all models of a fit for `gbid.tabulate`; a missing model has its reason."""
    entries = []
    for model, recordings in fit_models(job.experiment, name).items():
        conditions = job.experiment.recordings[recordings[0]].conditions
        try:
            result, failure = load_made_fit(job, name, model), ""
        except (DataError, OSError) as error:
            result, failure = None, str(error)
        entries.append(TableEntry(name, model, tuple(recordings), conditions, result, failure))
    return entries


def fit_key(experiment: Experiment, name: str, recordings: list[str]) -> str:
    """Return the content key of a fit to recordings."""
    settings = fit_settings(experiment, name, recordings)
    return content_key("fit", settings, [fit_input_key(experiment, experiment.recordings[r]) for r in recordings])


def fit_settings(experiment: Experiment, name: str, recordings: list[str]) -> dict[str, Any]:
    """Return the settings of a fit to recordings for content keys."""
    section = experiment.spec.fits[name]
    settings = section.model_dump(exclude={"structure", "options", "loop", "recordings", "together"})
    settings["left_out"] = {recording: settings["left_out"].get(recording) for recording in recordings}
    settings["structure"] = structure_settings(experiment, name)
    settings["recordings"] = recordings
    return settings


def fit_arguments(experiment: Experiment, name: str, data: Sequence[Recording]) -> dict[str, Any]:
    """Return the keyword arguments of `gbid.fit` for a fits section and recordings."""
    section = experiment.spec.fits[name]
    hold, state = section.intersample, section.initial_state
    return {
        **{key: getattr(section, key) for key in _AS_THEY_ARE},
        "intersample": hold[0] if hold and len(hold) == 1 else hold,
        "bounds": {
            key: (-inf if low is None else low, inf if high is None else high)
            for key, (low, high) in section.bounds.items()
        },
        "prior": {key: (known.value, known.std) for key, known in section.prior.items()},
        "initial_state": {recording.name: state[recording.name] for recording in data}
        if isinstance(state, dict)
        else state,
        "left_out": {
            recording.name: [samples_of(recording, *stretch) for stretch in section.left_out[recording.name]]
            for recording in data
            if recording.name in section.left_out
        },
    }


def samples_of(recording: Recording, from_s: float, to_s: float) -> tuple[int, int]:
    """Return the first samples at or after two times [s], as (first, stop).

    Raises
    ------
    DataError
        When no sample lies between the times, or the end lies beyond the recording.
    """
    first, stop = (math.ceil(t / recording.sample_time - 1e-6) for t in (from_s, to_s))
    if stop > recording.n_samples:
        raise DataError(
            f"left_out: recording {recording.name!r} ends at {recording.n_samples * recording.sample_time:g} s, "
            f"before {to_s:g} s; make the stretch end there"
        )
    if stop <= first:
        raise DataError(
            f"left_out: recording {recording.name!r} has no sample from {from_s:g} s to before {to_s:g} s; widen it"
        )
    return first, stop


def _write_fit(job: Job, item: str, part: Path) -> Made:
    name, _, model = item.partition("/")
    inputs, outputs = fit_channels(job.experiment, name)
    data = []
    for recording in recordings_of(job.experiment, name, model):
        planned = job.experiment.recordings[recording]
        data.append(load_fit_input(job, planned))
        # The prefilter stage has checked prefiltered recordings already; only some kinds are checked here again.
        kinds = _OWN_KINDS if job.experiment.spec.prefilter else None
        refuse_bad_signals(planned, data[-1], [*inputs, *outputs], kinds=kinds, driving=inputs)
    return save_made_fit(fitted(job, name, data), part)


def fitted(job: Job, name: str, data: Sequence[Recording]) -> FitResult:
    """Return the fit of a fits section to recordings, also to such that are not of this section."""
    structure, section = make_structure(job.experiment, name), job.experiment.spec.fits[name]
    arguments = fit_arguments(job.experiment, name, data)
    if section.multi_start is None:
        result = fit(structure, data, progress=job.reporter.iteration, **arguments)
    else:
        options = section.multi_start.model_dump()
        result = fit_multistart(structure, data, **options, progress=job.reporter.iteration, **arguments).best
    return replace(result, notes=(*result.notes, *_suspects(job, name, result, data)))


def save_made_fit(result: FitResult, part: Path) -> Made:
    """Write the result of a fit and return its summary."""
    save_fit(result, part, overwrite=True)
    return Made(result.status, result.success, _smallest(result.fit_percent))


def _suspects(job: Job, name: str, result: FitResult, data: Sequence[Recording]) -> list[str]:
    """Return remarks on lines of the shaft in residuals that are not white: run-out that the prefilter left."""
    if result.trusted == "white":
        return []
    section, left_out = job.experiment.spec.prefilter, job.experiment.spec.fits[name].left_out
    removed = "no run-out is removed" if section is None or section.method == "none" else _removed(section)
    found = []
    for rec in data:
        ranges = [samples_of(rec, *stretch) for stretch in left_out.get(rec.name, ())]
        try:
            lines = shaft_lines(result, rec, ranges)
        except GbidError:  # a model that overflows has a note of its own
            continue
        found += [
            f"suspect for residuals that are not white: {rec.name}: {line.output} has a line of {line.rms:.2g} "
            f"{_unit(rec, line.output)} rms at {line.frequency_hz:.1f} Hz, order {line.order} of the shaft; {removed}"
            for line in lines
        ]
    return found


def _removed(section: PrefilterSection) -> str:
    if section.method == "harmonics" and section.harmonics != "auto":
        return f"the prefilter removes {section.harmonics} harmonics; see what its map leaves, or write harmonics: auto"
    return f"the prefilter removes run-out by method {section.method}; see what its map leaves"


def _unit(rec: Recording, output: str) -> str:
    return rec.units.get(output.rpartition("_")[0], "")


def _smallest(percent: npt.NDArray[Any]) -> float:
    return float(percent.min()) if percent.size else math.nan


def model_key(experiment: Experiment, name: str, model: str) -> str:
    """Return the content key of a model of a fit."""
    return fit_key(experiment, name, fit_models(experiment, name)[model])


FIT = Stage("fit", "fits", (*FIT_CHECKS, *OPTION_CHECKS), fit_tasks, early=True)
"""``fits/<fit>/<recording>.h5``, or ``together.h5`` for a fit to all its recordings.

A fit that does not converge is written, too; its outcome reports that.
"""
