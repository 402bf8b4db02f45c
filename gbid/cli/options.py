"""Arguments and options that verbs share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

ExperimentPath = Annotated[Path, typer.Argument(metavar="EXPERIMENT", help="The experiment YAML.", show_default=False)]
Results = Annotated[
    Path | None,
    typer.Option("--results", metavar="DIR", help="Folder of the results, in place of the one in the YAML."),
]
Overwrite = Annotated[
    bool, typer.Option("--overwrite", help="Replace results that were made with other settings or data.")
]
AsJson = Annotated[bool, typer.Option("--json", help="One JSON document on standard output, in SI units.")]
Debug = Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")]
