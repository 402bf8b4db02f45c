"""Arguments and options of several verbs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from gbid.cli.completion import complete_experiment

ExperimentPath = Annotated[
    Path,
    typer.Argument(
        metavar="EXPERIMENT", help="The experiment YAML.", show_default=False, autocompletion=complete_experiment
    ),
]
Results = Annotated[
    Path | None,
    typer.Option("--results", metavar="DIR", help="Folder of the results, instead of the one in the YAML."),
]
Overwrite = Annotated[
    bool, typer.Option("--overwrite", help="Replace results that were made with other settings or data.")
]
Engine = Annotated[
    str,
    typer.Option(
        "--engine",
        metavar="NAME",
        help="What runs the items: serial (this process), pool (processes), dask, or auto (a pool for many).",
    ),
]
Workers = Annotated[
    int | None, typer.Option("--workers", metavar="N", help="Number of processes; all processors when not given.")
]
Retry = Annotated[bool, typer.Option("--retry", help="Try failed items with the same settings and data again.")]
AsJson = Annotated[bool, typer.Option("--json", help="One JSON document on standard output, in SI units.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="No progress and no advice; errors are told.")]
Verbose = Annotated[bool, typer.Option("--verbose", "-v", help="A line for each item and each iteration.")]
DryRun = Annotated[bool, typer.Option("--dry-run", help="Say what would be done, and do nothing.")]
Debug = Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")]
