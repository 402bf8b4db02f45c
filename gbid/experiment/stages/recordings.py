"""Stages that give recordings: the virtual rig and the import, and how later stages read them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, replace
from functools import lru_cache
from pathlib import Path

from gbid.errors import DataError, GbidError
from gbid.experiment.keys import content_key, file_digest, stored_key
from gbid.experiment.load import Experiment
from gbid.experiment.plan import PlannedRecording
from gbid.experiment.rig_parts import as_settings, machine_at, record_options, rig_experiment
from gbid.experiment.sources import data_file, mapping_of
from gbid.experiment.stages.common import Job, Outcome, Task
from gbid.experiment.stages.performing import InputError, run_tasks
from gbid.experiment.structures import make_structure, rig_model
from gbid.recording import (
    ProblemKind,
    Recording,
    find_group_problems,
    find_problems,
    import_recording,
    load_recording,
    save_recording,
)
from gbid.rig import record

FOLDER = "recordings"


def make_rig_recordings(job: Job) -> list[Outcome]:
    """Make the recordings of the rig section, ``recordings/<name>.h5``; none without that section."""
    return run_tasks(job, rig_tasks(job))


def import_recordings(job: Job) -> list[Outcome]:
    """Read the recordings of the import section into ``recordings/<name>.h5``; none without that section."""
    return run_tasks(job, import_tasks(job))


def rig_tasks(job: Job) -> list[Task]:
    """List the tasks of the rig section, one for each recording."""
    return [
        _task(job, "rig", planned, _write_rig_recording)
        for planned in job.experiment.recordings.values()
        if planned.imported is None
    ]


def import_tasks(job: Job) -> list[Task]:
    """List the tasks of the import section, one for each recording."""
    return [
        _task(job, "import", planned, _write_import)
        for planned in job.experiment.recordings.values()
        if planned.imported is not None
    ]


def read_import(experiment: Experiment, planned: PlannedRecording) -> Recording:
    """Read one recording from its file and refuse it when a signal that a fit uses carries nothing.

    Raises
    ------
    DataError
        When the file does not hold what the mapping says, an earlier recording holds the same samples, or something is
        wrong with a signal that a fit uses.
    UsageError
        When units do not fit.
    """
    assert planned.imported is not None
    file = data_file(experiment, planned.imported)
    refuse_same_content(experiment, planned)
    recording = import_recording(file, mapping_of(planned.imported))
    refuse_bad_signals(planned, recording, used_channels(experiment, planned.name), file)
    if not planned.imported.remove_mean:
        return recording
    centred = {name: values - values.mean(axis=0) for name, values in recording.signals.items()}
    provenance = {**recording.provenance, "remove_mean": "mean of each signal removed"}
    return replace(recording, signals=centred, provenance=provenance)


def find_import_problems(experiment: Experiment) -> list[tuple[PlannedRecording, str, int]]:
    """Read all recordings of the import section and tell what is wrong with each, alone and beside the others.

    Returns
    -------
    list of (PlannedRecording, text, exit code)
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
    """Refuse a recording that takes the same columns and samples from the same or a copied file as one before it.

    Raises
    ------
    DataError
        Naming the other recording.
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


def refuse_bad_signals(
    planned: PlannedRecording,
    recording: Recording,
    used: Iterable[str],
    file: Path | None = None,
    kinds: Sequence[ProblemKind] | None = None,
) -> None:
    """Refuse a recording in which `gbid.recording.find_problems` finds something that concerns the channels used.

    Parameters
    ----------
    planned : PlannedRecording
        Says which signals rest at their limits by design.
    recording : Recording
    used : iterable of str
        Signals (``"p"``) or channels (``"p.x"``).
    file : pathlib.Path, optional
        Where it comes from, for the message.
    kinds : collection of str, optional
        Kinds of problems that count; all by default.

    Raises
    ------
    DataError
        With all that was found.
    """
    wanted = [name.partition(".") for name in used]
    signals = dict.fromkeys(signal for signal, _, _ in wanted if signal in recording.signals)
    resting = [name for name, s in planned.imported.signals.items() if s.rests_at_limits] if planned.imported else []
    texts = []
    for problem in find_problems(recording, signals, kinds):
        if problem.kind == "saturated" and problem.signal in resting:
            continue
        hit = [c for s, _, c in wanted if s == problem.signal]
        if problem.signal and problem.channel and not {"", problem.channel} & set(hit):
            continue
        hint = " If it rests there by design, write rests_at_limits: true." if planned.imported else ""
        texts.append(problem.text + (hint if problem.kind == "saturated" else ""))
    if texts:
        raise DataError("; ".join(f"{file}: {text}" if file else text for text in texts))


def used_channels(experiment: Experiment, recording: str) -> list[str]:
    """Signals and channels that the fits take from a recording."""
    used: list[str] = []
    for fit in experiment.fits_of.get(recording, ()):
        section, structure = experiment.spec.fits[fit], make_structure(experiment, fit)
        used += [*(section.inputs or structure.inputs), *(section.outputs or structure.outputs)]
    return list(dict.fromkeys(used))


def recording_key(experiment: Experiment, planned: PlannedRecording) -> str:
    """Content key of a recording as it comes from the rig or its file."""
    if planned.imported is not None:
        file = data_file(experiment, planned.imported)
        settings = {"remove_mean": planned.imported.remove_mean, **mapping_of(planned.imported)}
        try:
            digest = file_digest(file)
        except OSError:  # the import will say so, and is tried again when the file can be read
            digest = "cannot be read"
        return content_key("import", settings, [digest])
    known = _known_keys(experiment)
    if planned.name not in known:
        known[planned.name] = _rig_key(experiment, planned)
    return known[planned.name]


@lru_cache(maxsize=4)
def _known_keys(_experiment: Experiment) -> dict[str, str]:
    """Keys of recordings of the rig that were asked for already: an experiment does not change."""
    return {}


def _rig_key(experiment: Experiment, planned: PlannedRecording) -> str:
    settings = {
        **as_settings(record_options(experiment, planned)),
        "experiment": {str(planned.run[0]): asdict(rig_experiment(experiment, planned))},
        "machine": asdict(machine_at(experiment, planned, rig_model(experiment))),
    }
    return content_key("rig", settings)


def _content(experiment: Experiment, planned: PlannedRecording) -> str:
    """Digest of what a recording takes from its file, empty when the file cannot be read."""
    assert planned.imported is not None
    columns = {name: list(signal.columns) for name, signal in planned.imported.signals.items()}
    taken = {"samples": planned.imported.samples, "signals": columns}
    try:
        return content_key("content", taken, [file_digest(data_file(experiment, planned.imported))])
    except OSError:
        return f"unreadable {planned.name}"


def load_made(job: Job, planned: PlannedRecording) -> Recording:
    """Read a recording that an earlier stage made from the present settings.

    Raises
    ------
    DataError
        When it is not there, or was made from other settings.
    """
    path = job.path(FOLDER, planned.name)
    verb = "import" if planned.imported else "rig"
    return load_checked(path, recording_key(job.experiment, planned), f"gbid {verb}")


def load_checked(path: Path, key: str, command: str) -> Recording:
    """Read a recording after a check of its content key.

    Raises
    ------
    DataError
        When it is not there, or was made from other settings.
    """
    check_made(path, key, command)
    return load_recording(path)


def check_made(path: Path, key: str, command: str) -> None:
    """Refuse a file that is missing or was made from other settings.

    Raises
    ------
    InputError
        Naming the command that makes it.
    """
    if not path.is_file():
        raise InputError(f"{path}: not there; `{command}` makes it")
    found = stored_key(path)
    if not found:
        raise InputError(f"{path}: truncated or not made by an experiment; make it again with `{command} --overwrite`")
    if found != key:
        raise InputError(f"{path}: made from other settings or data; make it again with `{command} --overwrite`")


def _task(job: Job, stage: str, planned: PlannedRecording, write: Callable[[Job, str, Path], None]) -> Task:
    path, key = job.path(FOLDER, planned.name), recording_key(job.experiment, planned)
    return Task(stage, planned.name, path, key, write, (planned.name,))


def _write_rig_recording(job: Job, name: str, part: Path) -> None:
    experiment, planned = job.experiment, job.experiment.recordings[name]
    machine = machine_at(experiment, planned, rig_model(experiment))
    made = record(machine, rig_experiment(experiment, planned), **record_options(experiment, planned))
    save_recording(made, part, overwrite=True)


def _write_import(job: Job, name: str, part: Path) -> None:
    save_recording(read_import(job.experiment, job.experiment.recordings[name]), part, overwrite=True)
