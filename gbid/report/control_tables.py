"""Documents and tables of impacts, like Tables 3 and 4 of the paper: expected from the model, and identified."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from itertools import groupby
from math import isnan
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from gbid import control, lpv
from gbid.core.arrays import point_label
from gbid.core.tables import Cell, Column, Entry, Row, Table, formatted, shown_unit
from gbid.experiment.experiment import Experiment
from gbid.experiment.machine import rig_machine
from gbid.experiment.run import Outcome
from gbid.experiment.stages.cycle import CycleRow
from gbid.experiment.stages.loop import LoopCostRow
from gbid.report.fit_tables import keyed_table
from gbid.report.read import conditions_words

if TYPE_CHECKING:
    from gbid.control.assessment import DesignFigures, TunedDesign

_PAPER = ("open", "closed")
"""Loops in Tables 3 and 4."""


class _ModeQuantity(NamedTuple):
    """Quantity of a mode: symbol and unit, key in documents, column of published values, decimals."""

    words: str
    sign: str
    unit: str
    key: str
    column: int
    digits: int


_QUANTITIES = (
    _ModeQuantity("natural frequencies", "ω", "Hz", "frequency", 0, 1),
    _ModeQuantity("damping factors", "ζ", "", "damping", 1, 3),
)
# Heading, entry of a mode with the key of the quantity, and number of further decimals.
_LINES = (
    ("expected from model", "expected_{}", 0),
    ("expected, sampled loop", "running_{}", 0),
    ("obtained from the impacts", "obtained_{}", 2),
    ("  standard deviation", "obtained_{}_std", 2),
)


def impact_documents(
    experiment: Experiment, studies: Mapping[str, control.ImpactStudy], paths: Mapping[str, Path]
) -> list[Row]:
    """Return the documents of impact studies; the modes of the paper stand beside loops with the paper's controller."""
    section, rig = experiment.spec.impacts, experiment.spec.rig
    if section is None or rig is None:
        return []
    loops = ("open", "closed") if section.controller == "paper" else ("open",)
    published = [modes for modes in rig_machine(experiment).reference_modes if modes.loop in loops]
    return [impact_document(name, study, paths[name], published) for name, study in studies.items()]


def impact_document(
    name: str, study: control.ImpactStudy, path: Path, published: Sequence[lpv.ReferenceModes] = ()
) -> Row:
    """Return the document of an impact study as plain values.

    Parameters
    ----------
    name : str
        Name of the study.
    study : ImpactStudy
        The study.
    path : path
        File of the study.
    published : sequence of ReferenceModes
        Published modes of the machine; those of this operating point and loop are added.
    """
    from gbid.control.impact.study import mode_rows, response_rows

    ring = study.ringdown
    conditions = study.conditions["pressure_bar"], study.conditions["speed_rpm"], study.loop
    here = [m for m in published if (m.pressure_bar, m.speed_rpm, m.loop) == conditions]
    return {
        "name": name,
        "path": str(path),
        **study.conditions,
        "loop": study.loop,
        "model": study.model,
        "controller": study.controller,
        "status": ring.status,
        "success": ring.success,
        "notes": list(ring.notes),
        "impacts": ring.n_impacts,
        "lag_rates": ring.lag_rates.tolist(),
        "residual_rms": ring.residual_rms.tolist(),
        "modes": mode_rows(study),
        "published": {m.kind: [list(mode) for mode in m.modes] for m in here if m.kind in ("expected", "measured")},
        "responses": response_rows(study),
    }


