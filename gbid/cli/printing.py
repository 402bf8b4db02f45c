"""Data on standard output: rich tables for people, one JSON document for programs."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

if TYPE_CHECKING:
    from rich.console import RenderableType

_PIPE_WIDTH = 140


def print_json(document: Mapping[str, Any]) -> None:
    """Print one JSON document; numbers that are not finite become null."""
    typer.echo(json.dumps(_plain(document), indent=2, allow_nan=False))


def print_table(*tables: RenderableType) -> None:
    """Print tables; into a pipe with room enough that nothing is cut."""
    from rich.console import Console

    console = Console(highlight=False)
    if not console.is_terminal:
        console = Console(highlight=False, width=_PIPE_WIDTH)
    for table in tables:
        console.print(table)


def print_crossval(rows: Sequence[Mapping[str, Any]]) -> None:
    """Print a table for each fit that was cross-validated."""
    from gbid.report.tables import crossval_table

    for fit in dict.fromkeys(row["fit"] for row in rows):
        print_table(crossval_table(fit, [dict(row) for row in rows if row["fit"] == fit]), "")


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(entry) for entry in value]
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if hasattr(value, "tolist"):
        return _plain(value.tolist())
    return value
