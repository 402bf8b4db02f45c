"""Verbs that run stages or show pages: `gbid run`, `fit`, `batch`, `report`, `paper`, `open`, `serve`, and stages."""

from __future__ import annotations

from collections.abc import Callable
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer

from gbid.cli.options import STAGE_VERBS, CommonOptions, ExperimentPath, MeasuredFolder, drafted_folder, with_options


def stage_verb(name: str) -> Callable[..., None]:
    """Return the verb that runs a stage, as `gbid run --only` does."""

    def verb(experiment: ExperimentPath, options: CommonOptions) -> None:
        from gbid.cli.stages import run_stages

        run_stages(name, experiment, options)

    verb.__doc__ = STAGE_VERBS[name].help
    return with_options()(verb)


@with_options()
def fit(
    experiment: ExperimentPath,
    options: CommonOptions,
    only: Annotated[str | None, typer.Option("--only", metavar="FIT", help="Run this one of the fits.")] = None,
    one: Annotated[
        list[str] | None,
        typer.Option("--one", metavar="ITEM", help="Make one file, as FIT/RECORDING, with what it needs; for jobs."),
    ] = None,
    items: Annotated[bool, typer.Option("--list", help="Run nothing; list the items for --one, with files.")] = False,
) -> None:
    """Prefilter the recordings, if the YAML says so, and run the fits."""
    from gbid.cli.stages import list_items, run_one, run_stages
    from gbid.core.errors import UsageError

    if (only is not None) + (one is not None) + items > 1:
        raise UsageError("--only, --one and --list exclude each other; give one of them")
    if one is not None and len(one) > 1:
        raise UsageError(f"--one is one fit, here are {len(one)}; use one command for each fit")
    if one is not None:
        run_one(experiment, options, one[0])
    elif items:
        list_items(experiment, options)
    else:
        run_stages("fit", experiment, options, only=only)


@with_options()
def batch(
    experiment: ExperimentPath,
    options: CommonOptions,
    scheduler: Annotated[
        str | None, typer.Option("--scheduler", metavar="tcp://HOST:PORT", help="Run on this Dask scheduler.")
    ] = None,
    shard: Annotated[
        str | None, typer.Option("--shard", metavar="I/N", help="Run part I of N only, as a job of an array.")
    ] = None,
    collect: Annotated[bool, typer.Option("--collect", help="Run nothing; make the table of existing fits.")] = False,
) -> None:
    """Make, prefilter and fit all recordings on all processors; run it again to go on where it stopped."""
    from gbid.cli.stages import run_batch

    run_batch(experiment, options, scheduler, shard, collect)


def _complete_stage(incomplete: str) -> list[str]:
    return [name for name in STAGE_VERBS if name.startswith(incomplete)]


def _stage_option(name: str, help: str) -> Any:
    return typer.Option(name, metavar="STAGE", help=help, autocompletion=_complete_stage)


@with_options()
def run(
    experiment: ExperimentPath,
    options: CommonOptions,
    only: Annotated[
        str | None, _stage_option("--only", f"Run this stage alone, on what is there: {', '.join(STAGE_VERBS)}.")
    ] = None,
    until: Annotated[
        str | None, _stage_option("--until", "Run the stages up to this one, and draw no figures and no report.")
    ] = None,
) -> None:
    """Run all stages that an experiment names, from recordings to the report; current results are kept."""
    from gbid.cli.stages import run_all, run_stages
    from gbid.core.errors import UsageError

    if only is not None and until is not None:
        raise UsageError("--only and --until contradict each other; give one of them")
    stage = until or only
    if stage is None:
        run_all(experiment, options)
    else:
        run_stages(stage, experiment, options, before=until is not None)


class FigureFormat(StrEnum):
    """File formats of figures."""

    PDF = "pdf"
    SVG = "svg"
    PNG = "png"


@with_options("results", "overwrite", "quiet", "verbose", "as_json", "debug")
def report(
    experiment: ExperimentPath,
    options: CommonOptions,
    output: Annotated[
        Path | None,
        typer.Option("--output", metavar="FILE", help="The file; by default report.html in the results."),
    ] = None,
    curves: Annotated[
        bool, typer.Option("--curves", help="Also write the curves of all fits, in a folder beside the page.")
    ] = False,
) -> None:
    """Write one self-contained HTML file with the existing results; nothing else is computed."""
    from gbid.cli.progress import reporting
    from gbid.cli.stages import conclude
    from gbid.core.errors import UsageError
    from gbid.core.files import refuse_links, remove_stale_parts
    from gbid.core.index import load_index
    from gbid.experiment.run import Job
    from gbid.report.write import write_curves, write_report

    loaded = options.load(experiment)
    if not loaded.results.is_dir():
        raise UsageError(f"{loaded.results}: no results yet; run `gbid run {experiment}` first")
    refuse_links(loaded.results)
    if output is not None:
        remove_stale_parts(output.parent, f".{output.name}.*")
    remove_stale_parts(loaded.results)
    load_index(loaded.results)
    with reporting(options.quiet, options.verbose) as reporter:  # without a lock
        job = Job(loaded, options.overwrite, reporter)
        outcome = write_report(job, output)
        beside = write_curves(job, outcome.path) if curves else []
    lines = [] if outcome.state == "failed" else [f"report: {outcome.path}"]
    conclude("report", loaded, options, [outcome, *beside], {"report": str(outcome.path)}, lines=lines)