def impact_tables(documents: Sequence[Row]) -> list[Table]:
    """Return tables of frequencies, damping factors, force scaling and figures, for each operating point.

    Parameters
    ----------
    documents : sequence of dict
        Documents of `impact_document`.
    """
    tables = []
    for pressure, speed in dict.fromkeys((d["pressure_bar"], d["speed_rpm"]) for d in documents):
        here = {d["loop"]: d for d in documents if (d["pressure_bar"], d["speed_rpm"]) == (pressure, speed)}
        where = point_label(pressure, speed)
        paper = {loop: document for loop, document in here.items() if loop in _PAPER}
        tables += [_quantity_table(where, paper, quantity) for quantity in _QUANTITIES if paper]
        for loop, document in here.items():
            if loop not in paper:
                shown = [(f"{q.sign}{mode}", document, mode, q) for q in _QUANTITIES for mode in (1, 2)]
                tables.append(_mode_table(f"{where}: {loop}", shown))
        responses = [row for document in here.values() for row in document["responses"]]
        title = f"{where}: measured against simulated responses, p = g_f G f"
        tables.append(keyed_table(title, _RESPONSE, responses))
        tables.append(_impact_figures_table(where, responses, list(here.values())))
    return tables


def _quantity_table(where: str, here: Mapping[str, Row], quantity: _ModeQuantity) -> Table:
    """Return the table of natural frequencies or damping factors in open and closed loop, with those of the paper."""
    shown = [
        (f"{quantity.sign}{mode},{'ol' if loop == 'open' else 'cl'}", here[loop], mode, quantity)
        for mode in (1, 2)
        for loop in _PAPER
        if loop in here
    ]
    more: list[list[Entry]] = []
    for words, kind in (("paper: expected from model", "expected"), ("paper: obtained experimentally", "measured")):
        modes = [document["published"].get(kind) for _, document, *_ in shown]
        if any(known is not None for known in modes):
            values = [
                known and known[mode - 1][quantity.column] for known, (*_, mode, _) in zip(modes, shown, strict=True)
            ]
            more.append([words, *(formatted(value, f".{quantity.digits}f") for value in values)])
    return _mode_table(f"{where}: {quantity.words}", shown, more)


def _mode_table(
    title: str, shown: Sequence[tuple[str, Row, int, _ModeQuantity]], more: Sequence[list[Entry]] = ()
) -> Table:
    """Return the table of expected and identified modes; a column is a quantity of one mode of one study."""
    rows: list[list[Entry]] = []
    closed = any(document["controller"] for _, document, *_ in shown)
    for words, entry, decimals in _LINES:
        if closed or "running" not in entry:
            rows.append([words])
            for _, document, mode, q in shown:
                name = entry.format(q.key) + (f" [{q.unit}]" if q.unit else "")
                value = next((row[name] for row in document["modes"] if row["mode"] == mode), None)
                rows[-1].append(formatted(value, f".{q.digits + decimals}f"))
    columns = [Column(heading, quantity.unit, 4) for heading, _, _, quantity in shown]
    return Table(title, [Column(""), *columns], [*rows, *more])


_RESPONSE = {
    "recording": Column("recording"),
    "impacts": Column("impacts", format="d"),
    "force_scale [1/kg]": Column("g_f", "1/kg", ".4f"),
    "force_scale_std [1/kg]": Column("std", format=".4f"),
    "fit_along [%]": Column("fit along\nthe impact", "%", ".2f"),
    "fit_x [%]": Column("fit x", "%", ".2f"),
    "fit_y [%]": Column("fit y", "%", ".2f"),
}
"""Columns of the table of measured and simulated responses, by key."""
_FIGURES = (("peak", "m", "disc up to\n"), ("decay", "s", "over after\n"), ("piezo", "m", "piezo up to\n"))
"""Figures of impacts in the rows of responses: name, unit and heading."""


def _impact_figures_table(where: str, responses: Sequence[Row], documents: Sequence[Row]) -> Table:
    """Return the table of measured and simulated motion of disc and piezos, with the notes of all tables."""
    columns = [Column("recording")]
    rows: list[list[Entry]] = [[row["recording"]] for row in responses]
    for name, unit, heading in _FIGURES:
        factor, shown = shown_unit(unit)
        columns += [Column(heading, shown, ".2f"), Column("std", format=".2f"), Column("simulated", format=".2f")]
        for row, cells in zip(responses, rows, strict=True):
            values = (row[f"{name}{suffix} [{unit}]"] for suffix in ("", "_std", "_simulated"))
            cells += [None if value is None else factor * value for value in values]
    notes = []
    for document in documents:
        notes += [f"note, {document['loop']} loop: {note}" for note in document["notes"]]
        notes += [] if document["success"] else [f"{document['loop']} loop: {document['status']}"]
    return Table(f"{where}: after an impact, mean over the impacts", columns, rows, ["", *notes] if notes else ())


