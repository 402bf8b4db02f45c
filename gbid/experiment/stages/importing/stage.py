"""Stage that imports recordings from files."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from gbid.errors import DataError, GbidError
from gbid.experiment.experiment import Experiment
from gbid.experiment.keys import content_key, file_digest
from gbid.experiment.plan import PlannedRecording
from gbid.experiment.recordings import driving_channels, recording_task, refuse_bad_signals, used_channels
from gbid.experiment.run.job import Job, Task
from gbid.experiment.run.outcome import Made
from gbid.experiment.run.stage import Stage
from gbid.experiment.stages.importing.checks import data_can_be_read
from gbid.experiment.stages.importing.plan import data_file, mapping_of
from gbid.recording import (
    Recording,
    find_group_problems,
    import_recording,
    save_recording,
)

_RANGE = ("samples", "from_s", "to_s", "piece")  # keys that say which samples of a file are taken


def import_tasks(job: Job) -> list[Task]:
    """Return the tasks of the import section, one for each recording."""
    return [
        recording_task(job, "import", planned, _write_import)
        for planned in job.experiment.recordings.values()
        if planned.imported is not None
    ]


def read_import(experiment: Experiment, planned: PlannedRecording) -> Recording:
    """Return one recording from its file; refuse it when a signal that a fit uses is faulty.

    Raises
    ------
    DataError
        When the file does not contain the mapped columns, when an earlier recording contains the same samples, or when
        a signal that a fit uses is faulty.
    UsageError
        When a unit does not suit its signal.
    """
    assert planned.imported is not None
    file = data_file(experiment, planned.imported)
    refuse_same_content(experiment, planned)
    recording = import_recording(file, mapping_of(planned.imported))
    driving = driving_channels(experiment, planned.name)
    refuse_bad_signals(planned, recording, used_channels(experiment, planned.name), file, driving=driving)
    if not planned.imported.remove_mean:
        return recording
    centred = {name: values - values.mean(axis=0) for name, values in recording.signals.items()}
    provenance = {**recording.provenance, "remove_mean": "mean of each signal removed"}
    return replace(recording, signals=centred, provenance=provenance)


def find_import_problems(experiment: Experiment) -> list[tuple[PlannedRecording, str, int]]:
    """Return the problems of all imported recordings, each alone and compared with the others.

    Returns
    -------
    list of (PlannedRecording, text, exit code)
        Recording, text and exit code of each problem.
    """
    found: list[tuple[PlannedRecording, str, int]] = []

    def readable() -> Iterator[Recording]:
        for planned in experiment.recordings.values():
            if planned.imported is not None:
                try:
                    yield replace(read_import(experiment, planned), name=planned.name)
                except GbidError as error:
                    found.append((planned, str(error), error.exit_code))

    beside = find_group_problems(readable())
    for name, problems in beside.items():
        found += [(experiment.recordings[name], problem.text, DataError.exit_code) for problem in problems]
    return found


def refuse_same_content(experiment: Experiment, planned: PlannedRecording) -> None:
    """Refuse a recording with the same samples as an earlier one, from the same file or a copy of it.

    Raises
    ------
    DataError
        Its text names the other recording.
    """
    mine = _content(experiment, planned)
    for other in experiment.recordings.values():
        if other.name == planned.name:
            return
        if other.imported is not None and _content(experiment, other) == mine:
            raise DataError(
                f"recording {planned.name!r} holds the same samples as {other.name!r}; leave one of them out, or "
                "correct its file"
            )


def _content(experiment: Experiment, planned: PlannedRecording) -> str:
    """Return a digest of the samples that a recording takes from its file."""
    assert planned.imported is not None
    columns = {name: list(signal.columns) for name, signal in planned.imported.signals.items()}
    taken = {**{key: getattr(planned.imported, key) for key in _RANGE}, "signals": columns}
    try:
        return content_key("content", taken, [file_digest(data_file(experiment, planned.imported))])
    except OSError:
        return f"unreadable {planned.name}"


def _write_import(job: Job, name: str, part: Path) -> Made:
    recording = read_import(job.experiment, job.experiment.recordings[name])
    save_recording(recording, part, overwrite=True)
    return Made(recording.provenance.get("import_remarks", ""))


IMPORT = Stage("import", "import", (data_can_be_read,), import_tasks, early=True)
"""Recordings from files, as ``recordings/<name>.h5``."""
