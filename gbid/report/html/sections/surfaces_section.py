"""Section on the surfaces over pressure and speed, with the estimates."""

from __future__ import annotations

from typing import Literal

import numpy as np

from gbid.errors import GbidError
from gbid.lpv import LPVFit
from gbid.lpv.basis import TERMS
from gbid.report.figures.surfaces.over_pressure import modes_data, plot_over_pressure
from gbid.report.figures.surfaces.surface_panels import plot_surfaces, surfaces_data
from gbid.report.html.page import Block, Fold, Listed, PageSection, Shown, Words
from gbid.report.html.pictures import Pictures
from gbid.report.reader import Results
from gbid.structure import KEY_PARAMETERS
from gbid.tables.numbers import shown_unit
from gbid.tables.table import Column, Entry, Table

_GROUPS = {
    "stiffness": ("k_xx", "k_xy", "k_yx", "k_yy"),
    "damping": ("d_xx", "d_xy", "d_yx", "d_yy"),
    "piezo influence": ("b_xx", "b_xy", "b_yx", "b_yy"),
    "delays": ("tau_x", "tau_y"),
}
_MODES: dict[Literal["frequency", "damping"], str] = {
    "frequency": "natural frequencies",
    "damping": "damping factors",
}
LACK = 0.01
"""Probability below which the lack of fit of the surfaces is significant."""


def surfaces_section(results: Results, pictures: Pictures) -> PageSection:
    """Return the section with each surface fit."""
    title = "Surfaces over pressure and speed"
    if results.experiment.spec.lpv is None:
        return PageSection("surfaces", title, [Words("This experiment draws no surfaces (it has no section lpv).")])
    if not results.surfaces:
        text = "Not drawn with the present fits; `gbid lpv` does it, or says why it cannot."
        return PageSection("surfaces", title, [Words(text, "warn")])
    blocks: list[Block] = []
    for item, fit in results.surfaces.items():
        blocks += _drawn(item, fit, pictures, results.published)
    return PageSection("surfaces", title, blocks)


def _drawn(item: str, fit: LPVFit, pictures: Pictures, published: bool) -> list[Block]:
    asked = ", ".join(f"{key} {value}" for key, value in fit.options.items())
    n, points = len(fit.estimates.recordings), fit.estimates.points
    text = (
        f"{item}: through {n} recordings at {len(np.unique(points, axis=0))} operating points ({asked}); {fit.status}."
    )
    blocks: list[Block] = [Words(text, "" if fit.success else "bad")]
    lacking = [key for key, p in zip(KEY_PARAMETERS, fit.lack_of_fit, strict=True) if p < LACK]
    if lacking:
        blocks.append(Words(f"The surfaces miss the means of {', '.join(lacking)} by more than chance.", "warn"))
    rows: list[tuple[Entry, ...]] = []
    for d in fit.deviations:
        factor, unit = shown_unit(d.unit)
        paper = [factor * d.published_rms] if published else []
        rows.append((d.name, unit, factor * d.rms, *paper, factor * d.largest, d.recording))
    heads = ("rms", *(["paper's rms"] if published else []), "largest")
    columns = [Column(""), Column("unit"), *(Column(name, format=3) for name in heads), Column("where")]
    blocks.append(Table("What the estimates lie off the surfaces", columns, rows))
    estimates = {key: fit.estimates.values[:, i] for i, key in enumerate(KEY_PARAMETERS)}
    for i, (word, names) in enumerate(_GROUPS.items()):
        data = surfaces_data(fit.model, names, points=points, estimates=estimates, n=11)
        alt = f"{item}: {word} over injection pressure and speed as surfaces, {n} estimates on stems"
        shown = Shown(pictures.picture(plot_surfaces(data), alt))
        blocks.append(shown if i == 0 else Fold(f"{item}: {word}", [shown]))
    for what, word in _MODES.items():
        try:
            panels = modes_data(fit.model, what)
        except GbidError as error:  # surfaces without physical meaning at some point
            blocks.append(Words(f"{item}: {word} cannot be drawn: {error}", "warn"))
            continue
        alt = f"{item}: {word} of the two modes of the open loop over pressure, at three speeds"
        blocks.append(Fold(f"{item}: {word}", [Shown(pictures.picture(plot_over_pressure(panels), alt))]))
    std = np.sqrt(np.diag(fit.covariance)).reshape(-1, len(TERMS))
    table = Table(
        "Coefficients, SI per kg, per bar and rpm; in brackets the standard deviation",
        [Column("parameter"), *(Column(term, format=4) for term in TERMS)],
        [
            (key, *(f"{c:.4g} ({s:.1g})" for c, s in zip(fit.model.coefficients[key], row, strict=True)))
            for key, row in zip(KEY_PARAMETERS, std, strict=True)
        ],
    )
    blocks.append(Fold(f"{item}: coefficients", [table]))
    if fit.outliers:
        listed = [
            f"{o.recording}: {o.parameter} by {o.standardised:+.1f} robust standard deviations" for o in fit.outliers
        ]
        blocks += [
            Words(f"Far off a surface lie {len(listed)} of the estimates:", "warn"),
            Fold("Outliers", [Listed(listed)]),
        ]
    notes = [*fit.notes, *(f"left out: {text}" for text in fit.estimates.left_out)]
    if notes:
        blocks.append(Listed(notes))
    return blocks
