"""Section on the controller: comparison of designs, Pareto front, pictures of each, and the gain explorer."""

from __future__ import annotations

from collections.abc import Sequence

from gbid.control import HalfSine, close_loop
from gbid.control.assessment.point_assessment import FIGURES
from gbid.errors import GbidError
from gbid.operating_point import point_label
from gbid.report.html.explorer import explorer_part
from gbid.report.html.page import Block, Fold, Listed, PageSection, Words
from gbid.report.html.pictures import Pictures
from gbid.report.html.sections.design_pictures import design_pictures
from gbid.report.html.sections.tuned_blocks import tuned_blocks
from gbid.report.reader import Results
from gbid.report.reader.designs import AssessedDesign, conditions_words
from gbid.report.tables.tuning_tables import comparison_table
from gbid.tables.table import Column, Table

TITLE = "Controller"
_BY_POINT = (
    ("damping", "", "damping", 1.0, ".3f"),
    ("peak S_o", "", "peak_output", 1.0, ".3f"),
    ("peak K S_o", "", "peak_control", 1.0, ".3f"),
    ("static S_o", "", "static_amplification", 1.0, ".2f"),
    ("slowest decay", "Hz", "slowest_decay_hz", 1.0, ".1f"),
    ("disc", "µm", "impact_p_m", 1e6, ".2f"),
    ("stack", "µm", "stack_travel_m", 1e6, ".2f"),
    ("sampled damping", "", "sampled_damping", 1.0, ".3f"),
)
"""Heading, unit, figure, factor and format of the table by operating point."""


def controller_section(results: Results, pictures: Pictures) -> PageSection:
    """Return the section with the tuned and published designs, and the figures that the tuning stored."""
    designs, model, words = results.assessed, results.loop_model, loop_words(results)
    blocks: list[Block] = []
    if model is None and not designs:
        return PageSection("controller", TITLE, [Words(words, "warn")])
    if not results.designs.found:
        text = "This experiment designed no controller; the gains shown are those that came with the machine."
        blocks.append(Words(text))
    for group in dict.fromkeys(design.group for design in designs):
        blocks += _compared([design for design in designs if design.group == group])
    blocks += tuned_blocks(results, pictures)
    try:
        blocks += [block for design in designs if design.came for block in _modes(results, design)][:1]
    except GbidError as error:  # surfaces without physical meaning at some point
        blocks.append(Words(f"modes cannot be compared: {error}", "warn"))
    for i, design in enumerate(designs):
        try:
            drawn = [*design_pictures(pictures, design), _by_point(design)]
        except GbidError as error:
            drawn = [Words(f"{design.name} cannot be drawn: {error}", "warn")]
        blocks += drawn if i == 0 else [Fold(f"Pictures of {design.name}", drawn)]
    if model is not None:
        impact = designs[0].impact if designs else HalfSine()
        shown = [(design.name, design.structure, design.figures.gains) for design in designs]
        blocks.append(explorer_part(model, words, model.operating_points, shown, impact))
    return PageSection("controller", TITLE, blocks)


def loop_words(results: Results) -> str:
    """Return a description of the model on which the explorer closes loops, or the reason why there is none."""
    model, surfaces = results.loop_model, results.surfaces
    for item, fit in surfaces.items():
        if fit.model is model:
            return f"the surfaces {item} of this experiment"
    if model is not None:
        why = "have no actuators (lpv: actuators)" if surfaces else "were not drawn here"
        return f"the model {model.name} behind the virtual rig, because surfaces {why}"
    if surfaces:
        return "The surfaces have no actuators, so no loop can be closed; add lpv: actuators."
    return "No loop can be closed: there are no surfaces over pressure and speed (section lpv)."


def _compared(designs: Sequence[AssessedDesign]) -> list[Block]:
    first = designs[0]
    points = first.figures.points
    where = point_label(*points[0]) if len(points) == 1 else f"{len(points)} operating points"
    words = conditions_words(first.impact, first.sample_time, first.method)
    gains = [
        f"{d.name}: " + ", ".join(f"{key} = {value:.4g}" for key, value in d.figures.gains.items()) for d in designs
    ]
    title = f"Designs on {first.plant.name}, worst over {where}"
    return [comparison_table(title, [design.figures for design in designs], words), Listed(gains)]


def _modes(results: Results, design: AssessedDesign) -> list[Block]:
    """Return a table of the modes in the paper, and those of this model with the published gains."""
    source = design.plant if design.plant.reference_modes else results.rig
    rows = []
    for known in source.reference_modes if source is not None else ():
        point = (known.pressure_bar, known.speed_rpm)
        if known.kind != "expected" or not design.plant.domain.contains(*point):
            continue
        plant = design.plant.plant_at(*point)
        found = (close_loop(plant, design.at(point)) if known.loop == "closed" else plant).modes()
        for k, (frequency, damping) in enumerate(known.modes):
            rows.append(
                (
                    f"{point_label(*point)}, {known.loop} loop, mode {k + 1}",
                    found[k][0] if k < len(found) else None,
                    frequency,
                    found[k][1] if k < len(found) else None,
                    damping,
                    known.source,
                )
            )
    if not rows:
        return []
    columns = [
        Column("where"),
        *(Column(name, "Hz", ".1f") for name in ("frequency", "paper")),
        *(Column(name, format=".3f") for name in ("damping", "paper")),
        Column("source"),
    ]
    return [Table("Modes with the published gains, beside the paper's", columns, rows)]


def _by_point(design: AssessedDesign) -> Block:
    rows = [
        (point_label(*point), *(factor * figures[FIGURES.index(name)] for _, _, name, factor, _ in _BY_POINT))
        for point, figures in zip(design.figures.points, design.figures.figures.tolist(), strict=True)
    ]
    columns = [Column("operating point"), *(Column(name, unit, form) for name, unit, _, _, form in _BY_POINT)]
    return Fold(f"{design.name} at each operating point", [Table(design.name, columns, rows)])
