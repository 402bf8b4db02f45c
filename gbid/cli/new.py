"""`gbid new`: a new experiment from a template."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from gbid.cli.guard import guarded
from gbid.cli.options import Debug


class Template(StrEnum):
    """Templates of experiments."""

    quickstart = "quickstart"
    own_recordings = "own-recordings"


ABOUT = {
    Template.quickstart: "the virtual rig at one operating point: recordings, prefilter, fits, validation, figures",
    Template.own_recordings: "example data in csv and a structure in Python, to be replaced by your own",
}
"""Contents of each template."""


def _print_templates(wanted: bool) -> None:
    if wanted:
        for template, about in ABOUT.items():
            typer.echo(f"{template.value:16}{about}")
        raise typer.Exit


def new(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="A new or empty folder.", show_default=False)],
    template: Annotated[
        Template, typer.Option("--template", help="Template; --list shows what each contains.")
    ] = Template.quickstart,
    _list: Annotated[
        bool, typer.Option("--list", callback=_print_templates, is_eager=True, help="List the templates and exit.")
    ] = False,
    debug: Debug = False,
) -> None:
    """Write a commented experiment that runs as it is."""
    with guarded(debug=debug):
        from gbid.cli.templates import write_template

        for path in write_template(template.value, folder):
            typer.echo(str(path))
        experiment = folder / "experiment.yaml"
        for line in (
            f"next: gbid run {experiment}",
            f"then: change {experiment} and check it with gbid check {experiment}",
        ):
            typer.echo(line, err=True)
