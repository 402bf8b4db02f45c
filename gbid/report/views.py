"""Views of the stages (JSON document and tables) for the command line, and the summary of a run."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict
from math import floor, isfinite, log10, nan
from pathlib import Path
from textwrap import shorten, wrap
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from gbid import control, identify, lpv, validate
from gbid.control.assessment import assessment_tables, design_tables, gains_words
from gbid.core.hdf5 import load
from gbid.core.tables import Column, Row, Table, titled
from gbid.experiment.controllers import load_design
from gbid.experiment.experiment import NO_POINT, Experiment
from gbid.experiment.machine import rig_machine
from gbid.experiment.run import Document, Job, Outcome, Stage, View, outcomes_view
from gbid.experiment.stages.crossval import crossval_rows, nominal_of, pair_table, read_crossval
from gbid.experiment.stages.cycle import made_rows, rounds_table
from gbid.experiment.stages.loop import cost_tables, made_costs
from gbid.experiment.stages.prefilter import MAP
from gbid.experiment.stages.static import load_made_static
from gbid.identify.fit_tables import fit_tables
from gbid.prefilter.filtering import PrefilterFile
from gbid.recording.recording import Recording
from gbid.report.campaign_tables import conditions_text
from gbid.report.read import read_fit

if TYPE_CHECKING:
    from gbid.control.assessment import TunedDesign

WIDTH = 80
"""Columns of a terminal that `gbid run` counts on."""
_LINES = 6  # of each kind in a summary
_TWO_SIDED = 1.96  # standard deviations of a 95 % interval
_ROWS = 60  # of a cross-validation; more are in its CSV file only


def view_of(stage: Stage) -> View:
    """Return the view of a stage; a stage without a special view shows its outcomes."""
    return stage.view or VIEWS.get(stage.name) or outcomes_view(stage.name, stage.section)


def _made(outcomes: Sequence[Outcome], *stages: str) -> list[Outcome]:
    return [outcome for outcome in outcomes if outcome.item.stage in stages and outcome.state != "failed"]


def results_view(key: str, values: Callable[[Job, Sequence[Outcome]], Iterable[tuple[Row, Any]]]) -> View:
    """Return the view of a stage whose results have the methods `document` and `tables`.

    Parameters
    ----------
    key : str
        Key in the JSON document.
    values : callable
        Function that returns for each result what the document adds, first its name, and the result.
    """
    return View(
        lambda job, outcomes: {key: [{**about, **value.document()} for about, value in values(job, outcomes)]},
        lambda job, outcomes: (
            table
            for about, value in values(job, outcomes)
            for table in titled(next(iter(about.values())), value.tables())
        ),
    )


def _static(job: Job, outcomes: Sequence[Outcome]) -> Iterator[tuple[Row, Any]]:
    for outcome in _made(outcomes, "static"):
        if outcome.path.suffix == ".h5":
            place = {"name": outcome.item.section, "state": outcome.state, "path": str(outcome.path)}
            yield place, load_made_static(job, outcome.item.section)


def _surfaces(_: Job, outcomes: Sequence[Outcome]) -> Iterator[tuple[Row, lpv.LPVFit]]:
    for outcome in _made(outcomes, "lpv"):
        if outcome.path.suffix == ".yaml":
            fit = load(outcome.path.with_suffix(".h5"), lpv.LPVFit)
            yield {"item": outcome.item.section, "path": str(outcome.path)}, fit


def fit_documents(job: Job, outcomes: Sequence[Outcome]) -> list[Row]:
    """Return the documents of the fits, with true values for recordings of the rig; failed fits are left out."""
    documents = []
    for outcome in _made(outcomes, "fit"):
        fit, model = outcome.item.section, outcome.item.model
        place = {"fit": fit, "model": model, "state": outcome.state, "path": str(outcome.path)}
        documents.append({**place, **read_fit(job, fit, model).document})
    return documents


def _fit_tables(job: Job, outcomes: Sequence[Outcome]) -> Iterator[Table]:
    for fit in fit_documents(job, outcomes):
        yield from titled(f"{fit['fit']}, {fit['model']}", fit_tables(fit))


def _recordings(job: Job, outcomes: Sequence[Outcome]) -> list[Row]:
    """Return the documents of simulated or imported recordings; failed recordings are left out."""
    made = [(outcome, load(outcome.path, Recording)) for outcome in _made(outcomes, "rig", "import")]
    return [
        {
            "name": recording.name,
            "kind": job.experiment.recordings[recording.name].kind,
            "samples": recording.n_samples,
            "sample_time_s": recording.sample_time,
            "duration_s": recording.duration,
            "conditions": dict(recording.conditions),
            "signals": {name: list(recording.channels[name]) for name in recording.signals},
            "state": outcome.state,
            "path": str(outcome.path),
        }
        for outcome, recording in made
    ]


def _recording_table(job: Job, outcomes: Sequence[Outcome]) -> Iterator[Table]:
    columns = [Column("recording"), Column("samples", format="d"), Column("duration", "s", "g")]
    rows = [
        [row["name"], row["samples"], row["duration_s"], conditions_text(row["conditions"]), row["state"]]
        for row in _recordings(job, outcomes)
    ]
    if rows:
        yield Table("recordings", [*columns, Column("conditions"), Column("state")], rows)


def _corrections(_: Job, outcomes: Sequence[Outcome]) -> PrefilterFile:
    maps = [load(o.path, PrefilterFile) for o in _made(outcomes, "prefilter") if o.item.form == MAP]
    return PrefilterFile(None, tuple(report for each in maps for report in each.reports))


def _validation(job: Job, outcomes: Sequence[Outcome]) -> Document:
    rows = [{**asdict(row), "missed": row.missed} for row in crossval_rows(job)] if _made(outcomes, "crossval") else []
    summaries = [{"fit": q, **asdict(summary), "path": str(path)} for q, path, summary in _summaries(outcomes)]
    return {"crossval": rows, "crossval_summary": summaries}


def _summaries(outcomes: Sequence[Outcome]) -> list[tuple[str, Path, validate.ValidationSummary]]:
    made = [o for o in _made(outcomes, "crossval") if o.path.suffix == ".h5"]
    return [(o.item.section, o.path, load(o.path, validate.ValidationSummary)) for o in made]


def _validation_tables(job: Job, outcomes: Sequence[Outcome]) -> Iterator[Table]:
    """Yield the validation table of each fit, unless it is long, and the summary."""
    for name, _, summary in _summaries(outcomes):
        rows = read_crossval(job, name)
        pairs = [pair_table(rows)] if len(rows) <= _ROWS else []
        yield from [*titled(name, pairs), *titled(name, summary.tables())]


def _nominal(job: Job, outcomes: Sequence[Outcome]) -> Document:
    made = [
        {"fit": o.item.section, **nominal_of(job)[0].document(), "path": str(o.path)}
        for o in _made(outcomes, "nominal")
    ]
    return {"nominal": made[0] if made else None}


def _nominal_tables(job: Job, outcomes: Sequence[Outcome]) -> Iterator[Table]:
    for outcome in _made(outcomes, "nominal")[:1]:
        yield from titled(outcome.item.section, nominal_of(job)[0].tables())


def _designs(outcomes: Sequence[Outcome]) -> dict[str, TunedDesign]:
    return {o.item.section: load_design(o.path) for o in _made(outcomes, "tune")}


def _tuning(_: Job, outcomes: Sequence[Outcome]) -> Document:
    paths = {(o.item.stage, o.item.section): str(o.path) for o in _made(outcomes, "tune", "controller")}
    designs = _designs(outcomes).items()
    files = {
        name: {"path": paths.get(("tune", name)), "controller": paths.get(("controller", name))} for name, _ in designs
    }
    return {"tuning": [{"design": name, **files[name], **design.document()} for name, design in designs]}


def _tuning_tables(_: Job, outcomes: Sequence[Outcome]) -> Iterator[Table]:
    """Yield tables that compare designs for equal plant and operating points, and the tuning results."""
    designs = _designs(outcomes)
    yield from [*assessment_tables(designs), *design_tables(designs)]
    made = [o for o in _made(outcomes, "controller") if o.item.section in designs]
    files = [f"{o.item.section}: controller in {o.path}" for o in made]
    yield from [Table("", (), (), files)] if files else []


def _published(job: Job, study: control.ImpactStudy) -> Row:
    """Return the modes in the paper for operating point and loop of an impact study with the paper's controller."""
    section, rig = job.experiment.spec.impacts, job.experiment.spec.rig
    if section is None or rig is None or (study.loop != "open" and section.controller.kind != "paper"):
        return {}
    place = {**study.conditions, "loop": study.loop}
    known = [q for q in rig_machine(job.experiment).reference_modes if place == {key: getattr(q, key) for key in place}]
    return {q.kind: [list(mode) for mode in q.modes] for q in known if q.kind in ("expected", "measured")}


