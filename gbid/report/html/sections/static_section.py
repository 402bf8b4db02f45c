"""Section on the static characterisation: map from piezos to disc, and hysteresis of the stacks."""

from __future__ import annotations

from gbid.characterise import PiezoCurve, StaticMap
from gbid.errors import DataError, UsageError
from gbid.operating_point import point_label
from gbid.report.figures.measured.piezo_staircases import piezo_data, plot_piezo_hysteresis, plot_piezo_staircase
from gbid.report.figures.measured.staircase_map import static_map_figure
from gbid.report.html.page import Block, Fold, Listed, PageSection, Shown, Words
from gbid.report.html.pictures import Pictures
from gbid.report.reader import Results
from gbid.report.tables.static_tables import static_document
from gbid.tables.table import Column, Table

_MICROMETRES = 1e6


def static_section(results: Results, pictures: Pictures) -> PageSection | None:
    """Return the section with the first static map and all piezos; None when the experiment has none."""
    kinds = [section.kind for section in results.experiment.spec.static.values()]
    if not kinds:
        return None
    blocks: list[Block] = []
    for kind, show in (("bearing", _map), ("piezo", _piezos)):
        if kind in kinds:
            try:
                blocks += show(results, pictures)
            except (DataError, UsageError) as error:
                blocks.append(Words(str(error), "warn"))
    return PageSection("static", "Static characterisation", blocks)


def _map(results: Results, pictures: Pictures) -> list[Block]:
    found: StaticMap = results.static_map
    known = {"pressure_bar", "speed_rpm"} <= set(found.conditions)
    place = point_label(found.conditions["pressure_bar"], found.conditions["speed_rpm"]) if known else ""
    rows = [
        (
            f"{row['input']} to {row['output']}",
            *(row[key] for key in ("gain", "std")),
            *(None if row[key] is None else _MICROMETRES * row[key] for key in ("rms", "largest", "hysteresis")),
        )
        for row in static_document("", found)["gains"]
    ]
    columns = [
        Column("static gain"),
        Column("value", format=4),
        Column("std", format=2),
        *(Column(name, "µm", 3) for name in ("rms off linear", "largest", "hysteresis")),
    ]
    alt = f"Steady disc position over piezo position, {place}: rising and falling plateaus with a straight line"
    blocks: list[Block] = [
        Shown(pictures.picture(static_map_figure(found), alt)),
        Table(f"From piezo to disc, {len(found.command)} plateaus, {place}", columns, rows),
    ]
    return [*blocks, Listed(found.notes)] if found.notes else blocks


def _piezos(results: Results, pictures: Pictures) -> list[Block]:
    found = results.piezos
    data = [piezo_data(*parts) for parts in found]
    curves: list[PiezoCurve] = [curve for curve, *_ in found]
    said = ", ".join(f"{_MICROMETRES * c.hysteresis:.2f} µm {_how(c)}" for c in curves)
    rows = [
        (
            f"{curve.channel}, {_how(curve)}",
            f"{_MICROMETRES * curve.hysteresis:.3f} ± {_MICROMETRES * curve.hysteresis_std:.1g}",
            100 * curve.hysteresis_share,
            100 * curve.uniformity,
        )
        for curve in curves
    ]
    columns = [
        Column("piezo"),
        Column("hysteresis", "µm"),
        *(Column(name, "%", ".2f") for name in ("of its range", "steps not alike by")),
    ]
    over_time = pictures.picture(plot_piezo_staircase(data), "Staircase of the piezo over time")
    return [
        Shown(pictures.picture(plot_piezo_hysteresis(data), f"Hysteresis of the piezo: {said}")),
        Table("Staircases of a piezo", columns, rows),
        Fold("Staircases over time", [Shown(over_time)]),
    ]


def _how(curve: PiezoCurve) -> str:
    return "in open loop" if curve.units[0] == "V" else "with its controller"