# ---- Documents and tables of tuned designs and of the published controller.


def tuning_documents(outcomes: Sequence[Outcome], designs: Mapping[str, TunedDesign]) -> list[Row]:
    """Return the documents of tuned designs as plain values, with their files; failed ones are left out."""
    paths = {(o.item.stage, o.item.section): str(o.path) for o in outcomes if o.state != "failed"}
    return [
        {
            "design": name,
            "path": paths.get(("tune", name)),
            "controller": paths.get(("controller", name)),
            "plant": design.plant,
            "structure": design.performance[0].structure,
            **_result_row(design.result),
            "points": [list(point) for point in design.result.points],
            "sample_time_s": design.sample_time,
            "method": design.method,
            "impact": {name: getattr(design.impact, name) for name in ("peak_n", "duration_s", "mass_kg")},
            "performance": [_performance_row(performance) for performance in design.performance],
            "pareto": [{"cap": cap, **_result_row(result)} for cap, result in design.front],
            "promises": [{**promise._asdict(), "holds": promise.holds} for promise in design.promises],
        }
        for name, design in designs.items()
    ]


def tuning_tables(documents: Sequence[Row]) -> list[Table]:
    """Return tables that compare designs at the same points of the same plant, with their gains below.

    Parameters
    ----------
    documents : sequence of dict
        Documents of `tuning_documents`.
    """
    return [*assessment_tables(documents), *design_tables(documents)]


def assessment_tables(documents: Sequence[Row]) -> list[Table]:
    """Return the tables of the assessments of `tuning_tables`, one for designs at the same points of the same plant."""
    groups: dict[tuple[Any, ...], list[Row]] = {}
    for document in documents:
        impact = tuple(document["impact"].items())
        points = tuple(map(tuple, document["points"]))
        alike = document["plant"], points, impact, document["sample_time_s"], document["method"]
        groups.setdefault(alike, []).append(document)
    tables = []
    for (plant, points, impact, sample_time, method), group in groups.items():
        where = point_label(*points[0]) if len(points) == 1 else f"{len(points)} operating points"
        where = f", worst over {where}" if points else ""
        shown = [document["performance"][0] for document in group] + group[0]["performance"][1:]
        worst = {row["name"]: {name: figure["value"] for name, figure in row["worst"].items()} for row in shown}
        notes = [conditions_words(control.HalfSine(**dict(impact)), sample_time, method)]
        notes += [f"{row['name']} ({row['structure']}): {gains_words(row['gains'])}" for row in shown]
        tables.append(_compared(f"{plant}{where}", worst, notes))
    return tables


def gains_words(gains: Mapping[str, float]) -> str:
    """Return the gains of a controller as text."""
    return ", ".join(f"{name} = {value:.5g}" for name, value in gains.items())


def comparison_table(title: str, performances: Sequence[DesignFigures], note: str) -> Table:
    """Return the table of the worst figures of designs with equal assessment, a row for each figure.

    Parameters
    ----------
    title : str
        Title of the table.
    performances : sequence of DesignFigures
        Performance of the designs.
    note : str
        Conditions, from `gbid.report.read.conditions_words`.
    """
    worst = {p.name: {name: value for name, (value, _) in p.worst.items()} for p in performances}
    return _compared(title, worst, [note])


def _unknown(value: float | None) -> bool:
    """Return whether a figure is not known: nan, or null in a document."""
    return value is None or isnan(value)


def _compared(title: str, worst: Mapping[str, Mapping[str, float]], notes: Sequence[str]) -> Table:
    from gbid.control.assessment import FIGURES

    rows = [
        [shown.heading, *(formatted(shown.factor * figures[name], shown.format) for figures in worst.values())]
        for name, shown in FIGURES.items()
        if not all(_unknown(figures[name]) for figures in worst.values())
    ]
    return Table(title, [Column("figure"), *(Column(name, format=4) for name in worst)], rows, notes)


