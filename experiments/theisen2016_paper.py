"""Theisen et al. (2016): tables of the paper from results, and its figures (`theisen2016_numbers.yaml`) beside ours.

`gbid paper` loads this file (`gbid.report.named.paper`).
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from theisen2016_comparison import (
    KIND_WORDS,
    ReproductionRow,
    alternative_designs,
    alternative_rows,
    computation_rows,
    counts,
    headline,
    repeated_rows,
    reproduction,
    sentences,
)
from theisen2016_figures import FIGURES, PaperResults

from gbid.control.assessment import comparison_table, conditions_words
from gbid.control.impact.study import response_rows
from gbid.core.arrays import point_label
from gbid.core.errors import DataError, NoSpaceError, UsageError
from gbid.core.tables import Column, Entry, Table, csv_text, formatted, markdown_table, plain_table
from gbid.experiment.fields import InputError, Item, Result, content_key, stored_key
from gbid.experiment.run import Job, Outcome, Task, produce, run_tasks
from gbid.lpv.model import TERMS
from gbid.report.canvas import figure_of, save_figure
from gbid.report.loop_pictures import design_performances
from gbid.report.named import write_shipped
from gbid.structure import KEY_PARAMETERS

# ---- Tables of the paper from the results of an experiment: CSV for programs, Markdown for reports.

_UNITS = {"k": "N/(kg m)", "d": "N s/(kg m)", "b": "N/(kg m)", "tau": "s"}
_PER = ("", "/bar", "/rpm", "/(bar rpm)", "/bar^2", "/rpm^2")


def machine_table(results: PaperResults) -> Table:
    """Return the dimensions of the machine (Table 1) from its model file."""
    if not results.published_machine.rig:
        raise DataError(f"the model file of {results.machine.name!r} gives no dimensions of the machine")
    rows = [(name.replace("_", " "), q.value, q.unit, q.source) for name, q in results.published_machine.rig.items()]
    return Table("Table 1: the machine", _columns("dimension", "value", "unit", "source"), rows)


def actuator_table(results: PaperResults) -> Table:
    """Return the nominal actuators (Table 2), with those of the machine's model file."""
    nominal = results.nominal
    known = _published(results)
    rows = [
        (name, value, nominal.std[name], known.get(name), "m/m" if name.startswith("kappa") else "rad/s")
        for name, value in nominal.parameters.items()
    ]
    title = f"Table 2: nominal actuators, the model of {nominal.name}"
    return Table(title, _columns("parameter", "value", "std", "published", "unit"), rows)


def frequency_table(results: PaperResults) -> Table:
    """Return expected and identified natural frequencies (Table 3)."""
    return _mode_table(results, "Table 3: natural frequencies [Hz]", "omega", 0)


def damping_table(results: PaperResults) -> Table:
    """Return expected and identified damping factors (Table 4)."""
    return _mode_table(results, "Table 4: damping factors", "zeta", 1)


def controller_table(results: PaperResults) -> Table:
    """Return the controllers of the piezos (Table A.5) from the machine's model file."""
    found = results.published_machine.piezo_controllers
    if found is None:
        raise DataError(f"the model file of {results.machine.name!r} gives no controllers of the piezos")
    columns = [Column("piezo"), *(Column(name, unit, 4) for name, unit in found.unit.items())]
    rows = tuple((i, *(getattr(pd, name) for name in found.unit)) for i, pd in enumerate(found.piezos, 1))
    return Table("Table A.5: controllers of the piezos", columns, rows)


def coefficient_table(results: PaperResults) -> Table:
    """Return the coefficients of the surfaces (Table B.6), with those of the machine's model file."""
    fit = results.surface_fit
    std = np.sqrt(np.diag(fit.covariance)).reshape(len(KEY_PARAMETERS), len(TERMS))
    known = results.machine.coefficients if results.experiment.spec.rig is not None else {}
    rows = [
        (key, term, value, float(std[i, j]), known[key][j] if known else None, f"{_UNITS[key.split('_')[0]]}{_PER[j]}")
        for i, key in enumerate(KEY_PARAMETERS)
        for j, (term, value) in enumerate(zip(TERMS, fit.model.coefficients[key], strict=True))
    ]
    columns = _columns("parameter", "term", "value", "std", "published", "unit")
    return Table("Table B.6: coefficients of the surfaces, per kg", columns, rows)


def designs_table(results: PaperResults) -> Table:
    """Return the tuned designs and the published one, each at its worst operating point."""
    performances = design_performances(results.tuned)
    first = next(iter(results.tuned.values()))
    title = f"Designs at the worst of {len(performances[0].points)} operating points"
    return comparison_table(title, performances, conditions_words(first.impact, first.sample_time, first.method))