def _studies(job: Job, outcomes: Sequence[Outcome]) -> Iterator[tuple[Row, control.ImpactStudy]]:
    for outcome in _made(outcomes, "ringdown"):
        study = load(outcome.path, control.ImpactStudy)
        yield {"name": outcome.item.section, "path": str(outcome.path), "published": _published(job, study)}, study


def _model_files(_: Job, outcomes: Sequence[Outcome]) -> list[Table]:
    files = [f"model: {outcome.path}" for outcome in _made(outcomes, "lpv") if outcome.path.suffix == ".yaml"]
    return [Table("", (), (), files)] if files else []


def _study_tables(job: Job, outcomes: Sequence[Outcome]) -> Iterator[Table]:
    """Yield the tables of each impact study, with the modes in the paper if known."""
    columns = [Column("in the paper"), *(Column(f"ω{i}", "Hz", ".1f") for i in (1, 2))]
    columns += [Column(f"ζ{i}", format=".3f") for i in (1, 2)]
    for about, study in _studies(job, outcomes):
        yield from study.tables()
        rows = [[kind, *(q[0] for q in modes), *(q[1] for q in modes)] for kind, modes in about["published"].items()]
        yield from [Table("", columns, rows)] if rows else []


_SURFACES = results_view("lpv", _surfaces)
_RECORDINGS = View(lambda *made: {"recordings": _recordings(*made)}, _recording_table)