class PaperPart(StrEnum):
    """Choice of the output of `gbid paper`."""

    FIGURES = "figures"
    COMPARISON = "comparison"


@with_options("results", "overwrite", "quiet", "verbose", "as_json", "debug")
def paper(
    experiment: ExperimentPath,
    options: CommonOptions,
    only: Annotated[PaperPart | None, typer.Option("--only", help="Write this alone.")] = None,
    formats: Annotated[
        list[FigureFormat],
        typer.Option("--format", help="Format of the figures; give it again for a further one, which takes its time."),
    ] = [FigureFormat.PDF],  # noqa: B006  typer needs a list
    output: Annotated[
        Path | None, typer.Option("--output", metavar="FILE", help="Also write the comparison to this file, as JSON.")
    ] = None,
) -> None:
    """Write the paper's figures and tables, and compare our results with its numbers, row by row with reasons."""
    import json

    from gbid.cli.stages import conclude, opened
    from gbid.core.files import atomic_path
    from gbid.report.named import paper as paper_files

    loaded, files, document = options.load(experiment), paper_files(), {}
    outcomes, lines, tables = [], [], []
    with opened(loaded, options) as job:
        if only is not PaperPart.COMPARISON:
            outcomes, left_out = files.write_paper(job, list(dict.fromkeys(formats)))
            drawn = {outcome.path.stem for outcome in outcomes if outcome.state != "failed"}
            document["left_out"] = [{"item": item.item, "why": item.why} for item in left_out]
            lines += [f"left out: {item.item}: {item.why}" for item in left_out]
            lines.append(f"{len(drawn)} figures and tables in {loaded.results / files.FOLDER}")
        if only is not PaperPart.FIGURES:
            written, compared = files.write_reproduction(job)
            document, outcomes = {**compared, **document}, [*outcomes, *written]
            tables = files.reproduction_tables(compared)
            lines += [f"written: {outcome.path}" for outcome in written]
            if output is not None:
                with atomic_path(output, overwrite=True) as part:
                    part.write_text(json.dumps(compared, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    conclude("paper", loaded, options, outcomes, document, tables, lines)


_PORT = typer.Option("--port", metavar="N", help="Port of this machine; 0 for any free one.")


@with_options("debug")
def open_folder(
    measured: MeasuredFolder,
    options: CommonOptions,  # noqa: ARG001
    folder: Annotated[
        Path | None,
        typer.Argument(metavar="[DIR]", help="Folder of the experiment.", show_default="FOLDER-experiment, here"),
    ] = None,
    port: Annotated[int, _PORT] = 8471,
    browser: Annotated[bool, typer.Option("--browser", help="Open the page in the browser.")] = False,
) -> None:
    """Show a folder of recordings as a page of this machine, and make an experiment of it. Ctrl-C ends it."""
    import webbrowser

    from gbid.cli.printing import tell_line
    from gbid.serve import open_bench

    server, bench = open_bench(measured, drafted_folder(measured, folder), port, tell_line)
    with server:
        typer.echo(f"open: {server.address}")
        if browser:
            webbrowser.open(server.address)
        try:
            server.serve_forever()
        finally:
            bench.close()


@with_options("results", "debug")
def serve(
    experiment: ExperimentPath,
    options: CommonOptions,
    port: Annotated[int, _PORT] = 8471,
    browser: Annotated[bool, typer.Option("--browser", help="Open the report in the browser.")] = False,
) -> None:
    """Show the results as pages on this machine; they follow a running campaign. Ctrl-C ends it."""
    import webbrowser

    from gbid.cli.printing import tell_line
    from gbid.serve import open_server

    with open_server(experiment, options.results, port, tell_line) as server:
        typer.echo(f"report: {server.address}\ngain explorer: {server.address}explorer")
        if browser:
            webbrowser.open(server.address)
        server.serve_forever()
