"""Files of the figures and tables of the paper, and of the comparison with it, from the results."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from gbid.errors import DataError, NoSpaceError, UsageError
from gbid.experiment.keys import content_key, stored_key
from gbid.experiment.run.job import Job
from gbid.experiment.run.outcome import Outcome
from gbid.experiment.run.perform import produce
from gbid.report.figures.named import NamedFigure, named_figures
from gbid.report.figures.save import save_figure
from gbid.report.paper.paper_tables import TABLES
from gbid.report.paper.reproduction import ReproductionRow, counts, reproduction
from gbid.report.paper.reproduction_tables import reproduction_markdown
from gbid.report.reader import Results
from gbid.tables.csv import csv_text
from gbid.tables.markdown import markdown_table
from gbid.tables.table import Table, plain_table

FOLDER = "figures"
KINDS = ("pdf", "svg", "png")
"""Formats of figures."""
PAST = ("designs", "designs_impacts")
"""Tables without counterpart in the paper."""
REPRODUCTION = "reproduction"
_SOURCES = ("static", "fits", "crossval", "nominal", "lpv", "impacts", "controller")


@dataclass(frozen=True)
class LeftOut:
    """Figure or table that could not be made.

    Attributes
    ----------
    item, why : str
        Its name, and the reason.
    """

    item: str
    why: str


def write_paper(job: Job, kinds: Sequence[str] = KINDS[:1]) -> tuple[list[Outcome], list[LeftOut]]:
    """Write ``figures/fig05_static_map.pdf`` and so on, ``figures/table2_actuators.csv``, ``.md``.

    Parameters
    ----------
    job : Job
        The job.
    kinds : sequence of str
        Formats of the figures: pdf, svg, png. Each takes its time.

    Returns
    -------
    outcomes : list of Outcome
        Outcomes of the files.
    left_out : list of LeftOut
        Figures and tables that the results do not allow, with the reason.

    Raises
    ------
    UsageError
        When a file made from other results exists and must not be replaced.
    """
    results, sources = Results(job), _sources(job)
    outcomes: list[Outcome] = []
    left_out: list[LeftOut] = []
    for figure in named_figures().values():
        _collect(figure.name, partial(_figure, job, results, figure, sources, kinds), outcomes, left_out)
    for name, make in TABLES.items():
        _collect(name, partial(_table, job, results, name, make, sources), outcomes, left_out)
    return outcomes, left_out


def write_reproduction(job: Job) -> tuple[list[Outcome], dict[str, Any]]:
    """Write ``reproduction.json``, ``.csv`` and ``.md``.

    Returns
    -------
    list of Outcome
    dict
        From `reproduction_document`.

    Raises
    ------
    DataError
        When the machine is not the paper's.
    """
    results, sources = Results(job), _sources(job)
    rows = reproduction(results)
    document = reproduction_document(rows, past_the_paper(results))
    writers: dict[str, Callable[[], str]] = {
        ".json": lambda: json.dumps(document, indent=1, allow_nan=False) + "\n",
        ".csv": lambda: csv_text(_as_table(rows)),
        ".md": lambda: reproduction_markdown(document),
    }
    outcomes = []
    for ending, write in writers.items():
        path = job.experiment.results / f"{REPRODUCTION}{ending}"
        settings = {"kind": ending, "document": document}
        key = content_key(REPRODUCTION, settings, sources)
        text = partial(_with_key, write, ending, key)
        outcomes.append(produce(job, REPRODUCTION, f"{REPRODUCTION}{ending}", path, key, partial(_write_text, text)))
    return outcomes, document


def past_the_paper(results: Results) -> list[Table]:
    """Return tables without counterpart in the paper, if the results allow them: tuned designs and their impacts."""
    found = []
    for name in PAST:
        with suppress(DataError):
            found.append(TABLES[name](results))
    return found


def reproduction_document(rows: list[ReproductionRow], past: Sequence[Table] = ()) -> dict[str, Any]:
    """Return all rows as plain values, the number of rows by verdict, and tables without counterpart in the paper."""
    return {
        "counts": dict(counts(rows)),
        "rows": [row.document() for row in rows],
        "past_the_paper": [table.document() for table in past],
    }


def _as_table(rows: list[ReproductionRow]) -> Table:
    columns = ("where", "quantity", "unit", "paper", "ours", "ours_std", "deviation", "scatter", "verdict", "why")
    documents = [row.document() for row in rows]
    return plain_table(columns, [[document[name] for name in columns] for document in documents])


def _collect(name: str, make: Callable[[], list[Outcome]], outcomes: list[Outcome], left_out: list[LeftOut]) -> None:
    """Make one item; when its results do not allow it, note the reason."""
    try:
        made = make()
    except NoSpaceError:
        raise
    except DataError as error:
        left_out.append(LeftOut(name, str(error)))
        return
    outcomes += made


def _figure(job: Job, results: Results, named: NamedFigure, sources: list[str], kinds: Sequence[str]) -> list[Outcome]:
    name = named.name
    paths = {kind: job.path(FOLDER, name, f".{kind}") for kind in kinds}
    keys = {kind: content_key("paper figure", {"name": name, "kind": kind}, sources) for kind in kinds}
    stale = [kind for kind in kinds if stored_key(paths[kind]) != keys[kind]]
    figure = _drawn(named, results) if stale else None

    def write(kind: str, part: Path) -> None:
        assert figure is not None
        save_figure(figure, part, kind=kind, note=f"content_key: {keys[kind]}")

    return [produce(job, "figure", f"{name}.{kind}", paths[kind], keys[kind], partial(write, kind)) for kind in kinds]


def _table(
    job: Job, results: Results, name: str, make: Callable[[Results], Table], sources: list[str]
) -> list[Outcome]:
    table = make(results)
    outcomes = []
    for ending, text in ((".csv", csv_text(table)), (".md", markdown_table(table))):
        key = content_key("paper table", {"name": name, "kind": ending, "text": text}, sources)
        write = partial(_write_text, partial(_with_key, partial(str, text), ending, key))
        outcomes.append(produce(job, "table", f"{name}{ending}", job.path(FOLDER, name, ending), key, write))
    return outcomes


def _drawn(named: NamedFigure, results: Results) -> Figure:
    """Return a figure; results that do not allow it count as bad data, for any reason."""
    try:
        return named.make(results)
    except UsageError as error:
        raise DataError(str(error)) from None


def _sources(job: Job) -> list[str]:
    """Return the content keys of all results behind figures and tables."""
    folder = job.experiment.results
    files = sorted(
        path for name in _SOURCES for path in (folder / name).rglob("*") if path.suffix in (".h5", ".yaml", ".csv")
    )
    spec = job.experiment.spec
    model = spec.rig.model if spec.rig is not None else ""
    return [model, *(f"{path.relative_to(folder)} {stored_key(path)}" for path in files)]


def _with_key(text: Callable[[], str], ending: str, key: str) -> str:
    """Add the content key as a comment, in JSON as an entry."""
    if ending == ".json":
        return text().replace("{\n", f'{{\n "made_from": "content_key: {key}",\n', 1)
    comment = f"<!-- content_key: {key} -->\n" if ending == ".md" else f"# content_key: {key}\n"
    return comment + text()


def _write_text(text: Callable[[], str], part: Path) -> None:
    part.write_text(text(), encoding="utf-8")
