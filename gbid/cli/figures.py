"""`gbid figures`: the figures and tables of the paper, from the results of an experiment."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated

import typer

from gbid.cli.guard import guarded
from gbid.cli.options import AsJson, Debug, ExperimentPath, Overwrite, Quiet, Results, Verbose


class FigureFormat(StrEnum):
    """Formats of figures."""

    PDF = "pdf"
    SVG = "svg"
    PNG = "png"


def figures(
    experiment: ExperimentPath,
    formats: Annotated[
        list[FigureFormat],
        typer.Option("--format", help="Format of the figures; give it again for a further one, which takes its time."),
    ] = [FigureFormat.PDF],  # noqa: B006  typer needs a list
    results: Results = None,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Write the paper's figures (pdf) and tables (csv, Markdown), as far as the results allow."""
    with guarded(as_json, debug):
        from gbid.atomic import remove_stale_parts
        from gbid.cli.ending import finish, outcome_rows
        from gbid.cli.manner import Manner
        from gbid.cli.printing import print_json
        from gbid.cli.progress import reporting
        from gbid.experiment.load import load_experiment
        from gbid.experiment.run.job import Job
        from gbid.report.paper.paper_files import FOLDER, write_paper

        loaded = load_experiment(experiment, results)
        remove_stale_parts(loaded.results)
        with reporting(quiet, verbose) as reporter:
            outcomes, left_out = write_paper(Job(loaded, overwrite, reporter), list(dict.fromkeys(formats)))
        if as_json:
            absent = [{"item": item.item, "why": item.why} for item in left_out]
            print_json({"outcomes": outcome_rows(outcomes), "left_out": absent})
        else:
            for item in left_out:
                typer.echo(f"left out: {item.item}: {item.why}")
            items = {o.path.stem for o in outcomes if o.state != "failed"}
            typer.echo(f"{len(items)} figures and tables in {loaded.results / FOLDER}")
        finish(outcomes, advice=Manner("figures", quiet=quiet).advice(loaded))