def impacts_table(results: PaperResults) -> Table:
    """Return measured and simulated responses to the same impact in each loop."""
    shown = (("disc", "µm", "peak", "m", 1e6), ("over", "ms", "decay", "s", 1e3), ("piezo", "µm", "piezo", "m", 1e6))
    heads = [Column(f"{what}{word}", unit, 4) for what, unit, *_ in shown for word in ("", " std", " simulated")]
    rows: list[tuple[Entry, ...]] = []
    for loops in results.beside:
        for label, study in loops.items():
            where = point_label(study.conditions["pressure_bar"], study.conditions["speed_rpm"])
            for row in response_rows(study):
                numbers = (
                    factor * row[f"{name}{suffix} [{unit}]"]
                    for *_, name, unit, factor in shown
                    for suffix in ("", "_std", "_simulated")
                )
                rows.append((where, label, row["axis"], *numbers))
    title = "The same impact in each loop on the rig: disc up to, over after (95 % of the energy), piezo up to"
    return Table(title, [*_columns("where", "loop", "axis"), *heads], rows)


def _mode_table(results: PaperResults, title: str, sign: str, j: int) -> Table:
    loops = results.impacts_at(False)
    point = next(iter(loops.values())).conditions
    place = (point["pressure_bar"], point["speed_rpm"])
    columns = [(i, loop) for i in (0, 1) for loop in ("open", "closed")]
    rows: list[tuple[Entry, ...]] = [
        ("expected from model", *(loops[loop].expected[i][j] for i, loop in columns)),
        ("expected, sampled loop", *(loops[loop].expected_sampled[i][j] for i, loop in columns)),
        ("obtained from the impacts", *(loops[loop].ringdown.modes()[i][j] for i, loop in columns)),
        ("standard deviation", *(_std(loops[loop].ringdown, i, j) for i, loop in columns)),
    ]
    modes = [m for m in results.published_machine.reference_modes if (m.pressure_bar, m.speed_rpm) == place]
    for kind in ("expected", "measured"):
        known = {m.loop: m.modes for m in modes if m.kind == kind}
        if {"open", "closed"} <= set(known):
            word = "expected from model" if kind == "expected" else "obtained experimentally"
            rows.append((f"published: {word}", *(known[loop][i][j] for i, loop in columns)))  # type: ignore[index]
    heads = [Column(""), *(Column(f"{sign}_{i + 1} {loop}", format=4) for i, loop in columns)]
    return Table(f"{title}, {point_label(*place)}", heads, rows)


def _std(ring: Any, i: int, j: int) -> float:
    return float((ring.frequency_std, ring.damping_std)[j][i])


def _published(results: PaperResults) -> dict[str, float]:
    return dict(results.machine.actuators) if results.experiment.spec.rig is not None else {}


def _columns(*names: str) -> list[Column]:
    """Return columns of texts, and of numbers with four digits."""
    return [Column(name, format=4 if name in ("value", "std", "published") else "") for name in names]


TABLES: dict[str, Callable[[PaperResults], Table]] = {
    "table1_machine": machine_table,
    "table2_actuators": actuator_table,
    "table3_natural_frequencies": frequency_table,
    "table4_damping_factors": damping_table,
    "tableA5_piezo_controllers": controller_table,
    "tableB6_coefficients": coefficient_table,
    "designs": designs_table,
    "designs_impacts": impacts_table,
}
"""Tables by name. Each raises `DataError` when its results are missing."""


# ---- The reproduction table, for a terminal and as Markdown.

_COLUMNS = (
    Column("where"),
    Column("quantity", wrap=True),  # the only one with words enough to give way
    Column("kind"),
    Column("unit"),
    *(Column(name, format="g") for name in ("paper", "+-", "ours", "std", "off by", "predicted")),
    Column(""),
)
_LEGEND = (
    "+-: how far by the paper's own account, for means and sizes of scatter two standard errors; within: no further, "
    "with two of our standard deviations, and never beyond 25 %; predicted: what the numbered text computes for our "
    "value, within two standard deviations; explained: other code links the paper's figure with ours; ours: a setting "
    "of ours makes our value; open: neither, or other code gives another value for ours"
)
_COUNTED = {
    "within": "within the paper's scatter",
    "explained": "explained",
    "ours": "ours by setting",
    "open": "open",
    "missing": "missing",
}
_DIGITS = 4
_SENTENCES = (
    Column("where"),
    Column("sentence", wrap=True),
    Column("kind"),
    Column("the paper's own answer", wrap=True),
    Column("here"),
    Column("figure", wrap=True),
)


