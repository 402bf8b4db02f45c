"""What an experiment YAML may say of peaks, and an experiment that may say it."""

from __future__ import annotations

from typing import Annotated

from pydantic import BeforeValidator

from gbid.experiment.fields import Names, Positive, Section, Text, given
from gbid.experiment.schema import ExperimentFile


class PeaksSection(Section):
    """The largest value of a signal of each recording; one above `limit` is bad data."""

    recordings: Names
    signal: Text = "u"
    limit: Positive | None = None


class FileWithPeaks(ExperimentFile):
    """An experiment with the section peaks."""

    peaks: Annotated[PeaksSection | None, BeforeValidator(given)] = None


def peaks_of(spec: ExperimentFile) -> PeaksSection | None:
    """Return the section."""
    assert isinstance(spec, FileWithPeaks)
    return spec.peaks
