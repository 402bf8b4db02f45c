"""What the signals of the excited recordings are like: spread, correlation of the excitations, problems."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from gbid.experiment.run.job import Job
from gbid.recording import Recording, find_problems, load_recording


@dataclass(frozen=True, eq=False)
class RecordingSignals:
    """Signals of a recording.

    Attributes
    ----------
    name, kind, point : str
    n_samples : int
    duration : float
        [s]
    signals : dict of str to tuple of (channel, rms, largest)
        About the mean, in `units`.
    units : dict of str to str
    alike : float or None
        Correlation of the two channels of the excitation.
    problems : tuple of str
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
    """Describe the signals of a recording that is there."""
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
    problems = tuple(problem.text for problem in find_problems(recording, named))
    size = recording.n_samples, recording.duration
    units, alike = dict(recording.units), _alike(recording)
    return RecordingSignals(name, planned.kind, planned.point, *size, signals, units, alike, problems)


def _alike(recording: Recording) -> float | None:
    """Correlation of the two channels of r, or of u."""
    for signal in ("r", "u"):
        values = recording.signals.get(signal)
        if values is not None and values.shape[1] == 2 and values.std(axis=0).min() > 0:
            return float(np.asarray(np.corrcoef(values.T))[0, 1])
    return None
