"""Stages that give recordings: the virtual rig and the import, and how later stages read them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

from gbid.errors import DataError
from gbid.experiment.keys import content_key, file_digest, stored_key
from gbid.experiment.load import Experiment
from gbid.experiment.plan import PlannedRecording
from gbid.experiment.sources import data_file, machine_at, mapping_of, rig_experiment
from gbid.experiment.stages.common import Job, Outcome, produce
from gbid.experiment.structures import make_structure, rig_model
from gbid.lpv import LPVModel
from gbid.recording import Recording, find_problems, import_recording, load_recording, save_recording
from gbid.rig import record

FOLDER = "recordings"


def make_rig_recordings(job: Job) -> list[Outcome]:
    """Make the recordings of the rig section, ``recordings/<name>.h5``; none without that section."""
    outcomes = []
    model = rig_model(job.experiment) if job.experiment.spec.rig else None
    for planned in job.experiment.recordings.values():
        if planned.imported is None and model is not None:
            write = partial(_record, job.experiment, planned, model)
            path, key = job.path(FOLDER, planned.name), recording_key(job.experiment, planned)
            outcomes.append(produce(job, "rig", planned.name, path, key, write))
    return outcomes


def import_recordings(job: Job) -> list[Outcome]:
    """Read the recordings of the import section into ``recordings/<name>.h5``; none without that section."""
    outcomes = []
    for planned in job.experiment.recordings.values():
        if planned.imported is not None:
            path = job.path(FOLDER, planned.name)
            try:
                key = recording_key(job.experiment, planned)
            except OSError as error:
                outcome = Outcome("import", planned.name, path, "failed", f"{error.filename}: {error.strerror}")
                job.reporter.end(outcome)
            else:
                write = partial(_import, job.experiment, planned)
                outcome = produce(job, "import", planned.name, path, key, write)
            outcomes.append(outcome)
    return outcomes


def read_import(experiment: Experiment, planned: PlannedRecording) -> Recording:
    """Read one recording from its file and refuse it when a signal that a fit uses carries nothing.

    Raises
    ------
    DataError
        When the file does not hold what the mapping says, or a signal is constant or saturated.
    UsageError
        When units do not fit.
    """
    assert planned.imported is not None
    file = data_file(experiment, planned.imported)
    recording = import_recording(file, mapping_of(planned.imported))
    refuse_bad_signals(planned, recording, used_channels(experiment, planned.name), file)
    if not planned.imported.remove_mean:
        return recording
    centred = {name: values - values.mean(axis=0) for name, values in recording.signals.items()}
    provenance = {**recording.provenance, "remove_mean": "mean of each signal removed"}
    return replace(recording, signals=centred, provenance=provenance)


def refuse_bad_signals(
    planned: PlannedRecording, recording: Recording, used: Iterable[str], file: Path | None = None
) -> None:
    """Refuse a recording with too few samples, or with a used channel that is constant or saturated.

    Parameters
    ----------
    planned : PlannedRecording
        Says which signals rest at their limits by design.
    recording : Recording
    used : iterable of str
        Signals (``"p"``) or channels (``"p.x"``).
    file : pathlib.Path, optional
        Where it comes from, for the message.

    Raises
    ------
    DataError
        With all that was found.
    """
    wanted = [name.partition(".") for name in used]
    signals = dict.fromkeys(signal for signal, _, _ in wanted if signal in recording.signals)
    resting = [name for name, s in planned.imported.signals.items() if s.rests_at_limits] if planned.imported else []
    texts = []
    for problem in find_problems(recording, signals):
        if problem.kind == "saturated" and problem.signal in resting:
            continue
        if problem.signal and not any(s == problem.signal and c in ("", problem.channel) for s, _, c in wanted):
            continue
        hint = " If it rests there by design, write rests_at_limits: true." if planned.imported else ""
        texts.append(problem.text + (hint if problem.kind == "saturated" else ""))
    if texts:
        raise DataError("; ".join(f"{file}: {text}" if file else text for text in texts))


def used_channels(experiment: Experiment, recording: str) -> list[str]:
    """Signals and channels that the fits take from a recording."""
    used: list[str] = []
    for fit, section in experiment.spec.fits.items():
        if recording in [q.name for q in experiment.fit_recordings(fit)]:
            structure = make_structure(experiment, fit)
            used += [*(section.inputs or structure.inputs), *(section.outputs or structure.outputs)]
    return list(dict.fromkeys(used))


def recording_key(experiment: Experiment, planned: PlannedRecording) -> str:
    """Content key of a recording as it comes from the rig or its file."""
    if planned.imported is not None:
        file = data_file(experiment, planned.imported)
        settings = {"remove_mean": planned.imported.remove_mean, **mapping_of(planned.imported)}
        return content_key("import", settings, [file_digest(file)])
    rig = experiment.spec.rig
    assert rig is not None
    settings = {
        "name": planned.name,
        "seed": rig.seed,
        "sample_time": rig.sample_time_s,
        "conditions": dict(planned.conditions),
        "experiment": asdict(rig_experiment(experiment, planned)),
        "machine": asdict(machine_at(experiment, planned, rig_model(experiment))),
    }
    return content_key("rig", settings)


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
    DataError
        Naming the command that makes it.
    """
    if not path.is_file():
        raise DataError(f"{path}: not there; `{command}` makes it")
    found = stored_key(path)
    if not found:
        raise DataError(f"{path}: truncated or not made by an experiment; make it again with `{command} --overwrite`")
    if found != key:
        raise DataError(f"{path}: made from other settings or data; make it again with `{command} --overwrite`")


def _record(experiment: Experiment, planned: PlannedRecording, model: LPVModel, part: Path) -> None:
    rig = experiment.spec.rig
    assert rig is not None
    made = record(
        machine_at(experiment, planned, model),
        rig_experiment(experiment, planned),
        conditions=planned.conditions,
        seed=rig.seed,
        name=planned.name,
        sample_time=rig.sample_time_s,
    )
    save_recording(made, part, overwrite=True)


def _import(experiment: Experiment, planned: PlannedRecording, part: Path) -> None:
    save_recording(read_import(experiment, planned), part, overwrite=True)