def reproduction_tables(document: Mapping[str, Any]) -> list[Table]:
    """Table of the paper's figures and ours, with the explanations below, its sentences, and what goes past the paper.

    Parameters
    ----------
    document : dict
        From `reproduction_document`.
    """
    rows, reasons = _laid_out(document)
    notes = [
        *document["headline"],
        *_totals(document),
        f"{_LEGEND}.",
        *(f"{i}. {reason}" for i, reason in enumerate(reasons, 1)),
    ]
    table = Table("the paper's figures and ours", _COLUMNS, rows, ["", *notes])
    said = [
        [row[key] for key in ("where", "says", "kind", "paper", "answer", "figure")] for row in document["sentences"]
    ]
    spoken = Table("what the paper says without a figure", _SENTENCES, said)
    return [table, spoken, *map(_past, document["past_the_paper"])]


def reproduction_markdown(document: Mapping[str, Any]) -> str:
    """Markdown of the same tables.

    Parameters
    ----------
    document : dict
        From `reproduction_document`.
    """
    first, *past = reproduction_tables(document)
    return "\n".join(map(markdown_table, (replace(first, title=""), *past)))  # a page has a heading of its own


def _past(document: Mapping[str, Any]) -> Table:
    """Table of what the paper has no figures for, from its document."""
    rows = [[cell if isinstance(cell, str) else _cell(cell, _DIGITS) for cell in row] for row in document["rows"]]
    worded = [isinstance(cell, str) for cell in document["rows"][0]]
    heads = zip(document["columns"], worded, strict=True)
    columns = [Column(name) if words else Column(name.replace(" ", "\n"), format="g") for name, words in heads]
    return Table(document["title"], columns, rows)


def _laid_out(document: Mapping[str, Any]) -> tuple[list[list[Entry]], list[str]]:
    """Cells of each row, and the explanations that the last column numbers."""
    rows: list[list[Entry]] = []
    reasons: list[str] = []
    for row in document["rows"]:
        word = row["verdict"]
        if row["why"]:
            reasons += [] if row["why"] in reasons else [row["why"]]
            word = f"{word} {reasons.index(row['why']) + 1}"
        ours, predicted = ((_cell(row[key], 4), _cell(row[f"{key}_std"], 2)) for key in ("ours", "predicted"))
        numbers = (_cell(row["paper"], 4), _cell(row["allowed"], 2), *ours, _off(row), predicted[0])
        rows.append([row["where"], row["quantity"], row["kind"], row["unit"], *numbers, word])
    return rows, reasons


def _totals(document: Mapping[str, Any]) -> list[str]:
    """Return the number of rows by verdict for each kind; only the independent ones are evidence."""
    return [
        f"{sum(verdicts.values())} rows {KIND_WORDS[kind]}: "
        + ", ".join(f"{count} {_COUNTED[verdict]}" for verdict, count in verdicts.items() if count)
        for kind, verdicts in document["counts"].items()
    ]


def _off(row: Mapping[str, Any]) -> Entry:
    if row["deviation_percent"] is None:
        return _cell(row["deviation"], 2)
    return formatted(row["deviation_percent"], "+.1f", "%")


def _cell(value: float | None, digits: int) -> Entry:
    if value is None or not 0.001 <= abs(value) < 1e5:
        return formatted(value, digits)
    return formatted(value, f".{digits}g" if abs(value) < 10**digits else ".0f")


# ---- Files of the figures and tables of the paper, and of the comparison with it, from the results.

FOLDER = "figures"
KINDS = ("pdf", "svg", "png")
"""Formats of figures."""
_LOOP_MODES = (
    Column("6 bar, 0 rpm"),
    *(Column(f"{what} {i}", unit, 4) for i in (1, 2) for what, unit in (("frequency", "Hz"), ("damping", ""))),
)
_READINGS = (
    Column("reading"),
    Column("points that differ", "", 2),
    *(Column(name, "", 3) for name in ("open loop", "published gains")),
    Column("verdicts that differ", wrap=True),
)
_TUNED_READINGS = (
    Column("reading"),
    *(Column(name, "", 3) for name in ("kappa_x", "kappa_y", "tuned for it", "tuned for the first", "tuned for all")),
)
_PAST: tuple[tuple[str, tuple[Column, ...], Callable[[PaperResults], list[list[str | float]]]], ...] = (
    ("the closed loop and the time for computation, which the paper does not give", _LOOP_MODES, computation_rows),
    ("modes from ring-downs: one set of impacts, and many", _LOOP_MODES, repeated_rows),
    (
        "readings of d_yx at Omega^2: smallest damping factor over the 15 points, and what else each changes",
        _READINGS,
        alternative_rows,
    ),
    (
        "P controllers for each reading: gains, and smallest damping factor of the sampled loop over the 15 points",
        _TUNED_READINGS,
        alternative_designs,
    ),
)
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
    results, sources = PaperResults(job), _sources(job)
    outcomes: list[Outcome] = []
    left_out: list[LeftOut] = []
    figures = {name: [_figure_file(job, name, kind, sources) for kind in kinds] for name in FIGURES}
    kept = {file.path for files in figures.values() for file in files if file.is_made}
    drawn = run_tasks(job, [_figure_task(name, files) for name, files in figures.items()])
    for (name, files), outcome in zip(figures.items(), drawn, strict=True):
        if outcome.cause == "input":
            left_out.append(LeftOut(name, outcome.text))
        for file in () if outcome.cause == "input" else files:
            state = "kept" if file.path in kept else outcome.state
            outcomes.append(replace(outcome, item=file.item, path=file.path, state=state))
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
    results, sources = PaperResults(job), _sources(job)
    rows = reproduction(results)
    document = reproduction_document(rows, sentences(results), past_the_paper(results))
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
        outcomes.append(
            produce(
                job,
                Result(Item(REPRODUCTION, REPRODUCTION, form=f"{{}}{ending}"), path, key),
                partial(_write_text, text),
            )
        )
    return outcomes, document


