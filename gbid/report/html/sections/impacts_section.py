"""Section on the impacts: modes identified from hammer impacts, compared with the model and the paper."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from gbid.errors import UsageError
from gbid.operating_point import point_label
from gbid.report.figures.loop.impact_bands import impact_loops_data, plot_impact_loops
from gbid.report.html.page import Block, PageSection, Shown, Words
from gbid.report.html.pictures import Pictures
from gbid.report.reader import Results
from gbid.report.tables.impact_tables import IMPACT_FIGURES, impact_document
from gbid.tables.table import Column, Entry, Table

TITLE = "Impacts"
_QUANTITIES = (("frequency", " [Hz]", ".1f"), ("damping", "", ".3f"))


def impacts_section(results: Results, pictures: Pictures) -> PageSection | None:
    """Return the section with the impact studies; None when the experiment has none."""
    section = results.experiment.spec.impacts
    if section is None:
        return None
    blocks: list[Block] = [Words(why, "warn") for why in results.studies.missing.values()]
    came = results.rig.reference_modes if results.rig is not None else ()
    published = [modes for modes in came if modes.loop == "open" or section.controller == "paper"]
    modes: list[list[str]] = []
    responses: list[list[Entry]] = []
    impacts: list[list[str]] = []
    for name, study in results.studies.found.items():
        document = impact_document(name, study, results.experiment.results, published)
        where = f"{point_label(document['pressure_bar'], document['speed_rpm'])}, {document['loop']} loop"
        paper = document["published"].get("measured")
        modes += [_mode(where, row, None if paper is None else paper[row["mode"] - 1]) for row in document["modes"]]
        for row in document["responses"]:
            impacts.append([row["recording"], where, *(_figure(row, *figure) for figure in IMPACT_FIGURES)])
            scale = f"{row['force_scale [1/kg]']:.4f} ± {row['force_scale_std [1/kg]']:.4f}"
            responses.append([row["recording"], where, row["impacts"], scale, row["fit_along [%]"]])
        blocks += [Words(f"{where}: {note}", "warn") for note in document["notes"]]
        if not document["success"]:
            tone = "" if study.ringdown.aperiodic else "bad"
            blocks.append(Words(f"{where}: {document['status']}", tone))
    if modes:
        heads = [
            f"{word} {what}{unit}"
            for what, unit, _ in _QUANTITIES
            for word in ("expected", "sampled loop", "from impacts", "paper's")
        ]
        caption = "Modes expected from the model, expected of the sampled loop, and obtained from the impacts"
        blocks.insert(0, Table(caption, [Column("where"), *(Column(head, format=4) for head in heads)], modes))
    if responses:
        place = [Column("recording"), Column("where")]
        columns = [
            *place,
            Column("impacts", format="d"),
            Column("force scale", "1/kg"),
            Column("fit along the impact", "%", ".1f"),
        ]
        blocks.append(Table("Measured against simulated responses", columns, responses))
        columns = [*place, Column("disc up to", "µm"), Column("over after", "ms"), Column("piezo up to", "µm")]
        caption = "After an impact: mean ± standard deviation, simulated in brackets; over: 95 % of the energy"
        blocks.append(Table(caption, columns, impacts))
    return PageSection("impacts", TITLE, [*_pictured(pictures, results), *blocks])


def _pictured(pictures: Pictures, results: Results) -> list[Block]:
    """Return pictures of the responses of all loops to the same impact, for each operating point."""
    blocks: list[Block] = []
    for loops in map(results.labelled, results.loops):
        conditions = next(iter(loops.values())).conditions
        where = point_label(conditions["pressure_bar"], conditions["speed_rpm"])
        alt = (
            f"Disc on the rig at {where} after the same impact along x and along y: {', '.join(loops)}; lines are "
            "means over the impacts, bands a standard deviation"
        )
        try:
            blocks.append(Shown(pictures.picture(plot_impact_loops(impact_loops_data(loops)), alt)))
        except UsageError as error:
            blocks.append(Words(f"{where}: {error}", "warn"))
    return blocks


def _figure(row: Mapping[str, Any], name: str, unit: str, factor: float) -> str:
    measured, std, simulated = (factor * row[f"{name}{suffix} [{unit}]"] for suffix in ("", "_std", "_simulated"))
    return f"{measured:.2f} ± {std:.2f} ({simulated:.2f})"


def _mode(where: str, row: Mapping[str, Any], paper: Any) -> list[str]:
    cells = [f"{where}, mode {row['mode']}"]
    for column, (what, unit, form) in enumerate(_QUANTITIES):
        known = [row.get(f"{word}_{what}{unit}") for word in ("expected", "running", "obtained", "obtained")]
        std = row.get(f"obtained_{what}_std{unit}")
        texts = ["–" if value is None or value != value else format(value, form) for value in known]
        if std is not None and std == std:
            texts[2] = f"{known[2]:{form}} ± {std:.1g}"
        texts[3] = "–" if paper is None else format(paper[column], form)
        cells += texts
    return cells
