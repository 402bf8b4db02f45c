"""`gbid reproduce`: comparison of an experiment with the figures of the paper."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from gbid.cli.guard import guarded
from gbid.cli.options import AsJson, Debug, ExperimentPath, Overwrite, Quiet, Results, Verbose


def reproduce(
    experiment: ExperimentPath,
    results: Results = None,
    output: Annotated[
        Path | None, typer.Option("--output", metavar="FILE", help="Also write the rows to this file, as JSON.")
    ] = None,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Compare our results with those of the paper, row by row: deviation, scatter in the paper, and reasons."""
    with guarded(as_json, debug):
        import json

        from gbid.atomic import atomic_path, remove_stale_parts
        from gbid.cli.ending import finish
        from gbid.cli.manner import Manner
        from gbid.cli.printing import print_json, print_tables
        from gbid.cli.progress import reporting
        from gbid.experiment.load import load_experiment
        from gbid.experiment.run.job import Job
        from gbid.report.paper.paper_files import write_reproduction
        from gbid.report.paper.reproduction_tables import reproduction_tables

        loaded = load_experiment(experiment, results)
        remove_stale_parts(loaded.results)
        with reporting(quiet, verbose) as reporter:
            outcomes, document = write_reproduction(Job(loaded, overwrite, reporter))
        if output is not None:
            with atomic_path(output, overwrite=True) as part:
                part.write_text(json.dumps(document, indent=1, allow_nan=False) + "\n", encoding="utf-8")
        if as_json:
            print_json(document)
        else:
            print_tables(*reproduction_tables(document))
            typer.echo("\n".join(f"written: {outcome.path}" for outcome in outcomes))
        finish(outcomes, advice=Manner("reproduce", quiet=quiet).advice(loaded))
