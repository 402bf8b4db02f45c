"""Stages of a verb: run them and print their outcomes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from gbid.campaign.run import working
from gbid.cli.dry_run import print_plan
from gbid.cli.ending import finish, outcome_rows
from gbid.cli.manner import Manner
from gbid.cli.printing import print_json, print_notes, print_tables
from gbid.cli.progress import reporting
from gbid.cli.views import view_of
from gbid.errors import UsageError
from gbid.experiment.changed_files import changed_files
from gbid.experiment.experiment import Experiment
from gbid.experiment.load import load_experiment
from gbid.experiment.run.job import Job
from gbid.experiment.run.outcome import Outcome
from gbid.experiment.run.stage import Stage, run_stage
from gbid.experiment.stages import registry


@contextmanager
def opened(
    experiment: Experiment, sections: Sequence[str], how: Manner, hint: str = "", **options: Any
) -> Iterator[Job]:
    """Return a context that locks the results folder of an experiment and gives the job to run.

    Parameters
    ----------
    experiment : Experiment
        The experiment.
    sections : sequence of str
        Sections of which the YAML must have at least one.
    how : Manner
        How much is said.
    hint : str
        Further advice when the YAML has none of the sections.
    **options
        Options of `gbid.campaign.run.working`.

    Raises
    ------
    UsageError
        When the YAML has none of the sections.
    """
    _check_sections(experiment, sections, hint)
    print_notes(changed_files(experiment))
    with (
        reporting(how.quiet, how.verbose) as reporter,
        working(experiment, reporter=reporter, **options) as job,
    ):
        yield job


def _check_sections(experiment: Experiment, sections: Sequence[str], hint: str) -> None:
    if not any(experiment.file.data.get(section) for section in sections):
        words = " or ".join(repr(section) for section in sections)
        raise UsageError(f"{experiment.file.path}: no section {words}; add one{hint}")


def run_stages(
    names: Sequence[str], path: Path, results: Path | None, how: Manner, hint: str = "", **options: Any
) -> None:
    """Run stages by name and print their results; the YAML must have the section of one of them."""
    stages = [stage for stage in registry.STAGES if stage.name in names]
    experiment, sections = load_experiment(path, results), list(dict.fromkeys(stage.section for stage in stages))
    if how.dry_run:
        _check_sections(experiment, sections, hint)
        print_plan(experiment, stages, how.as_json, overwrite=options["overwrite"], retry=options["retry"])
        return
    with opened(experiment, sections, how, hint, **options) as job:
        outcomes = [outcome for stage in stages for outcome in run_stage(job, stage)]
    print_outcomes(job, stages, outcomes, how)


def print_outcomes(job: Job, stages: Sequence[Stage], outcomes: Sequence[Outcome], how: Manner) -> None:
    """Print the results of stages, and end with the exit code and the next step."""
    document: dict[str, Any] = {}
    for stage in stages:
        document |= view_of(stage).document(job, outcomes)
    if how.as_json:
        print_json({**document, "outcomes": outcome_rows(outcomes)})
    else:
        for stage in stages:
            print_tables(*view_of(stage).tables(document))
    finish(outcomes, document.get("crossval", ()), how.advice(job.experiment))
