"""Recordings as inputs of later stages: result files, content keys, signal checks."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from gbid.core.errors import DataError
from gbid.core.hdf5 import load, read_document, save
from gbid.core.index import DOCUMENT, known
from gbid.experiment.controllers import closed_loop_settings, loop_settings, stationary_at
from gbid.experiment.experiment import Experiment, PlannedRecording, digest_or_not, with_linked
from gbid.experiment.fields import Item, Result, stored_key
from gbid.experiment.machine import rig_model, rig_run
from gbid.experiment.run import Job, Made, Task
from gbid.experiment.schema import ImportedSection
from gbid.experiment.structures import fit_channels
from gbid.recording import Recording
from gbid.recording.quality import ProblemKind, find_problems


def mapping_of(entry: ImportedSection) -> dict[str, Any]:
    """Return an import entry as the mapping for `gbid.import_recording`."""
    mapping = entry.model_dump(exclude={"file", "kind", "remove_mean"}, exclude_none=True)
    for signal in mapping["signals"].values():
        del signal["rests_at_limits"]
    return mapping


FOLDER = "recordings"


def refuse_bad_signals(
    planned: PlannedRecording,
    recording: Recording,
    used: Iterable[str],
    file: Path | None = None,
    kinds: Sequence[ProblemKind] | None = None,
    driving: Iterable[str] = (),
) -> None:
    """Refuse a recording if `gbid.recording.find_problems` finds a problem in a used channel.

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
    """Return the signals and channels of a recording that are inputs but no outputs of fits."""
    measured = set(_measured_channels(experiment, recording))
    fits = experiment.fits_of.get(recording, ())
    used = dict.fromkeys(name for fit in fits for name in fit_channels(experiment, fit)[0])
    return [name for name in used if name not in measured]


def _measured_channels(experiment: Experiment, recording: str) -> list[str]:
    return [name for fit in experiment.fits_of.get(recording, ()) for name in fit_channels(experiment, fit)[1]]


def recording_result(experiment: Experiment, planned: PlannedRecording) -> Result:
    """Return the result file of a simulated or imported recording."""
    if planned.controller:  # the file of the controller is made while the cycle runs
        settings = {**rig_run(experiment, planned).settings(), **loop_settings(experiment)}
        running = stored_key(experiment.results / planned.controller)
        return experiment.result(Item("recording", planned.name), FOLDER, settings, [running])
    if planned.imported is None:
        return _rig_result(experiment, planned.name)
    settings = {"remove_mean": planned.imported.remove_mean, **mapping_of(planned.imported)}
    digests = [digest_or_not(path) for path in with_linked(experiment.data_file(planned.imported))]
    return experiment.result(Item("import", planned.name), FOLDER, settings, digests)


@lru_cache(maxsize=1 << 16)
def _rig_result(experiment: Experiment, name: str) -> Result:
    """Return the result file of a recording of the rig; cached, because the keys of all later stages need its key."""
    planned, sources = experiment.recordings[name], list[Result | str]()
    settings = rig_run(experiment, planned).settings()
    if planned.in_loop:
        settings |= closed_loop_settings(experiment)
        sources += [recording_result(experiment, still) for still in stationary_at(experiment, planned.point)]
    if planned.run[:1] == ("course",):
        settings["surfaces"] = {key: list(row) for key, row in rig_model(experiment).coefficients.items()}
    return experiment.result(Item("rig", name), FOLDER, settings, sources)


def recording_tasks(
    job: Job,
    result: Callable[[Experiment, PlannedRecording], Result],
    write: Callable[..., Made | None],
    chosen: Callable[[PlannedRecording], bool],
) -> list[Task]:
    """Return a task for each chosen recording that computes it by ``write(job, part, name=...)``."""
    recordings = filter(chosen, job.experiment.recordings.values())
    return [Task.of(result(job.experiment, q), partial(write, name=q.name), [q.name]) for q in recordings]


def load_made(job: Job, planned: PlannedRecording) -> Recording:
    """Return a recording that an earlier stage stored with the present settings.

    Raises
    ------
    DataError
        When the recording does not exist or was made from other settings.
    """
    return load(recording_result(job.experiment, planned).require(), Recording)


# ---- Signals of the excited recordings: rms, correlation of the excitations, problems.


@dataclass(frozen=True, eq=False)
class RecordingSignals:
    """Stored properties of the signals of a recording: rms values, correlation, problems.

    Attributes
    ----------
    name, kind, point : str
        Name, kind and operating point of the recording.
    n_samples : int
        Number of samples.
    duration : float
        Duration [s].
    signals : dict of str to sequence of (channel, rms, largest)
        Rms and largest absolute value about the mean of each channel, in `units`.
    units : dict of str to str
        Units by signal.
    alike : float or None
        Correlation of the two channels of the excitation.
    problems : sequence of str
        Problems of the signals.
    """

    name: str
    kind: str
    point: str
    n_samples: int
    duration: float
    signals: Mapping[str, Sequence[tuple[str, float, float]]]
    units: Mapping[str, str]
    alike: float | None
    problems: Sequence[str]


def save_made(recording: Recording, planned: PlannedRecording, part: Path) -> None:
    """Write a recording of a stage; an excited one with the signal properties for `read_signals`."""
    document = _signals_document(recording, planned) if planned.excited else None
    save(recording, part, overwrite=True, document=document)


def _signals_document(recording: Recording, planned: PlannedRecording) -> dict[str, Any]:
    """Return the signal properties of a recording as plain values, as in `RecordingSignals`."""
    named = [signal for signal in recording.signals if signal != "phi"]
    signals = {
        signal: [
            (channel, float(np.nanstd(column)), float(np.nanmax(abs(column - np.nanmean(column)))))
            for channel, column in zip(recording.channels[signal], recording.signals[signal].T, strict=True)
        ]
        for signal in named
    }
    meant = "speed" if planned.kind == "run_up" else ""  # the speed of a run-up changes by design
    pairs = (recording.signals[signal] for signal in ("r", "u") if signal in recording.signals)
    moving = (values for values in pairs if values.shape[1] == 2 and values.std(axis=0).min() > 0)
    return {
        "n_samples": recording.n_samples,
        "duration": recording.duration,
        "signals": signals,
        "units": dict(recording.units),
        "alike": next((float(np.asarray(np.corrcoef(values.T))[0, 1]) for values in moving), None),
        "problems": [problem.text for problem in find_problems(recording, named) if problem.kind != meant],
    }


def read_signals(job: Job, name: str) -> RecordingSignals:
    """Return the stored signal properties of a recording."""
    planned, path = job.experiment.recordings[name], job.path(FOLDER, name)
    document = known(path, DOCUMENT, partial(read_document, kind=Recording.FILE))
    return RecordingSignals(name, planned.kind, planned.point, **document)
