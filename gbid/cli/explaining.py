"""`gbid explain`: what the code of a note means, and what to do."""

from __future__ import annotations

from typing import Annotated

import typer

from gbid.cli.guard import guarded
from gbid.cli.options import AsJson, Debug


def explain(
    code: Annotated[
        str, typer.Argument(metavar="[CODE]", help="Code of a note, as GB102; without it all are listed.")
    ] = "",
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Explain the code of a note, such as GB102: where it comes from and what to do."""
    with guarded(as_json, debug):
        from gbid.cli.printing import print_json, print_tables
        from gbid.notes.catalogue import explain as explanation_of
        from gbid.notes.catalogue import families
        from gbid.tables.table import Column, Table

        if code:
            found = explanation_of(code)
            if as_json:
                print_json(found._asdict())
            else:
                typer.echo(f"{found.code}: {found.title}\n\n{found.meaning}\n\nWhat to do: {found.remedy}")
            return
        if as_json:
            print_json({"notes": [entry._asdict() for group in families().values() for entry in group]})
            return
        columns = [Column("code"), Column("note", wrap=True)]
        print_tables(
            *(Table(about, columns, [[e.code, e.title] for e in group]) for about, group in families().items())
        )
