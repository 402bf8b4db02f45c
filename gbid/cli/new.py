"""`gbid new`: an experiment to start from."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from gbid.cli.guard import guarded
from gbid.cli.options import Debug


class Template(StrEnum):
    """What to start from."""

    quickstart = "quickstart"
    own_recordings = "own-recordings"


def new(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="A new or empty folder.", show_default=False)],
    template: Annotated[
        Template, typer.Option("--template", help="The virtual rig, or recordings and a structure of your own.")
    ] = Template.quickstart,
    debug: Debug = False,
) -> None:
    """Write a commented experiment that runs as it is."""
    with guarded(debug=debug):
        from gbid.cli.templates import write_template

        for path in write_template(template.value, folder):
            typer.echo(str(path))
        typer.echo(f"next: gbid run {folder / 'experiment.yaml'}", err=True)
