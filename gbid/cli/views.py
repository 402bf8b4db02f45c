"""Views of the stages that come with gbid; their tables are those of the report."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from gbid.cli import documents as of
from gbid.experiment.run.job import Job
from gbid.experiment.run.outcome import Outcome
from gbid.experiment.run.stage import Stage
from gbid.experiment.run.view import Document, View, outcomes_view
from gbid.experiment.stages.cycle.stage import made_rows
from gbid.experiment.stages.loop.cost import made_costs
from gbid.report.tables.fit_tables import fit_tables
from gbid.report.tables.impact_tables import impact_tables
from gbid.report.tables.loop_tables import cycle_documents, cycle_summary, loop_documents, loop_tables
from gbid.report.tables.lpv_tables import lpv_table
from gbid.report.tables.recording_tables import prefilter_table, recording_table
from gbid.report.tables.static_tables import static_table
from gbid.report.tables.tuning_tables import tuning_tables
from gbid.report.tables.validation_tables import crossval_table, nominal_table, validation_table
from gbid.tables.table import Table

_ROWS = 60  # of a cross-validation; more are in its CSV file only


def view_of(stage: Stage) -> View:
    """Return the view of a stage; one that has none shows its outcomes."""
    return stage.view or VIEWS.get(stage.name) or outcomes_view(stage.name, stage.section)


def _recordings(job: Job, outcomes: Sequence[Outcome]) -> Document:
    return {"recordings": of.recording_documents(job.experiment, outcomes)}


def _fit_tables(document: Document) -> list[Table]:
    return [table for fit in document["fits"] for table in fit_tables(f"{fit['fit']}, {fit['model']}", fit)]


def _validation_tables(document: Document) -> Iterable[Table]:
    """Pairs of each fit, unless they are many, and their summary."""
    for summary in document["crossval_summary"]:
        own = [row for row in document["crossval"] if row["fit"] == summary["fit"]]
        if len(own) <= _ROWS:
            yield crossval_table(summary["fit"], own)
        yield validation_table(summary)


def _one(key: str, table: Callable[[Any], Table]) -> Callable[[Document], list[Table]]:
    """Give the table of an entry, none when it is empty."""
    return lambda document: [table(document[key])] if document[key] else []


_OF_RECORDINGS = View(_recordings, _one("recordings", recording_table))

VIEWS: Mapping[str, View] = {
    "rig": _OF_RECORDINGS,
    "import": _OF_RECORDINGS,
    "prefilter": View(
        lambda _, outcomes: {"prefilter": of.prefilter_documents(outcomes)}, _one("prefilter", prefilter_table)
    ),
    "fit": View(lambda job, outcomes: {"fits": of.fit_documents(job, outcomes)}, _fit_tables),
    "loop": View(lambda *_: {}, lambda _: []),  # its designs are shown with the others
    "loop cost": View(
        lambda job, _: {"loops": loop_documents(made_costs(job))},
        lambda document: loop_tables(document["loops"]),
    ),
    "static": View(
        lambda job, outcomes: {"static": of.static_documents(job, outcomes)},
        lambda document: map(static_table, document["static"]),
    ),
    "crossval": View(of.validation_documents, _validation_tables),
    "nominal": View(
        lambda job, outcomes: {"nominal": of.nominal_document_of(job, outcomes)}, _one("nominal", nominal_table)
    ),
    "lpv": View(
        lambda job, outcomes: {"lpv": of.surface_documents(job, outcomes)},
        lambda document: map(lpv_table, document["lpv"]),
    ),
    "tune": View(
        lambda _, outcomes: {"tuning": of.design_documents(outcomes)},
        lambda document: tuning_tables(document["tuning"]),
    ),
    "impact": View(
        lambda job, outcomes: {"impacts": of.impact_documents(job, outcomes)},
        lambda document: impact_tables(document["impacts"]),
    ),
    "cycle": View(
        lambda job, _: {"cycle": cycle_documents(made_rows(job))},
        _one("cycle", cycle_summary),
    ),
}
"""By the name of the stage."""
