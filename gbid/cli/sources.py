"""What `gbid rig` and `gbid import` share."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from gbid.campaign.run import working
from gbid.cli.documents import recording_documents
from gbid.cli.ending import finish, outcome_rows
from gbid.cli.printing import print_json, print_tables
from gbid.cli.progress import reporting
from gbid.errors import UsageError
from gbid.experiment.load import load_experiment
from gbid.experiment.run.job import Job
from gbid.experiment.run.outcome import Outcome
from gbid.report.tables.recording_tables import recording_table


def make_recordings(
    section: str,
    stage: Callable[[Job], list[Outcome]],
    path: Path,
    results: Path | None,
    overwrite: bool,
    as_json: bool,
    engine: str,
    workers: int | None,
    retry: bool,
) -> None:
    """Run the stage of one section and print what it made.

    Raises
    ------
    UsageError
        When the experiment has no such section.
    """
    experiment = load_experiment(path, results)
    if section not in experiment.file.data:
        raise UsageError(f"{path}: no section {section!r}, so there is nothing to do; add one, or use `gbid run`")
    with (
        reporting() as reporter,
        working(experiment, overwrite=overwrite, retry=retry, reporter=reporter, engine=engine, workers=workers) as job,
    ):
        outcomes = stage(job)
    documents = recording_documents(experiment, outcomes)
    if as_json:
        print_json({"recordings": documents, "outcomes": outcome_rows(outcomes)})
    elif documents:
        print_tables(recording_table(documents))
    finish(outcomes)
