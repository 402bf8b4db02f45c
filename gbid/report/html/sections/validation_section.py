"""Sections on the cross-validation and the nominal actuator."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gbid.errors import GbidError
from gbid.experiment.stages.crossval.rows import CrossvalRow
from gbid.operating_point import point_label
from gbid.report.figures.measured.actuator_scatter import nominal_data, plot_actuator_parameters
from gbid.report.figures.measured.fit_histogram import crossval_data, plot_fit_histogram
from gbid.report.html.page import Block, Fold, Link, Listed, PageSection, Shown, Words, fit_href
from gbid.report.html.pictures import Pictures
from gbid.report.paper.numbers import paper_numbers
from gbid.report.reader import Results
from gbid.tables.table import Cell, Column, Entry, Table, formatted
from gbid.validate import ValidationSummary

_PAPERS = {"rotor_bearing": "bearing", "piezo_pair": "actuator"}
"""Names of the fits of a structure in the list of the paper."""
_HISTOGRAM = 6  # smallest number of pairs for a histogram
_LISTED = 40


def validation_section(results: Results, pictures: Pictures) -> PageSection:
    """Return the section with the fit of models on recordings to which they were not fitted."""
    asked = results.experiment.spec.crossval
    if not asked:
        return PageSection("validation", "Cross-validation", [Words("This experiment asks for no cross-validation.")])
    blocks: list[Block] = []
    for name in asked:
        if name not in results.crossval:
            blocks.append(Words(f"{name}: not validated with the present fits; `gbid crossval` does it.", "warn"))
            continue
        rows, summary = results.crossval[name]
        blocks += _validated(results, pictures, name, rows, summary)
    return PageSection("validation", "Cross-validation", blocks)


def _validated(
    results: Results, pictures: Pictures, name: str, rows: Sequence[CrossvalRow], summary: ValidationSummary
) -> list[Block]:
    paper = _paper(results.experiment.spec.fits[name].structure, summary) if results.published else {}
    table: list[list[Entry]] = []
    for j, (output, unit) in enumerate(zip(summary.output_names, summary.output_units, strict=True)):
        poor = next(pair for pair in summary.worst if pair.output == output)
        spread = "–" if np.isnan(summary.std[j]) else f"{summary.std[j]:.2g}"
        table.append(
            [
                output,
                f"{summary.mean[j]:.2f} ± {spread}",
                *([paper[output]] if paper else []),
                float(summary.least[j]),
                formatted(float(summary.infinity_norm_max[j]), ".3g", unit),
                Cell(f"model of {poor.model} on {poor.recording}", href=fit_href(name, poor.model)),
            ]
        )
    columns = [
        Column("output"),
        Column("fit, mean ± std", "%"),
        *([Column("paper", "%")] if paper else []),
        Column("least", "%", ".2f"),
        Column("largest error", format=3),
        Column("worst pair"),
    ]
    words = (
        f"{name}: {summary.n_models} models on {summary.n_recordings} recordings, {summary.n_pairs} pairs, simulated"
    )
    blocks: list[Block] = [Table(words, columns, table)]
    if paper:
        words = (
            "The paper's figures are those of 86 recordings of the real machine; noise and scatter of this rig differ."
        )
        blocks.append(Words(words))
    if summary.n_pairs >= _HISTOGRAM:
        means = "; ".join(f"{o} {m:.2f} %" for o, m in zip(summary.output_names, summary.mean, strict=True))
        picture = pictures.picture(
            plot_fit_histogram(crossval_data(summary)), f"{name}: histograms of the cross-validation fit, means {means}"
        )
        blocks.append(Shown(picture))
    missed = [row for row in rows if row.missed]
    if missed:
        text = f"{name}: {len(missed)} of {len(rows)} stay below the {missed[0].minimum_percent:g} % asked for."
        blocks.append(Words(text, "bad"))
    worst = sorted(rows, key=lambda row: row.fit_percent)[:_LISTED]
    whole = "all pairs" if len(rows) <= _LISTED else f"the worst {_LISTED} of {len(rows)}"
    pairs = Table(
        f"{name}, {whole}",
        [
            *map(Column, ("model of", "on", "output")),
            Column("fit", "%", ".2f"),
            Column("largest error", format=3),
            Column("residuals"),
        ],
        [
            (
                Cell(row.model, href=fit_href(name, row.model)),
                row.recording,
                row.output,
                row.fit_percent,
                formatted(row.infinity_norm, ".3g", row.unit),
                {None: "not tested", True: "white", False: "not white"}[row.residuals_white]
                + (f", follow {', '.join(row.residuals_follow)}" if row.residuals_follow else ""),
            )
            for row in worst
        ],
    )
    blocks.append(Fold(f"{name}: {whole}", [pairs]))
    if len(summary.points) > 1:
        points = Table(
            f"{name}, by operating point",
            [
                Column("operating point"),
                Column("pairs", format="d"),
                *(Column(output, "%", ".2f") for output in summary.output_names),
            ],
            [
                (
                    point_label(point.pressure_bar, point.speed_rpm)
                    if point.pressure_bar == point.pressure_bar
                    else None,
                    point.n_pairs,
                    *map(float, point.mean),
                )
                for point in summary.points
            ],
        )
        blocks.append(Fold(f"{name}: by operating point", [points]))
    return blocks


def _paper(structure: str, summary: ValidationSummary) -> dict[str, str]:
    """Return the fit percent in the paper for its 86 recordings (Sec. 3.8, Figs. 9 and 10), by output."""
    word = _PAPERS.get(structure)
    known = {number.id: number.value for number in paper_numbers()} if word else {}
    ids = {output: [f"{word}_{what}_{output[-1]}" for what in ("mean", "std")] for output in summary.output_names}
    if not all(key in known for keys in ids.values() for key in keys):
        return {}
    return {output: f"{known[mean]:g} ± {known[std]:g}" for output, (mean, std) in ids.items()}


def nominal_section(results: Results, pictures: Pictures) -> PageSection | None:
    """Return the section with the nominal actuator; None when the experiment has none."""
    section = results.experiment.spec.nominal
    if section is None:
        return None
    title, fit = "Nominal actuator", section.fit
    try:
        nominal = results.nominal
    except GbidError as error:
        return PageSection("actuator", title, [Words(f"There is none: {error}", "warn")])
    names = nominal.parameter_names
    alt = (
        f"Gains and poles of {len(nominal.models)} actuator models; the nominal one is {nominal.name}, "
        f"{len(nominal.outliers)} values lie off"
    )
    table = Table(
        "Parameters of the nominal actuator",
        [
            Column("parameter"),
            Column("value", format=".5g"),
            Column("std", format=".2g"),
            Column("median of all", format=".5g"),
        ],
        [
            (
                name,
                nominal.parameters[name],
                nominal.std[name],
                float(np.median(nominal.values[:, i])),
            )
            for i, name in enumerate(names)
        ],
    )
    chosen = Link(f"{nominal.name}, the most central of {len(nominal.models)} models", fit_href(fit, nominal.name))
    blocks: list[Block] = [
        Listed([chosen]),
        table,
        Shown(pictures.picture(plot_actuator_parameters(nominal_data(nominal)), alt)),
    ]
    if nominal.outliers:
        listed = [Link(f"{o.model}: {o.reason}", fit_href(fit, o.model)) for o in nominal.outliers]
        blocks += [Words(f"{len(listed)} values lie off those of the others:", "warn"), Listed(listed)]
    if nominal.left_out:
        blocks += [Words("Left out:"), Listed(nominal.left_out)]
    return PageSection("actuator", title, blocks)
