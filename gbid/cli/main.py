"""The command `gbid`. Verbs import what they need when they are called, so that help comes at once."""

from __future__ import annotations

import sys
from typing import Annotated

import typer

from gbid._version import __version__
from gbid.cli.check import check
from gbid.cli.crossval import crossval
from gbid.cli.fit import fit
from gbid.cli.importing import import_data
from gbid.cli.new import new
from gbid.cli.rig import rig
from gbid.cli.run import run

app = typer.Typer(
    name="gbid",
    help="Grey-box identification of rotors on controllable gas bearings, from an experiment YAML.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"gbid {__version__}")
        raise typer.Exit


@app.callback()
def _gbid(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    pass


app.command("new")(new)
app.command("check")(check)
app.command("rig")(rig)
app.command("import")(import_data)
app.command("fit")(fit)
app.command("crossval")(crossval)
app.command("run")(run)


def main() -> None:
    """Run the command line; the exit codes are those of `gbid.errors`."""
    try:
        app(prog_name="gbid")
    except KeyboardInterrupt:  # outside of a verb: while the command line is read
        sys.exit(130)


if __name__ == "__main__":
    main()
