"""Printing: rich tables or one JSON document on standard output, messages on standard error."""

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
    """Print an error as one line of at most 500 characters; the middle of a longer error is cut out."""
    if len(text) > _LONGEST:
        text = f"{text[: _LONGEST // 2]} ... {text[-_LONGEST // 2 :]}"
    tell(f"gbid: {word}{text}")


def tell_line(text: str) -> None:
    """Print one line on standard error, marked as a message of gbid."""
    tell(f"gbid: {text}")


_PIPE_WIDTH = 140
_LONGEST = 470  # of the text of an error


def print_notes(notes: Iterable[str]) -> None:
    """Print notes on standard error, one per line."""
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
    """Print tables, each followed by an empty line; in a pipe no cell is cut."""
    from rich.console import Console

    from gbid.core.tables import terminal_table

    class ConsoleOrPipe(Console):
        def on_broken_pipe(self) -> None:
            """Continue without a reader (`| head`) to the exit code of the verb; rich would exit."""
            with suppress(SystemExit):
                super().on_broken_pipe()

    console = ConsoleOrPipe(highlight=False)
    if not console.is_terminal:
        console = ConsoleOrPipe(highlight=False, width=_PIPE_WIDTH)
    for table in tables:
        console.print(terminal_table(table), "")


def _plain(value: Any) -> Any:
    """Return numpy arrays and numbers as lists and numbers, and any mapping as a dict."""
    return value.tolist() if hasattr(value, "tolist") else dict(value)


_NOT_ASCII = re.compile(r"[^\0-\x7f]")
