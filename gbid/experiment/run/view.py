"""View of a stage: its JSON document for programs, and tables of it for people."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from gbid.experiment.run.job import Job
from gbid.experiment.run.outcome import Outcome
from gbid.tables.table import Column, Table

Document = Mapping[str, Any]


@dataclass(frozen=True)
class View:
    """JSON document and tables of a stage.

    Attributes
    ----------
    document : callable
        Function that returns the entries of the JSON document from the outcomes of a run; it skips other stages.
    tables : callable
        Function that returns tables of these entries.
    """

    document: Callable[[Job, Sequence[Outcome]], Document]
    tables: Callable[[Document], Iterable[Table]]


def outcomes_view(stage: str, key: str) -> View:
    """Return the view of a stage without its own: a list of its outcomes, under a key of the JSON document."""
    columns = [Column("item"), Column("state"), Column("text", wrap=True)]

    def document(_: Job, outcomes: Sequence[Outcome]) -> Document:
        own = [o for o in outcomes if o.stage == stage]
        return {key: [{"item": o.item, "state": o.state, "text": o.text, "path": str(o.path)} for o in own]}

    def tables(document: Document) -> list[Table]:
        rows = [[row[column.name] for column in columns] for row in document[key]]
        return [Table(stage, columns, rows)] if rows else []

    return View(document, tables)
