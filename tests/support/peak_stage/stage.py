"""Stage that finds the peaks, and counts them when all are there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from gbid.core.errors import DataError
from gbid.core.tables import Column, Table
from gbid.experiment.fields import content_key
from gbid.experiment.recordings import load_made, recording_key
from gbid.experiment.run import Document, Job, Made, Outcome, Stage, Task, View
from peak_stage.checks import peaks_have_recordings
from peak_stage.schema import peaks_of


def peak_tasks(job: Job) -> list[Task]:
    """One task for each recording."""
    section = peaks_of(job.experiment.spec)
    return [
        Task("peak", q.name, job.path("peaks", q.name, ".txt"), _key(job, q.name), _write_peak, (q.name,))
        for q in (job.experiment.matching(section.recordings) if section else ())
    ]


def count_task(job: Job, made: Sequence[Outcome]) -> list[Task]:
    """One task for the table of all."""
    count = sum(outcome.state != "failed" for outcome in made)
    path, key = job.path("peaks", "count", ".txt"), content_key("count", {"n": count})
    return [Task("peak", "count", path, key, _write_count)] if count else []


def _key(job: Job, name: str) -> str:
    section = peaks_of(job.experiment.spec)
    assert section is not None
    source = recording_key(job.experiment, job.experiment.recordings[name])
    return content_key("peak", section.model_dump(exclude={"recordings"}), [source])


def _write_peak(job: Job, name: str, part: Path) -> Made:
    section = peaks_of(job.experiment.spec)
    assert section is not None
    peak = float(np.abs(load_made(job, job.experiment.recordings[name]).signal(section.signal)).max())
    if section.limit is not None and peak > section.limit:
        raise DataError(f"recording {name!r}: {peak:.3g} is above the limit, {section.limit:g}")
    part.write_text(f"# content_key: {_key(job, name)}\n{peak!r}\n", encoding="utf-8")
    return Made(f"{peak:.3g}")


def _write_count(job: Job, _item: str, part: Path) -> None:
    count = len(list(part.parent.glob("*run*.txt")))
    part.write_text(f"# content_key: {content_key('count', {'n': count})}\n{count}\n", encoding="utf-8")


def _document(_: Job, outcomes: Sequence[Outcome]) -> Document:
    """Peaks by recording."""
    own = [o for o in outcomes if o.stage == "peak" and o.state != "failed" and o.item != "count"]
    return {"peaks": [{"recording": o.item, "peak": float(o.path.read_text().splitlines()[1])} for o in own]}


def _tables(document: Document) -> list[Table]:
    rows = [[row["recording"], row["peak"]] for row in document["peaks"]]
    return [Table("peaks", [Column("recording"), Column("peak", format=3)], rows)]


PEAK = Stage("peak", "peaks", (peaks_have_recordings,), peak_tasks, (count_task,))
SHOWN_PEAK = replace(PEAK, view=View(_document, _tables))
"""The same with a view of its own."""
