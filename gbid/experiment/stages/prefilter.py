"""Stage of the prefilter: checks, filtered recordings, and run-out maps."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Literal

from gbid.core.errors import DataError
from gbid.core.hdf5 import load, save
from gbid.experiment.controllers import answered, stationary_at
from gbid.experiment.experiment import NO_POINT, Experiment, PlannedRecording
from gbid.experiment.fields import Found, Item, Result, needed
from gbid.experiment.recordings import (
    driving_channels,
    load_made,
    recording_result,
    recording_tasks,
    refuse_bad_signals,
    used_channels,
)
from gbid.experiment.run import Job, Made, Outcome, Stage, Task
from gbid.experiment.schema import PrefilterSection
from gbid.prefilter import RunoutMap
from gbid.prefilter.filtering import PrefilterFile, prefilter, read_report, save_prefiltered
from gbid.prefilter.runout_identification import (
    align_index,
    compare_runout,
    identify_runout,
    leftover_words,
    refuse_lost_index,
)
from gbid.recording import Recording
from gbid.recording.recording import with_unbalance


def runout_maps_can_be_made(experiment: Experiment) -> Found:
    """Yield a problem for each operating point without stationary recording, position or angle."""
    section = needed(experiment.spec.prefilter, "prefilter")
    if section.median % 2 == 0:
        yield ("prefilter", "median"), f"{section.median} is even; give an odd size, 1 for no median"
    for planned in experiment.recordings.values():
        if planned.excited and "p" not in planned.signals:
            text = f"recording {planned.name!r} has no signal p, which the prefilter works on"
            yield planned.location, f"{text}; name one so, or remove the section prefilter"
    if section.method == "none":
        return
    still = {q.point for q in experiment.recordings.values() if q.stationary}
    if section.slow_roll is not None:
        if not any(q.stationary for q in experiment.matching(section.slow_roll)):
            yield ("prefilter", "slow_roll"), f"no stationary recording matches {', '.join(section.slow_roll)}"
        still.add(NO_POINT)
    reported: set[str] = set()
    for planned in experiment.recordings.values():
        if planned.excited and not answered(experiment, planned) and planned.point not in still | reported:
            reported.add(planned.point)
            text = f"no stationary recording at {planned.point} (as {planned.name!r}), so no run-out map"
            yield ("prefilter",), f"{text}; add one, or write method: none"


FOLDER = "prefiltered"
MAP_FOLDER = "prefilter"
MAP = "map {}"
"""How an item is written that is the map of an operating point."""
POSITION = "p"
_HARMONICS_IN_LOOP = 10  # where their number is to be found from data


def prefilter_tasks(job: Job) -> list[Task]:
    """Return the tasks of the prefilter section, one for each excited recording."""
    return recording_tasks(job, prefiltered_result, _write_prefiltered, lambda planned: planned.excited)


def map_tasks(job: Job, outcomes: Sequence[Outcome]) -> list[Task]:
    """Return the tasks that store maps and reports, one per operating point, after the prefilter tasks."""
    experiment, section = job.experiment, needed(job.experiment.spec.prefilter, "prefilter")
    failed = {outcome.item.section for outcome in outcomes if outcome.state == "failed"}
    tasks = []
    for label, excited in _by_map(experiment).items():
        filtered = [planned for planned in excited if planned.name not in failed]
        if filtered:
            sources = [prefiltered_result(experiment, planned) for planned in filtered]
            item, settings = Item("prefilter", label, form=MAP), section.model_dump()
            result = experiment.result(item, MAP_FOLDER, settings, sources)
            tasks.append(Task.of(result, partial(_write_map, label=label), [planned.name for planned in filtered]))
    return tasks


def prefiltered_result(experiment: Experiment, planned: PlannedRecording) -> Result:
    """Return the result file of a prefiltered recording."""
    section = needed(experiment.spec.prefilter, "prefilter")
    sources = [recording_result(experiment, q) for q in (planned, *_stills(experiment, planned))]
    settings = {"name": planned.name, **section.model_dump()}
    return experiment.result(Item("prefilter", planned.name), FOLDER, settings, sources)


def _stills(experiment: Experiment, planned: PlannedRecording) -> list[PlannedRecording]:
    """Return the stationary recordings for the run-out map of a recording; empty if it needs no map."""
    section = experiment.spec.prefilter
    if section is None or section.method == "none":
        return []
    return (loop_stills if answered(experiment, planned) else _stationary)(experiment, planned.point)


def with_needed(experiment: Experiment, names: Iterable[str]) -> set[str]:
    """Return the names of recordings and of all recordings needed for their prefilter or controller."""
    recordings = [experiment.recordings[name] for name in names]
    recordings += [still for planned in recordings if planned.excited for still in _stills(experiment, planned)]
    recordings += [
        still for planned in recordings if planned.in_loop for still in stationary_at(experiment, planned.point)
    ]
    return {planned.name for planned in recordings}


def loop_stills(experiment: Experiment, point: str) -> list[PlannedRecording]:
    """Return the recordings of the rig in closed loop without excitation at an operating point."""
    return [planned for planned in experiment.points[point] if planned.run[:1] == ("loop_still",)]


def fit_input(experiment: Experiment, planned: PlannedRecording) -> Result:
    """Return the result file of a recording as the fits use it: prefiltered if there is a prefilter."""
    result_of = recording_result if experiment.spec.prefilter is None else prefiltered_result
    return result_of(experiment, planned)


def load_fit_input(job: Job, planned: PlannedRecording) -> Recording:
    """Return a recording as the fits use it: prefiltered if there is a prefilter.

    Raises
    ------
    DataError
        When the recording is missing or was made from other settings.
    """
    return load(fit_input(job.experiment, planned).require(), Recording)


def _write_prefiltered(job: Job, part: Path, name: str) -> None:
    planned = job.experiment.recordings[name]
    section = needed(job.experiment.spec.prefilter, "prefilter")
    runout_map, answers = _stated_maps(job, planned)  # first, because without them nothing can be done
    raw = load_made(job, planned)
    driving = driving_channels(job.experiment, planned.name)
    refuse_bad_signals(planned, raw, used_channels(job.experiment, planned.name), driving=driving)
    if runout_map is not None and runout_map.needs_angle:
        refuse_bad_signals(planned, raw, ["phi"], kinds=("encoder",))
        if section.align_index:
            raw = align_index(runout_map, raw).apply(raw)
        else:
            refuse_lost_index(runout_map, raw)
    filtered, report = prefilter(
        raw,
        runout_map,
        answers=answers,
        spikes=section.spikes,
        median=section.median,
        remove_mean=section.remove_mean,
        any_condition=planned.point == NO_POINT,
    )
    if "speed_rpm" in filtered.signals and "phi" in filtered.signals:
        filtered = with_unbalance(filtered)
    save_prefiltered(filtered, report, part)


def _stated_maps(job: Job, planned: PlannedRecording) -> tuple[RunoutMap | None, dict[str, RunoutMap]]:
    """Return the run-out map of a recording, and in closed loop the maps of the controller's response to run-out."""
    try:
        if not answered(job.experiment, planned):
            return _runout_map(job, planned.point), {}
        maps = _maps_in_loop(job, planned.point)
        return maps.get(POSITION), {signal: answer for signal, answer in maps.items() if signal != POSITION}
    except DataError as error:
        raise type(error)(f"no run-out map: {error}") from None


