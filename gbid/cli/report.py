"""`gbid report`: one HTML file with the existing results."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from gbid.cli.guard import guarded
from gbid.cli.options import AsJson, Debug, ExperimentPath, Results


def report(
    experiment: ExperimentPath,
    output: Annotated[
        Path | None,
        typer.Option("--output", metavar="FILE", help="The file; by default report.html in the results."),
    ] = None,
    results: Results = None,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace the report, also a file that gbid did not write.")
    ] = False,
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Write one self-contained HTML file with the existing results; nothing else is computed."""
    with guarded(as_json, debug):
        from gbid.cli.ending import finish, outcome_rows
        from gbid.cli.printing import print_json
        from gbid.cli.progress import reporting
        from gbid.errors import UsageError
        from gbid.experiment.load import load_experiment
        from gbid.experiment.run.job import Job
        from gbid.report.html import write_report

        loaded = load_experiment(experiment, results)
        if not loaded.results.is_dir():
            raise UsageError(f"{loaded.results}: no results yet; run `gbid run {experiment}` first")
        with reporting() as reporter:
            outcome = write_report(Job(loaded, overwrite, reporter), output)
        if as_json:
            print_json({"report": str(outcome.path), "outcomes": outcome_rows([outcome])})
        elif outcome.state != "failed":
            typer.echo(f"report: {outcome.path}")
        finish([outcome])
