"""Section on the impacts: what the impacts of a hammer say of the modes, beside the model and the paper."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from gbid.control.impact.impact_store import load_impacts
from gbid.control.impact.study import ImpactStudy
from gbid.errors import UsageError
from gbid.experiment.run.perform import standing
from gbid.experiment.stages.impact.stage import loops_without_controller, study_tasks
from gbid.operating_point import point_label
from gbid.report.html.gather import Gathered
from gbid.report.html.page import Block, Section, Shown, Table, Words
from gbid.report.html.pictures import Pictures
from gbid.report.impact_loops import impact_loops_data, plot_impact_loops
from gbid.report.tables.impact_tables import IMPACT_FIGURES, impact_document

TITLE = "Impacts"
_QUANTITIES = (("frequency", " [Hz]", ".1f"), ("damping", "", ".3f"))


def impacts_section(gathered: Gathered, pictures: Pictures) -> Section | None:
    """Show the impact studies; None when the experiment asks for none."""
    section = gathered.experiment.spec.impacts
    if section is None:
        return None
    studies, blocks = _studies(gathered)
    came = gathered.rig.reference_modes if gathered.rig is not None else ()
    published = [modes for modes in came if modes.loop == "open" or section.controller == "paper"]
    modes: list[list[str]] = []
    responses: list[list[str]] = []
    impacts: list[list[str]] = []
    for name, study in studies.items():
        document = impact_document(name, study, gathered.experiment.results, published)
        where = f"{point_label(document['pressure_bar'], document['speed_rpm'])}, {document['loop']} loop"
        paper = document["published"].get("measured")
        modes += [_mode(where, row, None if paper is None else paper[row["mode"] - 1]) for row in document["modes"]]
        for row in document["responses"]:
            impacts.append([row["recording"], where, *(_figure(row, *figure) for figure in IMPACT_FIGURES)])
            scale = f"{row['force_scale [1/kg]']:.4f} ± {row['force_scale_std [1/kg]']:.4f}"
            responses.append([row["recording"], where, str(row["impacts"]), scale, f"{row['fit_along [%]']:.1f}"])
        blocks += [Words(f"{where}: {note}", "warn") for note in document["notes"]]
        if not document["success"]:
            tone = "" if study.ringdown.aperiodic else "bad"
            blocks.append(Words(f"{where}: {document['status']}", tone))
    if modes:
        heads = [
            f"{word} {what}{unit}"
            for what, unit, _ in _QUANTITIES
            for word in ("expected", "as it runs", "from impacts", "paper's")
        ]
        caption = "Modes expected from the model, expected of the sampled loop, and obtained from the impacts"
        blocks.insert(0, Table(caption, ("where", *heads), modes))
    if responses:
        columns = ("recording", "where", "impacts", "force scale [1/kg]", "fit along the impact [%]")
        blocks.append(Table("Measured against simulated responses", columns, responses, left=("where",)))
        columns = ("recording", "where", "disc up to [µm]", "over after [ms]", "piezo up to [µm]")
        caption = "After an impact: mean ± standard deviation, simulated in brackets; over: 95 % of the energy"
        blocks.append(Table(caption, columns, impacts, left=("where",)))
    return Section("impacts", TITLE, [*_pictured(pictures, studies, section.controller), *blocks])


def _pictured(pictures: Pictures, studies: Mapping[str, ImpactStudy], controller: str) -> list[Block]:
    """Draw the responses of all loops to the same impact, operating point by operating point."""
    points: dict[str, dict[str, ImpactStudy]] = {}
    for study in studies.values():
        closed = "published gains" if controller == "paper" else "closed loop"
        label = {"open": "open loop", "closed": closed}.get(study.loop, study.loop)
        where = point_label(study.conditions["pressure_bar"], study.conditions["speed_rpm"])
        points.setdefault(where, {})[label] = study
    blocks: list[Block] = []
    for where, loops in points.items():
        alt = (
            f"Disc on the rig at {where} after the same impact along x and along y: {', '.join(loops)}; lines are "
            "means over the impacts, bands a standard deviation"
        )
        try:
            blocks.append(Shown(pictures.picture(plot_impact_loops(impact_loops_data(loops)), alt)))
        except UsageError as error:
            blocks.append(Words(f"{where}: {error}", "warn"))
    return blocks


def _studies(gathered: Gathered) -> tuple[dict[str, ImpactStudy], list[Block]]:
    """Load the studies that are there, and say of the others why they are not."""
    studies: dict[str, ImpactStudy] = {}
    blocks: list[Block] = []
    try:
        for loop, why in loops_without_controller(gathered.experiment).items():
            blocks.append(Words(f"{loop} loop: {why}", "warn"))
        for task in study_tasks(gathered.job):
            outcome = standing(gathered.job, task)
            if outcome is not None and outcome.state != "failed":
                studies[task.item] = load_impacts(task.path)
            else:
                text = "not made yet; `gbid impact` makes it" if outcome is None else outcome.text
                blocks.append(Words(f"{task.item}: {text}", "warn"))
    except UsageError as error:
        blocks.append(Words(str(error), "warn"))
    return studies, blocks


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