VIEWS: Mapping[str, View] = {
    "rig": _RECORDINGS,
    "import": _RECORDINGS,
    "prefilter": View(
        lambda *made: _corrections(*made).document(),
        lambda *made: [table for table in _corrections(*made).tables() if table.rows],
    ),
    "fit": View(lambda *made: {"fits": fit_documents(*made)}, _fit_tables),
    "loop": View(lambda *_: {}, lambda *_: []),  # its designs are shown with the others
    "loop cost": View(
        lambda job, _: {"loops": [row.document() for row in made_costs(job)]},
        lambda job, _: cost_tables(made_costs(job)),
    ),
    "static": results_view("static", _static),
    "crossval": View(_validation, _validation_tables),
    "nominal": View(_nominal, _nominal_tables),
    "lpv": View(_SURFACES.document, lambda *made: [*_SURFACES.tables(*made), *_model_files(*made)]),
    "tune": View(_tuning, _tuning_tables),
    "impact": View(results_view("impacts", _studies).document, _study_tables),
    "cycle": View(
        lambda job, _: {"cycle": [asdict(row) for row in made_rows(job)]},
        lambda job, _: [rounds_table(rows)] if (rows := made_rows(job)) else [],
    ),
}
"""By the name of the stage."""


# ---- Summary of a run for the terminal: modes, validation, surfaces, designs, notes.


def summary_lines(document: Document, points: Mapping[str, str]) -> list[str]:
    """Return modes, fit on other recordings, surfaces, designs and notes of a run, at most 23 lines of 80 columns.

    Parameters
    ----------
    document : dict
        Has ``fits``, ``crossval_summary``, ``lpv`` and ``tuning`` as the JSON of ``gbid run``.
    points : dict of str to str
        Operating points of the recordings, as text.
    """
    fits, lines = document["fits"], []
    if fits:
        lines.append(f"{converged_words(fits)}; modes with 95 % intervals:")
        modes = modes_by_point(fits, points)
        lines += _few([mode.line() for mode in modes] if len(modes) <= _LINES else _mode_ranges(modes))
    lines += [line for begin, words in outcome_words(document) for line in _wrapped(begin, words)]
    lines += _few([line for design in document["tuning"] for line in design_lines(design)])
    notes = _few([shorten(f"  {begin}{text}", WIDTH - 2, placeholder=" ...") for begin, text in note_rows(document)])
    return [
        *lines,
        *(["notes (whole text with -v; gbid explain CODE):", *(f"  {line}" for line in notes)] if notes else []),
    ]


def points_of(experiment: Experiment) -> dict[str, str]:
    """Return the operating points of the recordings of an experiment as text; without a point the recording's name."""
    return {name: name if q.point == NO_POINT else q.point for name, q in experiment.recordings.items()}


def fit_rows(table: identify.FitTable) -> list[Row]:
    """Return the summary values of each finished fit of a campaign, read from one file."""
    modes = np.stack([getattr(table, f"mode_{key}") for key in _MODE_KEYS], axis=-1)
    return [
        {
            "fit": str(table.fit[i]),
            "model": str(table.model[i]),
            "recordings": list(table.recordings[i]),
            "success": bool(table.success[i]),
            "modes": [dict(zip(_MODE_KEYS, mode, strict=True)) for mode in modes[i].tolist() if isfinite(mode[0])],
            "notes": table.notes[i],
        }
        for i in np.flatnonzero(table.structure != "")
    ]


_MODE_KEYS = ("frequency_hz", "frequency_std_hz", "damping", "damping_std")


def converged_words(fits: Sequence[Row]) -> str:
    """Return the number of converged fits as text."""
    return f"fits: {sum(fit['success'] for fit in fits)} of {len(fits)} converged"


def outcome_words(document: Document) -> list[tuple[str, list[str]]]:
    """Return texts on the validation and on the surfaces, each with its heading."""
    scores = [f"{row['fit']} {min(row['least']):.1f}" for row in document["crossval_summary"]]
    surfaces = [f"{row['item']} {row['status']}" for row in document["lpv"]]
    return [("fit on other recordings, worst output [%]: ", scores), ("surfaces: ", surfaces)]


