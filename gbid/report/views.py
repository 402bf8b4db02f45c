"""View of each stage: the JSON document of its outcomes, and the tables of this document for a terminal."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict
from typing import Any

from gbid.control.assessment import TunedDesign
from gbid.control.impact.study import ImpactStudy
from gbid.core.hdf5 import load
from gbid.core.tables import Table
from gbid.experiment.run import Document, Job, Outcome, Stage, View, outcomes_view
from gbid.experiment.stages.crossval import SUMMARY, crossval_rows, nominal_of
from gbid.experiment.stages.cycle import made_rows
from gbid.experiment.stages.loop import made_costs
from gbid.experiment.stages.static import load_made_static
from gbid.lpv import load_lpv_fit
from gbid.prefilter import PrefilterFile
from gbid.report.control_tables import (
    cycle_documents,
    cycle_summary,
    impact_documents,
    impact_tables,
    loop_documents,
    loop_tables,
    tuning_documents,
    tuning_tables,
)
from gbid.report.fit_tables import (
    Row,
    crossval_table,
    fit_tables,
    lpv_document,
    lpv_table,
    nominal_document,
    nominal_table,
    prefilter_rows,
    prefilter_table,
    recording_documents,
    recording_table,
    static_document,
    static_table,
    summary_document,
    validation_table,
)
from gbid.report.read import PUBLISHED, read_fit
from gbid.validate import ValidationSummary

_ROWS = 60  # of a cross-validation; more are in its CSV file only


def view_of(stage: Stage) -> View:
    """Return the view of a stage; one that has none shows its outcomes."""
    return stage.view or VIEWS.get(stage.name) or outcomes_view(stage.name, stage.section)


def _made(outcomes: Sequence[Outcome], stage: str) -> list[Outcome]:
    return [outcome for outcome in outcomes if outcome.stage == stage and outcome.state != "failed"]


def _with_file(outcome: Outcome, document: Row) -> Row:
    return {**document, "state": outcome.state, "path": str(outcome.path)}


def _prefilter(_: Job, outcomes: Sequence[Outcome]) -> Document:
    maps = [o.path for o in _made(outcomes, "prefilter") if o.item.startswith("map ")]
    return {"prefilter": [row for path in maps for row in prefilter_rows(load(path, PrefilterFile).reports)]}


def fit_documents(job: Job, outcomes: Sequence[Outcome]) -> list[Row]:
    """Return documents of the fits, with true values for those of the rig; failed ones are left out."""
    documents = []
    for outcome in _made(outcomes, "fit"):
        fit, _, model = outcome.item.partition("/")
        place = _with_file(outcome, {"fit": fit, "model": model})
        documents.append({**place, **read_fit(job, fit, model).document})
    return documents


def _fit_tables(document: Document) -> list[Table]:
    return [table for fit in document["fits"] for table in fit_tables(f"{fit['fit']}, {fit['model']}", fit)]


def _static(job: Job, outcomes: Sequence[Outcome]) -> Document:
    files = {o.item: o for o in _made(outcomes, "static") if o.path.suffix == ".h5"}
    return {"static": [_with_file(o, static_document(name, load_made_static(job, name))) for name, o in files.items()]}


def _validation(job: Job, outcomes: Sequence[Outcome]) -> Document:
    made = _made(outcomes, "crossval")
    rows = [{**asdict(row), "missed": row.missed} for row in crossval_rows(job)] if made else []
    files = [o.path for o in made if o.path.suffix == ".h5"]
    summaries = [summary_document(q.stem.removesuffix(SUMMARY), load(q, ValidationSummary), q) for q in files]
    return {"crossval": rows, "crossval_summary": summaries}


def _validation_tables(document: Document) -> Iterable[Table]:
    """Pairs of each fit, unless they are many, and their summary."""
    for summary in document["crossval_summary"]:
        rows = [row for row in document["crossval"] if row["fit"] == summary["fit"]]
        if len(rows) <= _ROWS:
            yield crossval_table(summary["fit"], rows)
        yield validation_table(summary)


def _nominal(job: Job, outcomes: Sequence[Outcome]) -> Document:
    documents = (nominal_document(o.item, nominal_of(job)[0], o.path) for o in _made(outcomes, "nominal"))
    return {"nominal": next(documents, None)}


def _surfaces(job: Job, outcomes: Sequence[Outcome]) -> Document:
    """Return documents of the surfaces, with the paper's figures for the paper's machine."""
    rig, paths = job.experiment.spec.rig, {o.item: o.path for o in _made(outcomes, "lpv") if o.path.suffix == ".yaml"}
    published = rig is not None and rig.model == PUBLISHED
    documents = (lpv_document(q, load_lpv_fit(path), path, published=published) for q, path in paths.items())
    return {"lpv": list(documents)}


def _impacts(job: Job, outcomes: Sequence[Outcome]) -> Document:
    paths = {o.item: o.path for o in outcomes if o.stage == "ringdown"}
    studies = {o.item: load(o.path, ImpactStudy) for o in _made(outcomes, "ringdown")}
    return {"impacts": impact_documents(job.experiment, studies, paths)}


def _designs(outcomes: Sequence[Outcome]) -> dict[str, TunedDesign]:
    return {o.item: load(o.path, TunedDesign) for o in _made(outcomes, "tune")}


def _entry(key: str, table: Callable[[Any], Table]) -> Callable[[Document], list[Table]]:
    """Give the table of an entry, none when it is empty."""
    return lambda document: [table(document[key])] if document[key] else []


_RECORDINGS = View(
    lambda job, outcomes: {"recordings": recording_documents(job.experiment, outcomes)},
    _entry("recordings", recording_table),
)

VIEWS: Mapping[str, View] = {
    "rig": _RECORDINGS,
    "import": _RECORDINGS,
    "prefilter": View(_prefilter, _entry("prefilter", prefilter_table)),
    "fit": View(lambda job, outcomes: {"fits": fit_documents(job, outcomes)}, _fit_tables),
    "loop": View(lambda *_: {}, lambda _: []),  # its designs are shown with the others
    "loop cost": View(
        lambda job, _: {"loops": loop_documents(made_costs(job))}, lambda document: loop_tables(document["loops"])
    ),
    "static": View(_static, lambda document: map(static_table, document["static"])),
    "crossval": View(_validation, _validation_tables),
    "nominal": View(_nominal, _entry("nominal", nominal_table)),
    "lpv": View(_surfaces, lambda document: map(lpv_table, document["lpv"])),
    "tune": View(
        lambda _, outcomes: {"tuning": tuning_documents(outcomes, _designs(outcomes))},
        lambda document: tuning_tables(document["tuning"]),
    ),
    "impact": View(_impacts, lambda document: impact_tables(document["impacts"])),
    "cycle": View(lambda job, _: {"cycle": cycle_documents(made_rows(job))}, _entry("cycle", cycle_summary)),
}
"""By the name of the stage."""