def past_the_paper(results: PaperResults) -> list[Table]:
    """Return tables without counterpart in the paper, if the results allow them: tuned designs and their impacts."""
    makers = [
        *(partial(_table_past, results, *about) for about in _PAST),
        *(partial(TABLES[name], results) for name in PAST),
    ]
    found = []
    for make in makers:
        with suppress(DataError):
            found.append(make())
    return found


def _table_past(
    results: PaperResults,
    title: str,
    columns: Sequence[Column],
    rows: Callable[[PaperResults], list[list[str | float]]],
) -> Table:
    return Table(title, list(columns), rows(results))


def reproduction_document(
    rows: Sequence[ReproductionRow], said: Sequence[Mapping[str, str]] = (), past: Sequence[Table] = ()
) -> dict[str, Any]:
    """Return headline, rows, sentences and further tables as plain values, with the rows by kind and verdict."""
    return {
        "headline": headline(rows),
        "counts": counts(rows),
        "rows": [row.document() for row in rows],
        "sentences": [dict(sentence) for sentence in said],
        "past_the_paper": [table.document() for table in past],
    }


def _as_table(rows: Sequence[ReproductionRow]) -> Table:
    columns = (
        *("where", "quantity", "kind", "unit", "paper", "allowed", "ours", "ours_std", "deviation"),
        *("verdict", "explanation", "predicted", "predicted_std", "checked", "why"),
    )
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


def _figure_file(job: Job, name: str, kind: str, sources: list[str]) -> Result:
    key = content_key("paper figure", {"name": name, "kind": kind}, sources)
    return Result(Item("figure", name, form=f"{{}}.{kind}"), job.path(FOLDER, name, ending=f".{kind}"), key)


def _figure_task(name: str, files: Sequence[Result]) -> Task:
    """Return the task of a figure; it is the one of its first file to be made, and makes the others beside it."""
    first, *others = sorted(files, key=lambda file: (file.is_made, not file.path.exists()))
    to_make = (first, *(file for file in others if not file.is_made))
    module, function = Path(__file__).stem, write_figure.__name__
    return Task.of(first, partial(write_shipped, module=module, function=function, name=name, files=to_make))


def write_figure(job: Job, part: Path, name: str, files: Sequence[Result]) -> None:
    """Draw a figure once; write it to the part, which becomes the first of its files, and to the others.

    Raises
    ------
    InputError
        When the results do not allow the figure, for any reason.
    """
    try:
        figure = figure_of(FIGURES[name](_results(job)))
    except (DataError, UsageError) as error:
        raise InputError(str(error)) from None

    def write(file: Result, path: Path) -> None:
        save_figure(figure, path, kind=file.path.suffix[1:], note=f"content_key: {file.key}")

    write(files[0], part)
    for file in files[1:]:
        outcome = produce(job, file, partial(write, file))
        if outcome.state == "failed":
            raise DataError(outcome.text)


@lru_cache(maxsize=1)
def _results(job: Job) -> PaperResults:
    """Return the results, which a worker reads once for all figures."""
    return PaperResults(job)


def _table(
    job: Job, results: PaperResults, name: str, make: Callable[[PaperResults], Table], sources: list[str]
) -> list[Outcome]:
    table = make(results)
    outcomes = []
    for ending, text in ((".csv", csv_text(table)), (".md", markdown_table(table))):
        key = content_key("paper table", {"name": name, "kind": ending, "text": text}, sources)
        write = partial(_write_text, partial(_with_key, partial(str, text), ending, key))
        item = Item("table", name, form=f"{{}}{ending}")
        outcomes.append(produce(job, Result(item, job.path(FOLDER, name, ending=ending), key), write))
    return outcomes


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
