"""Section on the fits: overview, worst and best fits, failures, and each fit."""

from __future__ import annotations

from collections.abc import Sequence
from statistics import median
from typing import Any

from gbid.errors import DataError, UsageError
from gbid.experiment.stages.crossval.pairing import validate_pair
from gbid.experiment.stages.fit.plan import recordings_of
from gbid.report.html.page import Block, Fold, Link, Listed, PageSection, Templated, Words, fit_href, point_words
from gbid.report.html.traces import trace
from gbid.report.reader import Results
from gbid.report.reader.fits import MadeFit
from gbid.report.reader.standings import Standing
from gbid.report.tables.fit_summary import summary_lines
from gbid.tables.numbers import engineering, shown_unit
from gbid.tables.table import Cell, Column, Entry, Table

_NAMED = 5


def fits_section(results: Results) -> PageSection:
    """Return the section with a summary of the fits and each of them."""
    title = "Fits"
    if not results.experiment.spec.fits:
        return PageSection("fits", title, [Words("This experiment asks for no fits.")])
    blocks: list[Block] = []
    lost = lost_fits(results)
    if lost:
        rows = [(Cell(f.item, href=f"#fit&{f.item.replace('/', '%2F')}"), f.state, f.text) for f in lost]
        blocks.append(Table("Fits that are not there", [Column("fit"), Column("state"), Column("reason")], rows))
    for name in results.experiment.spec.fits:
        there = [q for q in results.fits if q.fit == name]
        if there:
            blocks += _overview(results, name, there)
    blocks += _notes(results.fits)
    data = fit_data(results)
    if data["fits"]:
        groups: dict[str, list[tuple[str, str]]] = {}
        for key, document in data["fits"].items():
            groups.setdefault(key.partition("/")[0], []).append((key, document["label"]))
        blocks.append(Templated("fit.html.j2", {"groups": groups, "data": data}))
    return PageSection("fits", title, blocks)


def lost_fits(results: Results) -> list[Standing]:
    """Return the planned fits without result."""
    return [f for f in results.standings if f.stage == "fit" and f.state != "there"]


def fit_data(results: Results) -> dict[str, Any]:
    """Return the data that the script of the page shows of each fit."""
    fits: dict[str, Any] = {}
    for q in results.fits:
        fits[f"{q.fit}/{q.model}"] = {**_document(results, q), **_curves(results, q)}
    for f in lost_fits(results):
        empty: dict[str, Any] = {"parameters": [], "modes": [], "gains": [], "facts": [], "traces": [], "no_trace": ""}
        title = {"title": f.item, "label": f"{f.item.partition('/')[2]}: {f.state}", "state": "bad"}
        fits[f.item] = {**empty, **title, "status": f"{f.state}: {f.text}"}
    order = {name: i for i, name in enumerate(results.experiment.spec.fits)}
    return {"fits": dict(sorted(fits.items(), key=lambda item: order[item[0].partition("/")[0]]))}


def _smallest(q: MadeFit) -> float:
    return float(q.result.fit_percent.min()) if q.result.fit_percent.size else float("nan")


def _place(results: Results, q: MadeFit) -> str:
    return point_words(results.experiment, q.result.recordings[0]) if q.point else "several"


