"""`gbid import`: recordings of the import section; with --peek the channels of one file."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from gbid.cli.guard import guarded
from gbid.cli.options import AsJson, Debug, DryRun, Engine, Overwrite, Quiet, Results, Retry, Verbose, Workers
from gbid.cli.stage_verbs import OR_RUN


def import_recordings(
    experiment: Annotated[
        Path,
        typer.Argument(
            metavar="EXPERIMENT|FILE", help="The experiment YAML; with --peek the file.", show_default=False
        ),
    ],
    peek: Annotated[
        bool,
        typer.Option(
            "--peek",
            help="Show the channels of a measured file: names, units, rates, first samples, and how it is read.",
        ),
    ] = False,
    encoding: Annotated[
        str | None, typer.Option(help="With --peek: encoding of a text file.", show_default="found")
    ] = None,
    decimal: Annotated[str | None, typer.Option(help="With --peek: its decimal sign.", show_default="found")] = None,
    delimiter: Annotated[
        str | None, typer.Option(help="With --peek: the character between its cells.", show_default="found")
    ] = None,
    header_line: Annotated[
        int | None, typer.Option(help="With --peek: number of its line with the names.", show_default="found")
    ] = None,
    results: Results = None,
    overwrite: Overwrite = False,
    engine: Engine = "auto",
    workers: Workers = None,
    retry: Retry = False,
    dry_run: DryRun = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Read the recordings of the import section, or show the channels of a measured file."""
    with guarded(as_json, debug):
        if peek:
            from gbid.cli.printing import print_json, print_tables
            from gbid.recording.importers.peek import list_channels, read_layout
            from gbid.recording.importers.text.text_options import TextOptions
            from gbid.report.tables.recording_tables import channel_rows, channel_table, layout_words

            options = TextOptions(encoding, decimal, delimiter, header_line)
            rows, layout = channel_rows(list_channels(experiment, options)), read_layout(experiment, options)
            if as_json:
                print_json({"file": experiment, "layout": layout, "channels": rows})
            else:
                if layout:
                    typer.echo(f"read as text: {layout_words(layout)}")
                print_tables(channel_table(experiment.name, rows))
            return
        from gbid.cli.manner import Manner
        from gbid.cli.stages import run_stages

        run_stages(
            ("import",),
            experiment,
            results,
            Manner("import", as_json, quiet, verbose, dry_run),
            OR_RUN,
            overwrite=overwrite,
            engine=engine,
            workers=workers,
            retry=retry,
        )
