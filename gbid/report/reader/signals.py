"""Signals of the excited recordings: rms, correlation of the excitations, problems."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from gbid.experiment.run.job import Job
from gbid.recording import Recording, find_problems, load_recording


@dataclass(frozen=True, eq=False)
class RecordingSignals:
    """Properties of the signals of a recording.

    Attributes
    ----------
    name, kind, point : str
        Name, kind and operating point of the recording.
    n_samples : int
        Number of samples.
    duration : float
        Duration [s].
    signals : dict of str to tuple of (channel, rms, largest)
        Rms and largest absolute value about the mean of each channel, in `units`.
    units : dict of str to str
        Units by signal.
    alike : float or None
        Correlation of the two channels of the excitation.
    problems : tuple of str
        Problems of the signals.
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


def read_signals(job: Job, name: str) -> RecordingSignals:
    """Return the properties of the signals of an existing recording."""
    planned = job.experiment.recordings[name]
    recording = load_recording(job.path("recordings", name))
    named = [signal for signal in recording.signals if signal != "phi"]
    signals = {
        signal: tuple(
            (channel, float(column.std()), float(abs(column - column.mean()).max()))
            for channel, column in zip(recording.channels[signal], recording.signals[signal].T, strict=True)
        )
        for signal in named
    }
    meant = "speed" if planned.kind == "run_up" else ""  # the speed of a run-up changes by design
    problems = tuple(problem.text for problem in find_problems(recording, named) if problem.kind != meant)
    size = recording.n_samples, recording.duration
    units, alike = dict(recording.units), _alike(recording)
    return RecordingSignals(name, planned.kind, planned.point, *size, signals, units, alike, problems)


def _alike(recording: Recording) -> float | None:
    """Return the correlation of the two channels of r, or of u."""
    for signal in ("r", "u"):
        values = recording.signals.get(signal)
        if values is not None and values.shape[1] == 2 and values.std(axis=0).min() > 0:
            return float(np.asarray(np.corrcoef(values.T))[0, 1])
    return None
