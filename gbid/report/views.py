"""View of each stage: the JSON document of its outcomes, and the tables of this document for a terminal."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict
from math import floor, isfinite, log10
from textwrap import shorten, wrap
from typing import TYPE_CHECKING, Any

import numpy as np

from gbid import control, identify, lpv, validate
from gbid.core.hdf5 import load
from gbid.core.tables import Row, Table, titled
from gbid.experiment.controllers import load_design
from gbid.experiment.run import Document, Job, Outcome, Stage, View, outcomes_view
from gbid.experiment.stages.crossval import crossval_rows, nominal_of
from gbid.experiment.stages.cycle import made_rows
from gbid.experiment.stages.loop import made_costs
from gbid.experiment.stages.prefilter import MAP
from gbid.experiment.stages.static import load_made_static
from gbid.identify.fit_tables import fit_tables
from gbid.prefilter import PrefilterFile
from gbid.report.control_tables import (
    cycle_documents,
    cycle_summary,
    gains_words,
    impact_documents,
    impact_tables,
    loop_documents,
    loop_tables,
    tuning_documents,
    tuning_tables,
)
from gbid.report.fit_tables import (
    crossval_table,
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

if TYPE_CHECKING:
    from gbid.control.assessment import TunedDesign

WIDTH = 80
"""Columns of a terminal that `gbid run` counts on."""
_LINES = 6  # of each kind in a summary
_TWO_SIDED = 1.96  # standard deviations of a 95 % interval
_ROWS = 60  # of a cross-validation; more are in its CSV file only


def view_of(stage: Stage) -> View:
    """Return the view of a stage; one that has none shows its outcomes."""
    return stage.view or VIEWS.get(stage.name) or outcomes_view(stage.name, stage.section)


def _made(outcomes: Sequence[Outcome], stage: str) -> list[Outcome]:
    return [outcome for outcome in outcomes if outcome.item.stage == stage and outcome.state != "failed"]


def _with_file(outcome: Outcome, document: Row) -> Row:
    return {**document, "state": outcome.state, "path": str(outcome.path)}


def _prefilter(_: Job, outcomes: Sequence[Outcome]) -> Document:
    maps = [o.path for o in _made(outcomes, "prefilter") if o.item.form == MAP]
    return {"prefilter": [row for path in maps for row in prefilter_rows(load(path, PrefilterFile).reports)]}


def fit_documents(job: Job, outcomes: Sequence[Outcome]) -> list[Row]:
    """Return documents of the fits, with true values for those of the rig; failed ones are left out."""
    documents = []
    for outcome in _made(outcomes, "fit"):
        fit, model = outcome.item.section, outcome.item.model
        place = _with_file(outcome, {"fit": fit, "model": model})
        documents.append({**place, **read_fit(job, fit, model).document})
    return documents


def _fit_tables(document: Document) -> list[Table]:
    return [table for fit in document["fits"] for table in titled(f"{fit['fit']}, {fit['model']}", fit_tables(fit))]


def _static(job: Job, outcomes: Sequence[Outcome]) -> Document:
    files = {o.item.section: o for o in _made(outcomes, "static") if o.path.suffix == ".h5"}
    return {"static": [_with_file(o, static_document(name, load_made_static(job, name))) for name, o in files.items()]}


def _validation(job: Job, outcomes: Sequence[Outcome]) -> Document:
    made = _made(outcomes, "crossval")
    rows = [{**asdict(row), "missed": row.missed} for row in crossval_rows(job)] if made else []
    files = {o.item.section: o.path for o in made if o.path.suffix == ".h5"}
    summaries = [summary_document(name, load(q, validate.ValidationSummary), q) for name, q in files.items()]
    return {"crossval": rows, "crossval_summary": summaries}


def _validation_tables(document: Document) -> Iterable[Table]:
    """Pairs of each fit, unless they are many, and their summary."""
    for summary in document["crossval_summary"]:
        rows = [row for row in document["crossval"] if row["fit"] == summary["fit"]]
        if len(rows) <= _ROWS:
            yield crossval_table(summary["fit"], rows)
        yield validation_table(summary)


def _nominal(job: Job, outcomes: Sequence[Outcome]) -> Document:
    documents = (nominal_document(o.item.section, nominal_of(job)[0], o.path) for o in _made(outcomes, "nominal"))
    return {"nominal": next(documents, None)}


def _surfaces(job: Job, outcomes: Sequence[Outcome]) -> Document:
    """Return documents of the surfaces, with the paper's figures for the paper's machine."""
    rig, paths = (
        job.experiment.spec.rig,
        {o.item.section: o.path for o in _made(outcomes, "lpv") if o.path.suffix == ".yaml"},
    )
    published = rig is not None and rig.model == PUBLISHED
    documents = (lpv_document(q, lpv.load_lpv_fit(path), path, published=published) for q, path in paths.items())
    return {"lpv": list(documents)}


def _impacts(job: Job, outcomes: Sequence[Outcome]) -> Document:
    paths = {o.item.section: o.path for o in outcomes if o.item.stage == "ringdown"}
    studies = {o.item.section: load(o.path, control.ImpactStudy) for o in _made(outcomes, "ringdown")}
    return {"impacts": impact_documents(job.experiment, studies, paths)}


def _designs(outcomes: Sequence[Outcome]) -> dict[str, TunedDesign]:
    return {o.item.section: load_design(o.path) for o in _made(outcomes, "tune")}


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


# ---- Summary: what an engineer looks for first, in few lines of the width of a terminal.


def summary_lines(document: Document) -> list[str]:
    """Return modes, fit on other recordings, surfaces, designs and notes of a run, at most 23 lines of 80 columns.

    Parameters
    ----------
    document : dict
        Has ``fits``, ``crossval_summary``, ``lpv`` and ``tuning`` as the JSON of ``gbid run``.
    """
    fits, lines = document["fits"], []
    if fits:
        lines.append(f"{converged_words(fits)}; modes with 95 % intervals:")
        lines += _few([_mode_line(*row) for row in mode_rows(fits)])
    lines += [line for begin, words in outcome_words(document) for line in _wrapped(begin, words)]
    lines += _few([line for design in document["tuning"] for line in design_lines(design)])
    notes = _few([shorten(f"  {begin}{text}", WIDTH - 2, placeholder=" ...") for begin, text in note_rows(document)])
    return [
        *lines,
        *(["notes (whole text with -v; gbid explain CODE):", *(f"  {line}" for line in notes)] if notes else []),
    ]


def fit_rows(table: identify.FitTable) -> list[Row]:
    """Return of each made fit of a campaign what `summary_lines` shows of its document; one file holds all of it."""
    modes = np.stack([getattr(table, f"mode_{key}") for key in _MODE_KEYS], axis=-1)
    return [
        {
            "fit": str(table.fit[i]),
            "model": str(table.model[i]),
            "success": bool(table.success[i]),
            "modes": [dict(zip(_MODE_KEYS, mode, strict=True)) for mode in modes[i].tolist() if isfinite(mode[0])],
            "notes": table.notes[i],
        }
        for i in np.flatnonzero(table.structure != "")
    ]


_MODE_KEYS = ("frequency_hz", "frequency_std_hz", "damping", "damping_std")


def converged_words(fits: Sequence[Row]) -> str:
    """Return how many of the fits converged."""
    return f"fits: {sum(fit['success'] for fit in fits)} of {len(fits)} converged"


def outcome_words(document: Document) -> list[tuple[str, list[str]]]:
    """Return the fit on other recordings and the states of the surfaces, each with its beginning."""
    scores = [f"{row['fit']} {min(row['least']):.1f}" for row in document["crossval_summary"]]
    surfaces = [f"{row['item']} {row['status']}" for row in document["lpv"]]
    return [("fit on other recordings, worst output [%]: ", scores), ("surfaces: ", surfaces)]


def _few(lines: list[str]) -> list[str]:
    left = len(lines) - _LINES
    return lines if left <= 0 else [*lines[: _LINES - 1], f"  ... {left + 1} lines more with -v"]


def _wrapped(begin: str, words: Sequence[str]) -> list[str]:
    return wrap(begin + ", ".join(words), WIDTH, subsequent_indent="  ", max_lines=2) if words else []


def mode_rows(fits: Sequence[Row]) -> list[tuple[str, str, str, str]]:
    """Return name of the fit, frequency [Hz], damping and range [Hz] of each mode.

    They are those of the first model of a fit that converged; the range is that of the frequency over its other models.
    """
    rows = []
    for name in dict.fromkeys(fit["fit"] for fit in fits):
        models = [fit for fit in fits if fit["fit"] == name and fit["success"] and fit["modes"]]
        for i, mode in enumerate(models[0]["modes"]) if models else ():
            others = [model["modes"][i]["frequency_hz"] for model in models if i < len(model["modes"])]
            span = f"{len(others)} models: {min(others):.7g} to {max(others):.7g}" if len(others) > 1 else ""
            frequency = _interval(mode["frequency_hz"], mode["frequency_std_hz"])
            rows.append((name, frequency, _interval(mode["damping"], mode["damping_std"]), span))
    return rows


def _mode_line(name: str, frequency: str, damping: str, span: str) -> str:
    line = f"  {name}: {frequency} Hz, damping {damping}"
    whole = f"{line} ({span} Hz)" if span else line
    return whole if len(whole) <= WIDTH else line


def _interval(value: float, std: float | None) -> str:
    """Return a value with its 95 % interval, both with the digits that the interval deserves."""
    if not std or not isfinite(std):
        return f"{value:.4g}"
    half = _TWO_SIDED * std
    digits = max(0, 1 - floor(log10(half)))
    return f"{value:.{digits}f} ± {half:.{digits}f}"


def design_lines(design: Row) -> list[str]:
    """Return the worst damping, peak and margin of a design over its points, and its gains."""
    worst = design["performance"][0]["worst"] if design["performance"] else {}
    sampled = "sampled_" if "sampled_damping" in worst else ""  # the loop as it runs
    labels = {f"{sampled}damping": "damping", f"{sampled}peak_output": "peak S_o", "disk_margin": "disk margin"}
    figures = [f"{label} {worst[key]['value']:.3g}" for key, label in labels.items() if key in worst]
    gains = gains_words(design["gains"])
    lines = [f"design {design['design']} ({design['structure']}, {design['status']}): {', '.join(figures)}"]
    return [*lines, f"  {gains}"] if len(gains) < WIDTH - 2 else lines


_CODE = re.compile(r" ?\[(GB\d+)\]")


def note_rows(document: Document) -> list[tuple[str, str]]:
    """Return each note once, by its code: code and number of results that have it, and the text of the first."""
    rows = [*document["fits"], *document["lpv"], *document["tuning"]]
    notes: dict[str, list[str]] = {}
    for text in (text for row in rows for text in row["notes"]):
        match = _CODE.search(text)
        notes.setdefault(match[1] if match else text.partition(":")[0], []).append(text)
    lines = []
    for code, texts in notes.items():
        times = f" ({len(texts)} times)" if len(texts) > 1 else ""
        begin = f"{code}{times}: " if _CODE.search(texts[0]) else f"{len(texts)} times: " if times else ""
        lines.append((begin, _CODE.sub("", texts[0])))
    return lines
