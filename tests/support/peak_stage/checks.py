"""What the peaks section means."""

from __future__ import annotations

from gbid.experiment.experiment import Experiment
from gbid.experiment.fields import Found, nearest
from peak_stage.schema import peaks_of


def peaks_have_recordings(experiment: Experiment) -> Found:
    """There are recordings of these names."""
    section = peaks_of(experiment.spec)
    for pattern in section.recordings if section else ():
        if not experiment.matching((pattern,)):
            known = nearest(pattern, experiment.recordings)
            yield ("peaks", "recordings"), f"no recording matches {pattern!r}; {known}"