_OF_RESULT = (
    *("value", "objective", "status", "success", "violation", "verified_on"),
    *("peak_sensitivity", "peak_control", "static_amplification"),
)


def _result_row(result: control.GainResult) -> Row:
    return {
        "gains": dict(result.gains),
        **{name: getattr(result, name) for name in _OF_RESULT},
        "worst": {name: getattr(result.worst, name) for name in ("where", "frequency_hz", "damping")},
        "active": list(result.active),
        "goals": [asdict(figure) for figure in result.goals],
        "notes": list(result.notes),
    }


def _performance_row(performance: DesignFigures) -> Row:
    return {
        "name": performance.name,
        "structure": performance.structure,
        "gains": dict(performance.gains),
        "worst": {
            figure: {"value": value, "pressure_bar": point[0], "speed_rpm": point[1]}
            for figure, (value, point) in performance.worst.items()
        },
        "points": [
            {"pressure_bar": float(p), "speed_rpm": float(n), **performance.at(row)}
            for row, (p, n) in enumerate(performance.points)
        ],
    }


# ---- Tables of what designs reached: aim, goals, caps on the peak of S_o, and promises on drawn plants.

_EXCESS = "excess: logarithm of the value over its limit, of damping factors the limit minus the value; met at most 0"


def design_tables(documents: Sequence[Row]) -> list[Table]:
    """Return the tables of what the tuning of designs found; those without rows are left out.

    Parameters
    ----------
    documents : sequence of dict
        Documents of `tuning_documents`.
    """
    tables = (_aims(documents), _goals(documents), _caps(documents), _promises(documents))
    return [table for table in tables if table.rows]


def _aims(documents: Sequence[Row]) -> Table:
    rows: list[list[Entry]] = []
    notes = []
    for d in documents:
        worst, unit = d["worst"], " 1/s" if d["objective"] == "decay" else ""
        mode = f"{worst['frequency_hz']:.1f} Hz, damping {worst['damping']:.4f}, {worst['where']}"
        aim = f"{d['objective']} {d['value']:.4f}{unit}"
        rows.append([d["design"], d["status"], aim, mode, ", ".join(d["active"]) or None, d["verified_on"]])
        notes += [f"{d['design']}: {note}" for note in d["notes"]]
        notes += [f"{d['design']}: controller in {d['controller']}"] if d["controller"] else []
    heads = ("design", "status", "aim reached", "worst mode", "limited by", "checked")
    return Table("What the tuning found", [Column(head, wrap=True) for head in heads], rows, notes)


def _goals(documents: Sequence[Row]) -> Table:
    rows = [
        (d["design"], goal["name"], "objective" if goal["soft"] else "limit", goal["excess"], goal["where"])
        for d in documents
        for goal in d["goals"]
    ]
    columns = [Column("design"), Column("goal"), Column("kind"), Column("excess", format="+.4f"), Column("where")]
    return Table("Goals of the designs", columns, rows, [_EXCESS])


def _caps(documents: Sequence[Row]) -> Table:
    caps = sorted({row["cap"] for d in documents for row in d["pareto"]})
    rows: list[list[Entry]] = []
    for d in documents:
        reached = {row["cap"]: row["value"] if row["success"] else Cell(None, row["status"]) for row in d["pareto"]}
        if reached:
            rows.append([d["design"], d["structure"], *(reached.get(cap) for cap in caps)])
    columns = [Column("design"), Column("structure"), *(Column(f"peak {cap:g}", format=".4f") for cap in caps)]
    return Table("Aim reached under caps on the peak of S_o", columns, rows)


