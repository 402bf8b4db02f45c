"""Stage that imports recordings from files: checks, tasks, and duplicate contents."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from gbid.core.errors import DataError, GbidError, UsageError
from gbid.core.index import version_of
from gbid.experiment.experiment import Experiment, PlannedRecording
from gbid.experiment.fields import Found, content_key, file_digest, needed
from gbid.experiment.recordings import (
    driving_channels,
    mapping_of,
    recording_result,
    recording_tasks,
    refuse_bad_signals,
    save_made,
    used_channels,
)
from gbid.experiment.run import Job, Made, Stage, Task
from gbid.prefilter.filtering import repair_overloads
from gbid.recording import ImportMapping, Recording
from gbid.recording.formats import file_formats, format_of
from gbid.recording.importing import import_recording
from gbid.recording.quality import find_group_problems


def data_can_be_read(experiment: Experiment) -> Found:
    """Yield problems of data files and mappings, without reading file contents."""
    folder = experiment.folder / needed(experiment.spec.imported, "import").data_folder
    if not folder.is_dir():
        yield ("import", "data_folder"), f"no folder {folder}; give it relative to the experiment file"
    yield from experiment.imports.problems
    by_place = {location: entry for entry, location in reversed(experiment.imports.files)}
    for here, entry in by_place.items():  # all files of a folder share one mapping; that of the first is checked
        path = experiment.data_file(entry)
        listed = "recordings" in here
        here_file = (*here, "file") if listed else here
        file_format = format_of(path)
        if file_format is None:
            yield here_file, f"unknown ending {path.suffix!r}; expected one of {', '.join(file_formats())}"
        elif folder.is_dir() and not path.is_file():
            yield here_file, f"no file {path}; put it there, or correct the name or data_folder"
        here_mapping = here if listed else here[:2]
        try:
            mapping = ImportMapping.from_dict(mapping_of(entry))
        except (UsageError, DataError) as error:
            yield here_mapping, str(error)
            continue
        may_be_stated = file_format is None or file_format.states_sample_time
        if mapping.sample_time is None and mapping.time is None and not may_be_stated:
            yield here_mapping, "neither sample_time_s nor time is given; give the sample time or the time column"


_RANGE = ("samples", "from_s", "to_s", "piece")  # keys that say which samples of a file are taken


def import_tasks(job: Job) -> list[Task]:
    """Return the tasks of the import section, one for each recording."""
    return recording_tasks(job, recording_result, _write_import, lambda planned: planned.imported is not None)


def read_import(experiment: Experiment, planned: PlannedRecording) -> Recording:
    """Return one recording from its file; refuse faults in signals that a fit uses.

    Raises
    ------
    DataError
        When the file does not contain the mapped columns, when an earlier recording contains the same samples, or when
        a signal that a fit uses is faulty.
    UsageError
        When a unit does not suit its signal.
    """
    assert planned.imported is not None
    file = experiment.data_file(planned.imported)
    refuse_same_content(experiment, planned)
    recording = repair_overloads(import_recording(file, mapping_of(planned.imported)))
    driving = driving_channels(experiment, planned.name)
    refuse_bad_signals(planned, recording, used_channels(experiment, planned.name), file, driving=driving)
    if not planned.imported.remove_mean:
        return recording
    centred = {name: values - np.nanmean(values, axis=0) for name, values in recording.signals.items()}
    provenance = {**recording.provenance, "remove_mean": "mean of each signal removed"}
    return replace(recording, signals=centred, provenance=provenance)


def find_import_problems(experiment: Experiment) -> list[tuple[PlannedRecording, str, int]]:
    """Return the problems of all imported recordings, single ones and duplicates.

    Returns
    -------
    list of (PlannedRecording, text, exit code)
        Recording, text and exit code of each problem.
    """
    faults: list[tuple[PlannedRecording, str, int]] = []
    makes_maps = experiment.spec.prefilter is not None and experiment.spec.prefilter.method != "none"

    def readable() -> Iterator[Recording]:
        for planned in experiment.recordings.values():
            if planned.imported is not None:
                try:
                    recording = replace(read_import(experiment, planned), name=planned.name)
                    if planned.stationary and makes_maps and "phi" in recording.signals:
                        refuse_bad_signals(planned, recording, ["p", "phi"], kinds=("encoder",))
                    yield recording
                except GbidError as error:
                    faults.append((planned, str(error), error.exit_code))

    for name, problems in find_group_problems(readable()).items():
        faults += [(experiment.recordings[name], problem.text, DataError.exit_code) for problem in problems]
    return faults


def refuse_same_content(experiment: Experiment, planned: PlannedRecording) -> None:
    """Refuse a recording with samples equal to an earlier recording.

    Raises
    ------
    DataError
        Its text names the other recording.
    """
    content = _content(experiment, planned)
    for other in experiment.recordings.values():
        if other.name == planned.name:
            return
        if other.imported is not None and _content(experiment, other) == content:
            text = f"recording {planned.name!r} holds the same samples as {other.name!r}"
            raise DataError(f"{text}; leave one of them out, or correct its file")


def _content(experiment: Experiment, planned: PlannedRecording) -> str:
    """Return a digest of the samples that a recording uses of its file."""
    assert planned.imported is not None
    try:
        return _content_of(experiment, planned.name, version_of(experiment.data_file(planned.imported)))
    except OSError:
        return f"unreadable {planned.name}"


@lru_cache(maxsize=1 << 16)
def _content_of(experiment: Experiment, name: str, _version: tuple[int, ...]) -> str:
    """Return the digest of the present samples; cached, because each recording is compared with all earlier ones."""
    entry = experiment.recordings[name].imported
    assert entry is not None
    columns = {signal: list(mapped.columns) for signal, mapped in entry.signals.items()}
    taken = {**{key: getattr(entry, key) for key in _RANGE}, "signals": columns}
    return content_key("content", taken, [file_digest(experiment.data_file(entry))])


def _write_import(job: Job, part: Path, name: str) -> Made:
    planned = job.experiment.recordings[name]
    recording = read_import(job.experiment, planned)
    save_made(recording, planned, part)
    remarks = (recording.provenance.get(key, "") for key in ("source_rows", "import_remarks"))
    return Made("; ".join(filter(None, remarks)))


IMPORT = Stage("import", "import", (data_can_be_read,), import_tasks, early=True)
"""Recordings from files, as ``recordings/<name>.h5``."""
