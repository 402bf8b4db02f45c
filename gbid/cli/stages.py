"""How verbs run stages, and how they tell what came of it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from gbid.campaign.run import working
from gbid.cli.ending import finish, outcome_rows
from gbid.cli.printing import print_json, print_tables
from gbid.cli.progress import reporting
from gbid.cli.views import view_of
from gbid.errors import UsageError
from gbid.experiment.load import load_experiment
from gbid.experiment.run.job import Job
from gbid.experiment.run.outcome import Outcome
from gbid.experiment.run.stage import Stage, run_stage
from gbid.experiment.stages import registry


@contextmanager
def opened(path: Path, sections: Sequence[str], results: Path | None, hint: str = "", **options: Any) -> Iterator[Job]:
    """Load an experiment, hold the folder of its results and give the job to run in it.

    Parameters
    ----------
    path : path
        The YAML.
    sections : sequence of str
        Sections of which the YAML must have one.
    results : path, optional
    hint : str
        What else may be done when it has none of them.
    **options
        As in `gbid.campaign.run.working`.

    Raises
    ------
    UsageError
        When it has none of the sections.
    """
    experiment = load_experiment(path, results)
    if not any(experiment.file.data.get(section) for section in sections):
        words = " or ".join(repr(section) for section in sections)
        raise UsageError(f"{path}: no section {words}, so there is nothing to do; add one{hint}")
    with reporting() as reporter, working(experiment, reporter=reporter, **options) as job:
        yield job


def run_stages(
    names: Sequence[str], path: Path, results: Path | None, as_json: bool, hint: str = "", **options: Any
) -> None:
    """Run stages by name and tell what they made; the YAML must have the section of one of them."""
    stages = [stage for stage in registry.STAGES if stage.name in names]
    with opened(path, [stage.section for stage in stages], results, hint, **options) as job:
        outcomes = [outcome for stage in stages for outcome in run_stage(job, stage)]
    tell(job, stages, outcomes, as_json)


def tell(job: Job, stages: Sequence[Stage], outcomes: Sequence[Outcome], as_json: bool) -> None:
    """Print what stages made, and end with the exit code."""
    document: dict[str, Any] = {}
    for stage in stages:
        document |= view_of(stage).document(job, outcomes)
    if as_json:
        print_json({**document, "outcomes": outcome_rows(outcomes)})
    else:
        for stage in stages:
            print_tables(*view_of(stage).tables(document))
    finish(outcomes, document.get("crossval", ()))
