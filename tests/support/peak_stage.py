"""A stage of one file, beside its entry in the registry: the largest value of a signal of each recording."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import BeforeValidator

from gbid.core.errors import DataError, nearest
from gbid.core.option_types import Positive
from gbid.core.tables import Column, Table
from gbid.experiment.experiment import Experiment
from gbid.experiment.fields import Found, Item, Names, Section, Text, given
from gbid.experiment.recordings import load_made, recording_result
from gbid.experiment.run import Document, Job, Made, Outcome, Stage, Task, View
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


def peaks_have_recordings(experiment: Experiment) -> Found:
    """There are recordings of these names."""
    section = peaks_of(experiment.spec)
    for pattern in section.recordings if section else ():
        if not experiment.matching((pattern,)):
            known = nearest(pattern, experiment.recordings)
            yield ("peaks", "recordings"), f"no recording matches {pattern!r}; {known}"


def peak_tasks(job: Job) -> list[Task]:
    """One task for each recording."""
    experiment, section = job.experiment, peaks_of(job.experiment.spec)
    tasks = []
    for planned in experiment.matching(section.recordings) if section else ():
        settings, sources = section.model_dump(exclude={"recordings"}), [recording_result(experiment, planned)]
        result = experiment.result(Item("peak", planned.name), "peaks", settings, sources, ending=".txt")
        tasks.append(Task.of(result, partial(_write_peak, name=planned.name), [planned.name]))
    return tasks


def count_task(job: Job, made: Sequence[Outcome]) -> list[Task]:
    """One task for the table of all."""
    count = sum(outcome.state != "failed" for outcome in made)
    result = job.experiment.result(Item("peak", "count"), "peaks", {"n": count}, ending=".txt")
    return [Task.of(result, partial(_write_count, count=count))] if count else []


def _write_peak(job: Job, part: Path, name: str) -> Made:
    section = peaks_of(job.experiment.spec)
    assert section is not None
    peak = float(np.abs(load_made(job, job.experiment.recordings[name]).signal(section.signal)).max())
    if section.limit is not None and peak > section.limit:
        raise DataError(f"recording {name!r}: {peak:.3g} is above the limit, {section.limit:g}")
    part.write_text(f"{peak!r}\n", encoding="utf-8")
    return Made(f"{peak:.3g}")


def _write_count(_: Job, part: Path, count: int) -> None:
    part.write_text(f"{count}\n", encoding="utf-8")


def _document(_: Job, outcomes: Sequence[Outcome]) -> Document:
    """Peaks by recording."""
    peaks = [o for o in outcomes if o.item.stage == "peak" and o.state != "failed" and o.item.section != "count"]
    rows = [{"recording": o.item.section, "peak": float(o.path.read_text().splitlines()[1])} for o in peaks]
    return {"peaks": rows}


def _tables(job: Job, outcomes: Sequence[Outcome]) -> list[Table]:
    rows = [[row["recording"], row["peak"]] for row in _document(job, outcomes)["peaks"]]
    return [Table("peaks", [Column("recording"), Column("peak", format=3)], rows)]


PEAK = Stage("peak", "peaks", (peaks_have_recordings,), peak_tasks, (count_task,))
SHOWN_PEAK = replace(PEAK, view=View(_document, _tables))
"""The same with a view of its own."""
