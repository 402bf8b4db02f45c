"""`gbid export`: models for other programs."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from gbid.cli.completion import complete_source
from gbid.cli.guard import guarded
from gbid.cli.options import AsJson, Debug, Results


class ExportKind(StrEnum):
    """Format of the files."""

    mat = "mat"
    csv = "csv"
    yaml = "yaml"


def export(
    source: Annotated[
        str,
        typer.Argument(
            metavar="EXPERIMENT|MODEL",
            help="An experiment YAML (its fits and LPV models), a model YAML or name, or a fit in .h5.",
            show_default=False,
            autocompletion=complete_source,
        ),
    ],
    to: Annotated[
        ExportKind,
        typer.Option("--to", help="MATLAB data with a function for ss and idss; tables; plain YAML."),
    ] = ExportKind.mat,
    at: Annotated[
        tuple[float, float] | None,
        typer.Option("--at", metavar="BAR RPM", help="Of a model: the linear models at this operating point."),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="DIR", help="Folder; `export` in the results, or here for a model."),
    ] = None,
    results: Results = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace existing files.")] = False,
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Write models for MATLAB, spreadsheets or as plain YAML."""
    with guarded(as_json, debug):
        from gbid.cli.exportable import find_exportable, write_files
        from gbid.cli.printing import print_json

        found = find_exportable(source, at, results)
        folder = output or found.folder
        files = [str(p) for name, what in found.items.items() for p in write_files(what, name, to, folder, overwrite)]
        if as_json:
            print_json({"files": files, "left_out": list(found.left_out)})
        else:
            typer.echo("\n".join(files))
        for text in found.left_out:
            typer.echo(f"gbid: warning: left out: {text}", err=True)
