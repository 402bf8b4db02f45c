"""`gbid new`: a new experiment from a template, or from a folder of measured files."""

from __future__ import annotations

import sys
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from gbid.cli.guard import guarded
from gbid.cli.options import Debug

if TYPE_CHECKING:
    from gbid.experiment.draft.draft_options import DraftOptions
    from gbid.experiment.draft.drafting import Draft


class Template(StrEnum):
    """Templates of experiments."""

    quickstart = "quickstart"
    gas_bearing = "gas-bearing"
    one_speed = "one-speed"
    one_point = "one-point"
    own_recordings = "own-recordings"
    magnetic_bearing = "magnetic-bearing"
    theisen2016 = "theisen2016"


ABOUT = {
    Template.quickstart: "the virtual rig at one operating point: recordings, prefilter, fits, validation, figures",
    Template.gas_bearing: "a gas bearing at six operating points: fits, surfaces over pressure and speed, a controller",
    Template.one_speed: "a gas bearing at one speed: surfaces over the pressure alone, a controller",
    Template.one_point: "a gas bearing at one operating point: a constant model, a controller",
    Template.own_recordings: "example data in csv and a structure in Python, to be replaced by your own",
    Template.magnetic_bearing: "a magnetic bearing in its loop: example data in csv, a structure in Python",
    Template.theisen2016: "the campaign of the paper on the virtual rig: 86 recordings at 15 operating points",
}
"""Contents of each template."""


def _print_templates(wanted: bool) -> None:
    if wanted:
        for template, about in ABOUT.items():
            typer.echo(f"{template.value:18}{about}")
        raise typer.Exit


def new(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="A new or empty folder.", show_default=False)],
    template: Annotated[
        Template, typer.Option("--template", help="Template; --list shows what each contains.")
    ] = Template.quickstart,
    measured: Annotated[
        Path | None,
        typer.Option(
            "--from", metavar="FOLDER", help="Draft an experiment for a gas bearing from the files of a folder."
        ),
    ] = None,
    signal: Annotated[
        list[str] | None,
        typer.Option(
            "--signal", metavar="NAME=X,Y", help="With --from: columns of r, u, p or phi.", show_default="found"
        ),
    ] = None,
    time: Annotated[
        str | None,
        typer.Option(metavar="COLUMN", help="With --from: column of the sample times.", show_default="found"),
    ] = None,
    sample_time: Annotated[
        float | None, typer.Option(metavar="S", help="With --from: time between samples.", show_default="found")
    ] = None,
    unit: Annotated[
        str | None, typer.Option(help="With --from: unit of positions whose file states none.", show_default="found")
    ] = None,
    pattern: Annotated[
        str | None, typer.Option(help="With --from: pattern of the file names.", show_default="found")
    ] = None,
    from_s: Annotated[
        float | None, typer.Option(metavar="S", help="With --from: begin of the part to use.", show_default="found")
    ] = None,
    to_s: Annotated[
        float | None, typer.Option(metavar="S", help="With --from: end of the part to use.", show_default="found")
    ] = None,
    pressure: Annotated[
        float | None, typer.Option(metavar="BAR", help="With --from: pressure of all files.", show_default="found")
    ] = None,
    speed: Annotated[
        float | None, typer.Option(metavar="RPM", help="With --from: speed of all files.", show_default="found")
    ] = None,
    controller: Annotated[str, typer.Option(help="With --from: structure of the controller.")] = "P",
    _list: Annotated[
        bool, typer.Option("--list", callback=_print_templates, is_eager=True, help="List the templates and exit.")
    ] = False,
    debug: Debug = False,
) -> None:
    """Write a commented experiment: a template that runs as it is, or one for the files of a folder."""
    with guarded(debug=debug):
        from gbid.cli.templates import refuse_used, write_draft, write_template

        notes: tuple[str, ...] = ()
        if measured is None:
            written = write_template(template.value, folder)
        else:
            from gbid.experiment.draft.draft_options import DraftOptions

            refuse_used(folder)
            columns = dict(_signal(text) for text in signal or ())
            options = DraftOptions(
                measured, columns, time, sample_time, unit, pattern, from_s, to_s, pressure, speed, controller
            )
            draft = _drafted(options, folder)
            written, notes = write_draft(draft.text, folder), draft.notes
        for path in written:
            typer.echo(str(path))
        experiment = folder / "experiment.yaml"
        first = "check" if measured else "run"
        then = "run" if measured else "check"
        for line in (
            *(f"note: {text}" for text in notes),
            f"next: gbid {first} {experiment}",
            f"then: change {experiment} and {then} it with gbid {then} {experiment}",
        ):
            typer.echo(line, err=True)


def _signal(text: str) -> tuple[str, tuple[str, ...]]:
    """Return name and columns of an option like ``p=Weg x,Weg y``."""
    from gbid.errors import UsageError

    name, _, columns = text.partition("=")
    counts = {"r": 2, "u": 2, "p": 2, "phi": 1}
    found = tuple(column.strip() for column in columns.split(",") if column.strip())
    if len(found) != counts.get(name.strip()):
        raise UsageError(f"--signal: expected r, u or p with two columns, or phi with one, as p=X,Y; found {text!r}")
    return name.strip(), found


def _drafted(options: DraftOptions, target: Path) -> Draft:
    """Return the draft; ask for what the files do not say, where there is someone to answer."""
    from gbid.experiment.draft.draft_options import ASKED, UnansweredError
    from gbid.experiment.draft.drafting import draft_experiment

    while True:
        try:
            return draft_experiment(options, target)
        except UnansweredError as error:
            if not sys.stdin.isatty():
                raise
            typer.echo(str(error), err=True)
            options = options.answered(error.option, typer.prompt(ASKED[error.option], err=True))
