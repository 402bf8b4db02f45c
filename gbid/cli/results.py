"""`gbid figures`, `report`, `reproduce` and `serve`: verbs that show existing results and compute nothing else."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from gbid.cli.options import CommonOptions, ExperimentPath, with_options


class FigureFormat(StrEnum):
    """Formats of figures."""

    PDF = "pdf"
    SVG = "svg"
    PNG = "png"


@with_options("results", "overwrite", "quiet", "verbose", "as_json", "debug")
def figures(
    experiment: ExperimentPath,
    options: CommonOptions,
    formats: Annotated[
        list[FigureFormat],
        typer.Option("--format", help="Format of the figures; give it again for a further one, which takes its time."),
    ] = [FigureFormat.PDF],  # noqa: B006  typer needs a list
) -> None:
    """Write the paper's figures (pdf) and tables (csv, Markdown), as far as the results allow."""
    from gbid.cli.printing import print_json
    from gbid.cli.stages import finish, looked_at, next_step, outcome_rows
    from gbid.report.named import paper

    loaded = options.load(experiment)
    with looked_at(loaded, options) as job:
        outcomes, left_out = paper().write_paper(job, list(dict.fromkeys(formats)))
    if options.as_json:
        absent = [{"item": item.item, "why": item.why} for item in left_out]
        print_json({"outcomes": outcome_rows(outcomes), "left_out": absent})
    else:
        for item in left_out:
            typer.echo(f"left out: {item.item}: {item.why}")
        items = {o.path.stem for o in outcomes if o.state != "failed"}
        typer.echo(f"{len(items)} figures and tables in {loaded.results / paper().FOLDER}")
    finish(outcomes, advice="" if options.quiet else next_step(loaded, "figures"))


@with_options("results", "overwrite", "quiet", "verbose", "as_json", "debug")
def report(
    experiment: ExperimentPath,
    options: CommonOptions,
    output: Annotated[
        Path | None,
        typer.Option("--output", metavar="FILE", help="The file; by default report.html in the results."),
    ] = None,
) -> None:
    """Write one self-contained HTML file with the existing results; nothing else is computed."""
    from gbid.cli.printing import print_json
    from gbid.cli.stages import finish, looked_at, next_step, outcome_rows
    from gbid.core.errors import UsageError
    from gbid.core.files import remove_stale_parts
    from gbid.report.write import write_report

    loaded = options.load(experiment)
    if not loaded.results.is_dir():
        raise UsageError(f"{loaded.results}: no results yet; run `gbid run {experiment}` first")
    if output is not None:
        remove_stale_parts(output.parent, f".{output.name}.*")
    with looked_at(loaded, options) as job:
        outcome = write_report(job, output)
    if options.as_json:
        print_json({"report": str(outcome.path), "outcomes": outcome_rows([outcome])})
    elif outcome.state != "failed":
        typer.echo(f"report: {outcome.path}")
    finish([outcome], advice="" if options.quiet else next_step(loaded, "report"))


@with_options("results", "overwrite", "quiet", "verbose", "as_json", "debug")
def reproduce(
    experiment: ExperimentPath,
    options: CommonOptions,
    output: Annotated[
        Path | None, typer.Option("--output", metavar="FILE", help="Also write the rows to this file, as JSON.")
    ] = None,
) -> None:
    """Compare our results with those of the paper, row by row: deviation, scatter in the paper, and reasons."""
    import json

    from gbid.cli.printing import print_json, print_tables
    from gbid.cli.stages import finish, looked_at, next_step
    from gbid.core.files import atomic_path
    from gbid.report.named import paper

    loaded = options.load(experiment)
    with looked_at(loaded, options) as job:
        outcomes, document = paper().write_reproduction(job)
    if output is not None:
        with atomic_path(output, overwrite=True) as part:
            part.write_text(json.dumps(document, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    if options.as_json:
        print_json(document)
    else:
        print_tables(*paper().reproduction_tables(document))
        typer.echo("\n".join(f"written: {outcome.path}" for outcome in outcomes))
    finish(outcomes, advice="" if options.quiet else next_step(loaded, "reproduce"))


@with_options("results", "debug")
def serve(
    experiment: ExperimentPath,
    options: CommonOptions,
    port: Annotated[int, typer.Option("--port", metavar="N", help="Port of this machine; 0 for any free one.")] = 8471,
    browser: Annotated[bool, typer.Option("--browser", help="Open the report in the browser.")] = False,
) -> None:
    """Show the results as pages on this machine; they follow a running campaign. Ctrl-C ends it."""
    import webbrowser

    from gbid.serve import open_server

    server = open_server(experiment, options.results, port)
    try:
        typer.echo(f"report: {server.address}")
        typer.echo(f"gain explorer: {server.address}explorer")
        if browser:
            webbrowser.open(server.address)
        server.serve_forever()
    finally:
        server.server_close()
