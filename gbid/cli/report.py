"""`gbid report`: one HTML file with the existing results."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from gbid.cli.guard import guarded
from gbid.cli.options import AsJson, Debug, ExperimentPath, Quiet, Results, Verbose


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
    quiet: Quiet = False,
    verbose: Verbose = False,
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Write one self-contained HTML file with the existing results; nothing else is computed."""
    with guarded(as_json, debug):
        from gbid.atomic import remove_stale_parts
        from gbid.cli.ending import finish, outcome_rows
        from gbid.cli.manner import Manner
        from gbid.cli.printing import print_json
        from gbid.cli.progress import reporting
        from gbid.errors import UsageError
        from gbid.experiment.load import load_experiment
        from gbid.experiment.run.job import Job
        from gbid.report.html import write_report

        loaded = load_experiment(experiment, results)
        if not loaded.results.is_dir():
            raise UsageError(f"{loaded.results}: no results yet; run `gbid run {experiment}` first")
        remove_stale_parts(loaded.results)
        if output is not None:
            remove_stale_parts(output.parent, f".{output.name}.*")
        with reporting(quiet, verbose) as reporter:
            outcome = write_report(Job(loaded, overwrite, reporter), output)
        if as_json:
            print_json({"report": str(outcome.path), "outcomes": outcome_rows([outcome])})
        elif outcome.state != "failed":
            typer.echo(f"report: {outcome.path}")
        finish([outcome], advice=Manner("report", quiet=quiet).advice(loaded))