def _overview(results: Results, name: str, there: Sequence[MadeFit]) -> list[Block]:
    outputs = there[0].result.model.output_names
    focus = there[0].result.options.focus
    own = "one step ahead" if focus == "prediction" else focus
    by_point: dict[str, list[MadeFit]] = {}
    for q in there:
        by_point.setdefault(_place(results, q), []).append(q)
    rows: list[list[Entry]] = []
    for point, fits in by_point.items():
        worst = min(fits, key=_smallest)
        medians = [median(float(q.result.fit_percent[:, j].mean()) for q in fits) for j in range(len(outputs))]
        link = Cell(f"{worst.model} ({_smallest(worst):.2f} %)", href=fit_href(name, worst.model))
        rows.append([point, len(fits), sum(q.result.success for q in fits), *medians, link])
    columns = [
        Column("operating point"),
        *(Column(name, format="d") for name in ("fits", "converged")),
        *(Column(output, "%", ".2f") for output in outputs),
        Column("worst"),
    ]
    caption = f"{name}: median fit on its own recording ({own}), by operating point"
    blocks: list[Block] = [Table(caption, columns, rows)]
    if len(there) > 2 * _NAMED:
        ordered = sorted(there, key=_smallest)
        for word, chosen in (("worst", ordered[:_NAMED]), ("best", ordered[: -_NAMED - 1 : -1])):
            items = [
                Link(f"{q.model}: {_smallest(q):.2f} % at {_place(results, q)}", fit_href(name, q.model))
                for q in chosen
            ]
            blocks.append(Fold(f"{name}: the {word} {_NAMED}", [Listed(items)]))
    stuck = [q for q in there if not q.result.success]
    if stuck:
        blocks.append(Words(f"{name}, not converged: {len(stuck)} of {len(there)} fits", "bad"))
        blocks.append(Listed([Link(f"{q.model}: {q.result.status}", fit_href(name, q.model)) for q in stuck]))
    return blocks


def _notes(fits: Sequence[MadeFit]) -> list[Block]:
    """Return the notes of the fits, each once, with the number of fits that have it."""
    carried: dict[str, list[MadeFit]] = {}
    for q in fits:
        for note in q.result.notes:
            carried.setdefault(f"{q.fit}: {note}", []).append(q)
    if not carried:
        return []
    items = [
        Link(f"{text} ({len(there)} {'fit' if len(there) == 1 else 'fits'})", fit_href(there[0].fit, there[0].model))
        for text, there in sorted(carried.items(), key=lambda item: -len(item[1]))
    ]
    return [Fold(f"Notes of the fits ({len(items)})", [Listed(items)])]


def _document(results: Results, q: MadeFit) -> dict[str, Any]:
    document, names = q.document, ", ".join(q.result.recordings)
    place = _place(results, q)
    state = "bad" if not q.result.success else "warn" if q.result.notes else "good"
    return {
        "title": f"{q.fit}, {q.model}: {place}" + (f" ({names})" if names != q.model else ""),
        "label": f"{place}: {q.model} ({_smallest(q):.2f} %)",
        "state": state,
        "status": _status(q),
        "parameters": [_parameter(row) for row in document["parameters"]],
        "modes": [
            [
                str(row["mode"]),
                *_pair(row["frequency_hz"], row["frequency_std_hz"]),
                *_pair(row["damping"], row["damping_std"]),
            ]
            for row in document["modes"]
        ],
        "gains": [
            [f"{row['output']} from {row['input']}", *_pair(row["gain"], row["std"])] for row in document["static_gain"]
        ],
        "facts": [list(line) for line in summary_lines(document)],
    }


def _curves(results: Results, q: MadeFit) -> dict[str, Any]:
    """Return measured and simulated curves on the recordings of a fit, or the reason why there are none."""
    shown, traces, reason = results.experiment.spec.figures.get(q.fit), [], ""
    for recording in recordings_of(results.experiment, q.fit, q.model):
        try:
            validation = validate_pair(results.job, q.fit, q.model, recording)
        except (DataError, UsageError, OSError) as error:  # UsageError: of a scheduled structure
            reason = str(error)
        else:
            traces.append(trace(validation, shown.from_s if shown else None))
    return {"traces": traces, "no_trace": reason}


def _status(q: MadeFit) -> str:
    if not q.result.success:
        return q.result.status[:1].upper() + q.result.status[1:]
    return "Converged, with notes below." if q.result.notes else "Converged."


def _parameter(row: dict[str, Any]) -> list[str]:
    factor, unit = shown_unit(row["unit"])
    estimate, std = _pair(factor * row["estimate"], None if row["std"] is None else factor * row["std"])
    truth = "–" if row["truth"] is None else engineering(factor * row["truth"])
    off = "–" if row["deviation_std"] is None else f"{row['deviation_std']:+.1f}".replace("-", "−")
    return [row["parameter"], estimate, "fixed" if row["fixed"] else std, unit or "–", truth, off]


def _pair(value: float, std: float | None) -> tuple[str, str]:
    return engineering(value), "–" if std is None else engineering(std, 2)
