"""`gbid import`: recordings of the import section; with --peek the channels of one file."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from gbid.cli.guard import guarded
from gbid.cli.options import AsJson, Debug, Engine, Overwrite, Results, Retry, Workers
from gbid.cli.stage_verbs import OR_RUN


def import_recordings(
    experiment: Annotated[
        Path,
        typer.Argument(
            metavar="EXPERIMENT|FILE", help="The experiment YAML; with --peek the file.", show_default=False
        ),
    ],
    peek: Annotated[
        bool, typer.Option("--peek", help="Show the channels of a measured file: names, samples, units, rates.")
    ] = False,
    results: Results = None,
    overwrite: Overwrite = False,
    engine: Engine = "auto",
    workers: Workers = None,
    retry: Retry = False,
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Read the recordings of the import section, or show the channels of a measured file."""
    with guarded(as_json, debug):
        if peek:
            from gbid.cli.printing import print_json, print_tables
            from gbid.recording.importers.peek import list_channels
            from gbid.report.tables.recording_tables import channel_rows, channel_table

            rows = channel_rows(list_channels(experiment))
            if as_json:
                print_json({"file": experiment, "channels": rows})
            else:
                print_tables(channel_table(experiment.name, rows))
            return
        from gbid.cli.stages import run_stages

        run_stages(
            ("import",),
            experiment,
            results,
            as_json,
            OR_RUN,
            overwrite=overwrite,
            engine=engine,
            workers=workers,
            retry=retry,
        )
