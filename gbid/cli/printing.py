"""Printing on standard output: rich tables for people, one JSON document for programs."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Iterable, Mapping
from contextlib import suppress
from typing import TYPE_CHECKING, Any

import typer

from gbid.core.names import printable

if TYPE_CHECKING:
    from gbid.core.tables import Table


# ---- Lines for people on standard error; what a terminal would act on is shown as its code.


def tell(text: str) -> None:
    """Print lines on standard error.

    Parameters
    ----------
    text : str
        One or several lines.
    """
    for line in text.split("\n"):
        print(printable(line), file=sys.stderr, flush=True)  # noqa: T201


def tell_error(text: str, word: str = "error: ") -> None:
    """Print an error of gbid as one line of at most 500 characters; of a longer one the middle is left out."""
    if len(text) > _LONGEST:
        text = f"{text[: _LONGEST // 2]} ... {text[-_LONGEST // 2 :]}"
    tell(f"gbid: {word}{text}")


def tell_line(text: str) -> None:
    """Print a line of gbid on standard error."""
    tell(f"gbid: {text}")


_PIPE_WIDTH = 140
_LONGEST = 470  # of the text of an error


def print_notes(notes: Iterable[str]) -> None:
    """Print notes on standard error, one a line."""
    for text in notes:
        tell(f"gbid: note: {text}")


def print_json(document: Mapping[str, Any]) -> None:
    """Print one JSON document; numbers that are not finite become null."""
    from pydantic_core import to_json, to_jsonable_python

    try:  # a tenth of the time of `json.dumps`, which indents in Python
        text = to_json(document, indent=2, inf_nan_mode="null", fallback=_plain).decode()
    except ValueError:  # half of a letter, as of the name of a file
        text = json.dumps(to_jsonable_python(document, inf_nan_mode="null", fallback=_plain), indent=2)
    typer.echo(_NOT_ASCII.sub(lambda letter: json.dumps(letter[0])[1:-1], text))


def print_tables(*tables: Table) -> None:
    """Print tables, an empty line below each; into a pipe with a width at which no cell is cut."""
    from rich.console import Console

    from gbid.core.tables import terminal_table

    class ConsoleOrPipe(Console):
        def on_broken_pipe(self) -> None:
            """Go on without a reader (`| head`), to the exit code of the verb; rich would end the program."""
            with suppress(SystemExit):
                super().on_broken_pipe()

    console = ConsoleOrPipe(highlight=False)
    if not console.is_terminal:
        console = ConsoleOrPipe(highlight=False, width=_PIPE_WIDTH)
    for table in tables:
        console.print(terminal_table(table), "")


def _plain(value: Any) -> Any:
    """Return arrays and numbers of numpy as lists and numbers, and mappings of other kinds as dicts."""
    return value.tolist() if hasattr(value, "tolist") else dict(value)


_NOT_ASCII = re.compile(r"[^\0-\x7f]")