def _write_map(job: Job, part: Path, label: str) -> Made:
    excited = _by_map(job.experiment)[label]
    results = [prefiltered_result(job.experiment, planned) for planned in excited]
    runout_map, _ = _stated_maps(job, excited[0])
    reports = tuple(read_report(result.path) for result in results if result.is_made)
    save(PrefilterFile(runout_map, reports), part, overwrite=True)
    return Made("; ".join(runout_map.notes) if runout_map else "")


@lru_cache(maxsize=64)
def _runout_map(job: Job, point: str) -> RunoutMap | None:
    """Return the run-out map of an operating point; cached for its recordings and the report."""
    section = needed(job.experiment.spec.prefilter, "prefilter")
    if section.method == "none":
        return None
    still: list[Recording] = []
    for planned in _stationary(job.experiment, point):
        rec = load_made(job, planned)
        refuse_bad_signals(
            planned, rec, ["p", "phi"], kinds=("too_few_samples", "rub", "encoder", "sample_time", "speed")
        )
        if section.align_index and still:
            rec = align_index(identified_map(still[:1], section)[0], rec).apply(rec)
        still.append(rec)
    runout_map, notes = identified_map(still, section)
    return replace(runout_map, notes=(*runout_map.notes, *notes, *leftover_words(runout_map, still)))


def identified_map(still: list[Recording], section: PrefilterSection) -> tuple[RunoutMap, tuple[str, ...]]:
    """Return the run-out map by the method of the section, and a note if held-out data chose method or order."""
    if section.method == "bins" or (section.method == "harmonics" and section.harmonics != "auto"):
        number = 1 if section.harmonics == "auto" else section.harmonics  # not used by bins
        return identify_runout(still, method=section.method, harmonics=number, bins=section.bins), ()
    by_method = section.method == "auto"
    compared = compare_runout(still) if by_method else compare_runout(still, bins=())
    chosen = compared.chosen
    left = ", ".join(f"{1e9 * rms:.1f}" for rms in chosen.residual_rms)
    size = "" if chosen.method == "mean" else f", {chosen.size}"
    key = "method" if by_method else "harmonics"
    return compared.runout_map, (f"{key} auto: {chosen.method}{size}; rms residual on test data {left} nm",)


@lru_cache(maxsize=64)
def _maps_in_loop(job: Job, point: str) -> dict[str, RunoutMap]:
    """Return the maps of p, r and u over the shaft angle, for a controller that responds to run-out."""
    section = needed(job.experiment.spec.prefilter, "prefilter")
    if section.method == "none":
        return {}
    still = [load_made(job, planned) for planned in loop_stills(job.experiment, point)]
    number = _HARMONICS_IN_LOOP if section.harmonics == "auto" else section.harmonics
    method: Literal["bins", "harmonics"] = "bins" if section.method == "bins" else "harmonics"
    return {
        signal: identify_runout(still, method=method, harmonics=number, bins=section.bins, signal=signal, in_loop=True)
        for signal in (POSITION, "r", "u")
    }


def _by_map(experiment: Experiment) -> dict[str, list[PlannedRecording]]:
    """Return the excited recordings that have a common run-out map, keyed by operating point and loop."""
    excited: dict[str, list[PlannedRecording]] = {}
    for point, recordings in experiment.points.items():
        for planned in (q for q in recordings if q.excited):
            label = f"{point}_loop" if answered(experiment, planned) else point
            excited.setdefault(label, []).append(planned)
    return excited


def _stationary(experiment: Experiment, point: str) -> list[PlannedRecording]:
    stationary = [q for q in experiment.points.get(point, ()) if q.stationary]
    section = experiment.spec.prefilter
    if point == NO_POINT and not stationary and section is not None and section.slow_roll is not None:
        return [q for q in experiment.matching(section.slow_roll) if q.stationary]
    return stationary


PREFILTER = Stage("prefilter", "prefilter", (runout_maps_can_be_made,), prefilter_tasks, (map_tasks,), early=True)
"""``prefiltered/<name>.h5`` for each excited recording, and ``prefilter/<point>.h5`` with the maps."""
