"""Stage that prefilters (paper, Sec. 3.5): one run-out map per operating point, from its stationary runs."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

from gbid.errors import DataError
from gbid.experiment.keys import content_key
from gbid.experiment.load import Experiment
from gbid.experiment.plan import PlannedRecording
from gbid.experiment.stages.common import Job, Outcome, produce
from gbid.experiment.stages.recordings import (
    load_checked,
    load_made,
    recording_key,
    refuse_bad_signals,
    used_channels,
)
from gbid.prefilter import PrefilterReport, RunoutMap, identify_runout, prefilter, save_prefilter
from gbid.recording import Recording, save_recording

FOLDER = "prefiltered"
MAP_FOLDER = "prefilter"


def prefilter_recordings(job: Job) -> list[Outcome]:
    """Write ``prefiltered/<name>.h5`` for each excited recording and ``prefilter/<point>.h5`` with the maps.

    Nothing without a prefilter section. A recording that cannot be prefiltered does not stop the others.
    """
    if job.experiment.spec.prefilter is None:
        return []
    excited = [q for q in job.experiment.recordings.values() if q.excited]
    outcomes = []
    for point in dict.fromkeys(q.point for q in excited):
        outcomes += _prefilter_point(job, point, [q for q in excited if q.point == point])
    return outcomes


def prefiltered_key(experiment: Experiment, planned: PlannedRecording) -> str:
    """Content key of a prefiltered recording."""
    section = experiment.spec.prefilter
    assert section is not None
    sources = [recording_key(experiment, planned), *_stationary_keys(experiment, planned.point)]
    return content_key("prefilter", {"name": planned.name, **section.model_dump()}, sources)


def fit_input_key(experiment: Experiment, planned: PlannedRecording) -> str:
    """Content key of the recording that fits use: prefiltered when the experiment prefilters."""
    if experiment.spec.prefilter is None:
        return recording_key(experiment, planned)
    return prefiltered_key(experiment, planned)


def load_fit_input(job: Job, planned: PlannedRecording) -> Recording:
    """Read the recording that fits use.

    Raises
    ------
    DataError
        When it is not there, or was made from other settings.
    """
    if job.experiment.spec.prefilter is None:
        return load_made(job, planned)
    key = prefiltered_key(job.experiment, planned)
    return load_checked(job.path(FOLDER, planned.name), key, "gbid fit")


def _prefilter_point(job: Job, point: str, excited: list[PlannedRecording]) -> list[Outcome]:
    """Prefilter the recordings of one operating point, then store its map with their reports."""
    section = job.experiment.spec.prefilter
    assert section is not None
    try:
        runout_map = _runout_map(job, point)
    except DataError as error:
        outcomes = [
            Outcome("prefilter", q.name, job.path(FOLDER, q.name), "failed", f"no run-out map: {error}")
            for q in excited
        ]
        for outcome in outcomes:
            job.reporter.end(outcome)
        return outcomes
    reports: list[PrefilterReport] = []
    outcomes, keys = [], []
    for planned in excited:
        key, path = prefiltered_key(job.experiment, planned), job.path(FOLDER, planned.name)
        outcome = produce(job, "prefilter", planned.name, path, key, partial(_write, job, planned, runout_map, reports))
        outcomes.append(outcome)
        if outcome.state == "kept":
            reports.append(_filtered(job, planned, runout_map)[1])
        if outcome.state != "failed":
            keys.append(key)

    def write_map(part: Path) -> None:
        save_prefilter(part, runout_map, reports, overwrite=True)

    map_key = content_key("map", section.model_dump(), keys)
    outcomes.append(produce(job, "prefilter", f"map {point}", job.path(MAP_FOLDER, point), map_key, write_map))
    return outcomes


def _runout_map(job: Job, point: str) -> RunoutMap | None:
    section = job.experiment.spec.prefilter
    assert section is not None
    if section.method == "none":
        return None
    still = [load_made(job, q) for q in _stationary(job.experiment, point)]
    return identify_runout(still, method=section.method, harmonics=section.harmonics, bins=section.bins)


def _filtered(job: Job, planned: PlannedRecording, runout_map: RunoutMap | None) -> tuple[Recording, PrefilterReport]:
    section = job.experiment.spec.prefilter
    assert section is not None
    raw = load_made(job, planned)
    refuse_bad_signals(planned, raw, used_channels(job.experiment, planned.name))
    return prefilter(raw, runout_map, median=section.median, remove_mean=section.remove_mean)


def _write(
    job: Job, planned: PlannedRecording, runout_map: RunoutMap | None, reports: list[PrefilterReport], part: Path
) -> None:
    filtered, report = _filtered(job, planned, runout_map)
    save_recording(filtered, part, overwrite=True)
    reports.append(report)


def _stationary(experiment: Experiment, point: str) -> list[PlannedRecording]:
    return [q for q in experiment.recordings.values() if not q.excited and q.point == point]


def _stationary_keys(experiment: Experiment, point: str) -> list[Any]:
    section = experiment.spec.prefilter
    if section is None or section.method == "none":
        return []
    return [recording_key(experiment, q) for q in _stationary(experiment, point)]
