"""Recordings as inputs of later stages: their content keys, and checks of their signals."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict
from functools import lru_cache
from pathlib import Path

from gbid.errors import DataError
from gbid.experiment.experiment import Experiment
from gbid.experiment.keys import content_key, file_digest
from gbid.experiment.plan import PlannedRecording
from gbid.experiment.run.inputs import load_checked
from gbid.experiment.run.job import Job, Task
from gbid.experiment.run.outcome import Made
from gbid.experiment.stages.fit.structures import fit_channels
from gbid.experiment.stages.importing.plan import data_file, mapping_of
from gbid.experiment.stages.loop.plan import closed_loop_settings, stationary_at
from gbid.experiment.stages.rig.model import rig_model
from gbid.experiment.stages.rig.plan import as_settings, machine_at, record_options, rig_experiment
from gbid.recording import (
    ProblemKind,
    Recording,
    find_problems,
)

FOLDER = "recordings"


def refuse_bad_signals(
    planned: PlannedRecording,
    recording: Recording,
    used: Iterable[str],
    file: Path | None = None,
    kinds: Sequence[ProblemKind] | None = None,
    driving: Iterable[str] = (),
) -> None:
    """Refuse a recording when `gbid.recording.find_problems` finds a problem in one of the channels used.

    Parameters
    ----------
    planned : PlannedRecording
        Planned recording; for a file it names the signals that rest at their limits by design.
    recording : Recording
        Recording to check.
    used : iterable of str
        Signals (``"p"``) or channels (``"p.x"``) that are used.
    file : pathlib.Path, optional
        File of the recording, for the message.
    kinds : collection of str, optional
        Kinds of problems to look for; all by default.
    driving : iterable of str
        Of those used, the inputs of fits. They may be constant, as in a free decay.

    Raises
    ------
    DataError
        With all problems found.
    """
    wanted = [name.partition(".") for name in used]
    signals = dict.fromkeys(signal for signal, _, _ in wanted if signal in recording.signals)
    steady = set(driving)
    resting = [name for name, s in planned.imported.signals.items() if s.rests_at_limits] if planned.imported else []
    texts = []
    for problem in find_problems(recording, signals, kinds):
        if problem.kind == "saturated" and problem.signal in resting:
            continue
        if problem.kind == "constant" and {problem.signal, f"{problem.signal}.{problem.channel}"} & steady:
            continue
        hit = [c for s, _, c in wanted if s == problem.signal]
        if problem.signal and problem.channel and not {"", problem.channel} & set(hit):
            continue
        hint = " If it rests there by design, write rests_at_limits: true." if planned.imported else ""
        texts.append(problem.text + (hint if problem.kind == "saturated" else ""))
    if texts:
        raise DataError("; ".join(f"{file}: {text}" if file else text for text in texts))


def used_channels(experiment: Experiment, recording: str) -> list[str]:
    """Return the signals and channels of a recording that the fits use."""
    return list(dict.fromkeys([*driving_channels(experiment, recording), *_measured_channels(experiment, recording)]))


def driving_channels(experiment: Experiment, recording: str) -> list[str]:
    """Return the signals and channels of a recording that are inputs of fits, and outputs of none."""
    measured = set(_measured_channels(experiment, recording))
    fits = experiment.fits_of.get(recording, ())
    used = [name for fit in fits for name in fit_channels(experiment, fit)[0]]
    return [name for name in dict.fromkeys(used) if name not in measured]


def _measured_channels(experiment: Experiment, recording: str) -> list[str]:
    return [name for fit in experiment.fits_of.get(recording, ()) for name in fit_channels(experiment, fit)[1]]


def recording_key(experiment: Experiment, planned: PlannedRecording) -> str:
    """Return the content key of a recording of the rig or of a file."""
    if planned.imported is not None:
        file = data_file(experiment, planned.imported)
        settings = {"remove_mean": planned.imported.remove_mean, **mapping_of(planned.imported)}
        try:
            digest = file_digest(file)
        except OSError:  # the import reports the error; the key changes when the file can be read
            digest = "cannot be read"
        return content_key("import", settings, [digest])
    known = _known_keys(experiment)
    if planned.name not in known:
        known[planned.name] = _rig_key(experiment, planned)
    return known[planned.name]


@lru_cache(maxsize=4)
def _known_keys(_experiment: Experiment) -> dict[str, str]:
    """Return the cache of content keys of an experiment's rig recordings; an experiment does not change."""
    return {}


def _rig_key(experiment: Experiment, planned: PlannedRecording) -> str:
    sources: list[str] = []
    settings = {
        **as_settings(record_options(experiment, planned)),
        "experiment": {str(planned.run[0]): asdict(rig_experiment(experiment, planned))},
        "machine": asdict(machine_at(experiment, planned, rig_model(experiment))),
    }
    if planned.in_loop:
        settings |= closed_loop_settings(experiment)
        sources = [recording_key(experiment, still) for still in stationary_at(experiment, planned.point)]
    if planned.run[:1] == ("course",):
        settings["surfaces"] = {key: list(row) for key, row in rig_model(experiment).coefficients.items()}
    return content_key("rig", settings, sources)


def load_made(job: Job, planned: PlannedRecording) -> Recording:
    """Return a recording that an earlier stage made from the present settings.

    Raises
    ------
    DataError
        When the recording does not exist or was made from other settings.
    """
    path = job.path(FOLDER, planned.name)
    verb = "import" if planned.imported else "rig"
    return load_checked(path, recording_key(job.experiment, planned), f"gbid {verb}")


def recording_task(
    job: Job, stage: str, planned: PlannedRecording, write: Callable[[Job, str, Path], Made | None]
) -> Task:
    """Return the task that writes one recording."""
    path, key = job.path(FOLDER, planned.name), recording_key(job.experiment, planned)
    return Task(stage, planned.name, path, key, write, (planned.name,))
