"""What `gbid rig` and `gbid import` share."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from gbid.cli.documents import recording_documents
from gbid.cli.ending import finish, outcome_rows
from gbid.cli.printing import print_json, print_table
from gbid.cli.progress import reporting
from gbid.errors import UsageError
from gbid.experiment.load import load_experiment
from gbid.experiment.stages import Job, Outcome
from gbid.report.tables import recording_table


def make_recordings(
    section: str,
    stage: Callable[[Job], list[Outcome]],
    path: Path,
    results: Path | None,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Run the stage of one section and print what it made.

    Raises
    ------
    UsageError
        When the experiment has no such section.
    """
    experiment = load_experiment(path, results)
    if section not in experiment.file.data:
        raise UsageError(f"{path}: no section {section!r}, so there is nothing to do")
    with reporting() as reporter:
        outcomes = stage(Job(experiment, overwrite, reporter))
    documents = recording_documents(experiment, outcomes)
    if as_json:
        print_json({"recordings": documents, "outcomes": outcome_rows(outcomes)})
    elif documents:
        print_table(recording_table(documents))
    finish(outcomes)
