"""`gbid figures`: the figures and tables of the paper, from the results of an experiment."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
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
        from gbid.cli.printing import print_json
        from gbid.cli.progress import reporting
        from gbid.cli.stages import Manner, finish, outcome_rows
        from gbid.core.files import remove_stale_parts
        from gbid.experiment.load import load_experiment
        from gbid.experiment.run import Job
        from gbid.report.paper import FOLDER, write_paper

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


# ---- `gbid report`: one HTML file with the existing results.


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
        from gbid.cli.printing import print_json
        from gbid.cli.progress import reporting
        from gbid.cli.stages import Manner, finish, outcome_rows
        from gbid.core.errors import UsageError
        from gbid.core.files import remove_stale_parts
        from gbid.experiment.load import load_experiment
        from gbid.experiment.run import Job
        from gbid.report.write import write_report

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


# ---- `gbid reproduce`: comparison of an experiment with the figures of the paper.


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

        from gbid.cli.printing import print_json, print_tables
        from gbid.cli.progress import reporting
        from gbid.cli.stages import Manner, finish
        from gbid.core.files import atomic_path, remove_stale_parts
        from gbid.experiment.load import load_experiment
        from gbid.experiment.run import Job
        from gbid.report.paper import reproduction_tables, write_reproduction

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


# ---- `gbid serve`: results as pages that follow a running campaign.


def serve(
    experiment: ExperimentPath,
    port: Annotated[int, typer.Option("--port", metavar="N", help="Port of this machine; 0 for any free one.")] = 8471,
    results: Results = None,
    browser: Annotated[bool, typer.Option("--browser", help="Open the report in the browser.")] = False,
    debug: Debug = False,
) -> None:
    """Show the results as pages on this machine; they follow a running campaign. Ctrl-C ends it."""
    with guarded(debug=debug):
        import webbrowser

        from gbid.serve import open_server

        server = open_server(Path(experiment), results, port)
        try:
            typer.echo(f"report: {server.address}")
            typer.echo(f"gain explorer: {server.address}explorer")
            if browser:
                webbrowser.open(server.address)
            server.serve_forever()
        finally:
            server.server_close()
