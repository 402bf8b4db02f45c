"""`gbid export`: models and controllers for other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from gbid.cli.completion import complete_source
from gbid.cli.guard import guarded
from gbid.cli.options import AsJson, Debug, Results
from gbid.exporters.targets import export_target, target_names


def _complete_target(incomplete: str) -> list[str]:
    return [name for name in target_names() if name.startswith(incomplete)]


def export(
    source: Annotated[
        str,
        typer.Argument(
            metavar="EXPERIMENT|MODEL|CONTROLLER",
            help="An experiment YAML (its fits, LPV models and controllers), a model YAML or name, a controller YAML, "
            "or a fit in .h5.",
            show_default=False,
            autocompletion=complete_source,
        ),
    ],
    to: Annotated[
        str,
        typer.Option(
            "--to",
            metavar="TARGET",
            help=f"What to write: {', '.join(target_names())}.",
            autocompletion=_complete_target,
        ),
    ] = "matlab",
    at: Annotated[
        tuple[float, float] | None,
        typer.Option("--at", metavar="BAR RPM", help="Of LPV models and controllers: those at this operating point."),
    ] = None,
    number: Annotated[
        Literal["double", "float"] | None,
        typer.Option("--number", help="Type of the numbers in C source; else that of the section target, or double."),
    ] = None,
    measure: Annotated[
        bool, typer.Option("--measure", help="Run C source on an emulated Cortex-M4F and write its instructions down.")
    ] = False,
    mass: Annotated[
        float | None, typer.Option("--mass", metavar="KG", help="Modal mass of the rotor; needed for ross.")
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="DIR", help="Folder; `export` in the results, or here for a file."),
    ] = None,
    results: Results = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace existing files.")] = False,
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Write models and controllers for other programs."""
    with guarded(as_json, debug):
        from gbid.cli.printing import print_json, print_notes
        from gbid.cli.telling import tell
        from gbid.exporters.export_target import ExportRequest
        from gbid.exporters.finding import find_exports
        from gbid.exporters.writing import write_exports

        export_target(to)
        found = find_exports(source, at, results)
        request = ExportRequest(output or found.folder, overwrite, at, number, measure, mass)
        files = [str(path) for path in write_exports(found, to, request)]
        if as_json:
            print_json({"files": files, "left_out": list(found.left_out), "notes": list(found.notes)})
        else:
            typer.echo("\n".join(files))
        print_notes(found.notes)
        for text in found.left_out:
            tell(f"gbid: warning: left out: {text}")