def _few(lines: list[str]) -> list[str]:
    left = len(lines) - _LINES
    return lines if left <= 0 else [*lines[: _LINES - 1], f"  ... {left + 1} lines more with -v"]


def _wrapped(begin: str, words: Sequence[str]) -> list[str]:
    return wrap(begin + ", ".join(words), WIDTH, subsequent_indent="  ", max_lines=2) if words else []


class ModeRow(NamedTuple):
    """Mode of the converged fits of one structure at one operating point.

    Attributes
    ----------
    fit, point : str
        Name of the fit, and the operating point as text.
    number, models : int
        Number of the mode in rising order of frequency, and number of models.
    frequency_hz, frequency_std_hz, damping, damping_std : float
        Means over the models, and standard deviations of one model: the larger one of that stated and the scatter.
    """

    fit: str
    point: str
    number: int
    models: int
    frequency_hz: float
    frequency_std_hz: float
    damping: float
    damping_std: float

    def formatted(self) -> tuple[str, str]:
        """Return frequency and damping factor with the 95 % interval of one model, as texts."""
        return _interval(self.frequency_hz, self.frequency_std_hz), _interval(self.damping, self.damping_std)

    def line(self) -> str:
        """Return the mode as one line for a terminal."""
        frequency, damping = self.formatted()
        models = f" (mean of {self.models})" if self.models > 1 else ""
        return f"  {self.fit} {self.point}{models}: {frequency} Hz, damping {damping}"


def modes_by_point(fits: Sequence[Row], points: Mapping[str, str]) -> list[ModeRow]:
    """Return the modes of the converged fits by fit and operating point.

    Parameters
    ----------
    fits : sequence of dict
        Documents of fits.
    points : dict of str to str
        Operating points of the recordings, as text.
    """
    groups: dict[tuple[str, str], list[Row]] = {}
    for fit in fits:
        if fit["success"] and fit["modes"]:
            where = dict.fromkeys(points.get(name, name) for name in fit["recordings"])
            groups.setdefault((fit["fit"], next(iter(where)) if len(where) == 1 else "all points"), []).append(fit)
    rows = []
    for (name, point), models in groups.items():
        for i in range(max(len(model["modes"]) for model in models)):
            modes = [model["modes"][i] for model in models if i < len(model["modes"])]
            numbers = np.array([[nan if mode[key] is None else mode[key] for key in _MODE_KEYS] for mode in modes])
            stated = np.sqrt(np.mean(numbers[:, 1::2] ** 2, axis=0))
            scatter = numbers[:, ::2].std(axis=0, ddof=1) if len(modes) > 1 else 0.0
            mean, std = numbers[:, ::2].mean(axis=0), np.fmax(stated, scatter)
            rows.append(ModeRow(name, point, i + 1, len(modes), *np.column_stack([mean, std]).ravel().tolist()))
    return rows


def _mode_ranges(modes: Sequence[ModeRow]) -> list[str]:
    """Return one line for each mode of each fit with its range over the operating points."""
    lines = []
    for name, number in dict.fromkeys((mode.fit, mode.number) for mode in modes):
        group = [mode for mode in modes if (mode.fit, mode.number) == (name, number)]
        frequency, damping = ([getattr(mode, key) for mode in group] for key in ("frequency_hz", "damping"))
        lines.append(
            f"  {name} mode {number}: {min(frequency):.4g} to {max(frequency):.4g} Hz, damping {min(damping):.3g} to "
            f"{max(damping):.3g} at {len(group)} points"
        )
    return lines


def _interval(value: float, std: float | None) -> str:
    """Return a value with its 95 % interval as text, with digits according to the width of the interval."""
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


def notes_by_kind(rows: Iterable[Row]) -> dict[str, list[str]]:
    """Return the notes of results by code; notes without code by the text before the first colon."""
    notes: dict[str, list[str]] = {}
    for text in (text for row in rows for text in row["notes"]):
        match = _CODE.search(text)
        notes.setdefault(match[1] if match else text.partition(":")[0], []).append(text)
    return notes


def note_rows(document: Document) -> list[tuple[str, str]]:
    """Return one row per note code: code, number of results with the note, and text of the first note."""
    lines = []
    for code, texts in notes_by_kind([*document["fits"], *document["lpv"], *document["tuning"]]).items():
        times = f" ({len(texts)} times)" if len(texts) > 1 else ""
        begin = f"{code}{times}: " if _CODE.search(texts[0]) else f"{len(texts)} times: " if times else ""
        lines.append((begin, _CODE.sub("", texts[0])))
    return lines