def _promises(documents: Sequence[Row]) -> Table:
    columns = {
        "design": Column("design"),
        "probability": Column("probability", format="g"),
        "promised": Column("promised", format=".4f"),
        "keeps_limits": Column("keeps limits", format=".3f"),
        "of_nominal": Column("nominal design", format=".4f"),
        "limits_of_nominal": Column("its limits", format=".3f"),
        "plants": Column("plants", format="d"),
        "fresh": Column("fresh", format="d"),
    }
    rows = [{"design": d["design"], **promise} for d in documents for promise in d["promises"]]
    confidences = sorted({promise["confidence"] for d in documents for promise in d["promises"]})
    note = (
        f"promised: reached with the probability, at a confidence of {', '.join(f'{100 * c:g} %' for c in confidences)}"
        ", on fresh drawn plants that the design has not seen; keeps limits: lower bound of the probability; "
        "plants: drawn plants for which it was optimised"
    )
    return keyed_table("Robust designs", columns, rows, [note])


# ---- Tables of recordings in closed loop: what the loop costs in precision, and the rounds of the cycle.

_INTERVAL, _DIGITS = 1.96, 2


def loop_documents(rows: Sequence[LoopCostRow]) -> list[Row]:
    """Return the rows as plain values, with the ratio of the standard deviations."""
    return [{**asdict(row), "ratio": row.std / row.std_beside} for row in rows]


def loop_tables(documents: Sequence[Row]) -> list[Table]:
    """Return a table for each fit in a loop and operating point.

    Parameters
    ----------
    documents : sequence of dict
        Documents of `loop_documents`.
    """
    tables = []
    columns = {
        "parameter": Column("parameter"),
        "std": Column("std in the loop", format=_DIGITS),
        "std_beside": Column("std without", format=_DIGITS),
        "ratio": Column("ratio", format=".2f"),
    }
    for (fit, point), group in groupby(documents, key=lambda row: (row["fit"], row["point"])):
        rows, notes = list(group), []
        for words, end in (("in the loop", ""), ("without", "_beside")):
            peak = formatted(rows[0][f"peak{end}"], _DIGITS, rows[0]["peak_unit"])
            shown = peak.text if isinstance(peak, Cell) else "?"
            count, length = rows[0][f"recordings{end}"], rows[0][f"duration{end}_s"]
            notes.append(f"{words}: {count} fits, recordings of {length:g} s, {rows[0]['peak_of']} up to {shown}")
        notes.append("medians over the converged fits; above a ratio of 1 the loop costs precision, below it gains")
        title = f"{fit}, {point}: what the loop costs in precision, beside {rows[0]['beside']}"
        cells = (
            {**row, **{key: formatted(row[key], _DIGITS, row["unit"]) for key in ("std", "std_beside")}} for row in rows
        )
        tables.append(keyed_table(title, columns, cells, notes))
    return tables


def cycle_documents(rows: Sequence[CycleRow]) -> list[Row]:
    """Return the rows of a cycle as plain values."""
    return [asdict(row) for row in rows]


def cycle_summary(documents: Sequence[Row]) -> Table:
    """Return the table of the rounds.

    Parameters
    ----------
    documents : sequence of dict
        Documents of `cycle_documents`.
    """
    columns = [
        Column("round", format="d"),
        Column("where"),
        Column("recordings", format="d"),
        Column("std of frequencies", "Hz"),
        Column("std of dampings"),
        Column("promised", format=".3f"),
        Column("expected", format=".3f"),
        Column("reached, 95 %"),
    ]
    notes = (
        "std: of both modes of the bearing without controller, by the surfaces of the round; promised: smallest "
        "damping of the design over all points and plants; expected: of the sampled loop at this point, by the "
        "surfaces; reached: smaller damping of both modes of the loop on the rig, measured by impacts",
    )
    rows: list[list[Entry]] = []
    for row in (CycleRow(**document) for document in documents):
        frequencies = f"{row.model_frequency_1_hz_std:.3f}, {row.model_frequency_2_hz_std:.3f}"
        dampings = f"{row.model_damping_1_std:.5f}, {row.model_damping_2_std:.5f}"
        damping, std = row.reached
        reached = f"{damping:.4f} ± {_INTERVAL * std:.4f}" if row.converged else "ring-downs not fitted"
        point = point_label(row.pressure_bar, row.speed_rpm)
        model = (row.recordings, frequencies, dampings, row.promised_damping, row.expected_damping)
        rows.append([row.round, point, *model, reached])
    return Table("Rounds of the cycle", columns, rows, notes)
