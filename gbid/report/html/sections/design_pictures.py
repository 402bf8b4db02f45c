"""Pictures of a design at its worst operating point: root locus, damping map, sensitivities, impact responses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gbid.control import impact_response
from gbid.control.loop.curves import sensitivity_data
from gbid.operating_point import point_label
from gbid.report.figures.loop.damping_map import damping_map_data, plot_damping_map
from gbid.report.figures.loop.eigenvalues import plot_root_locus, root_locus_data
from gbid.report.figures.loop.impact_curves import ImpactCurves, plot_impact
from gbid.report.figures.loop.magnitudes import plot_magnitudes, sensitivity_curves
from gbid.report.html.page import Block, Gallery, Shown, Words
from gbid.report.html.pictures import Pictures
from gbid.report.reader.designs import AssessedDesign
from gbid.structure import LinearModel

_GRID = 11
_FACTORS = np.linspace(0.0, 1.3, 66)
_SHOWN_S = 0.1


def design_pictures(pictures: Pictures, design: AssessedDesign) -> list[Block]:
    """Return pictures of a design at its worst operating point, and of its damping over the operating range."""
    worst, point = design.figures.worst["damping"]
    row = int(np.flatnonzero((design.figures.points == point).all(axis=1))[0])
    place, plant, controller = point_label(*point), design.plant.plant_at(*point), design.at(point)
    title = f"{design.name}, {place}"
    locus = root_locus_data(
        plant, lambda f: replace(controller, C=f * controller.C, D=f * controller.D), _FACTORS, title=title
    )
    curves = sensitivity_curves(sensitivity_data(plant, controller, np.geomspace(5.0, 1000.0, 300)), title)
    peak, control = (design.figures.at(row)[name] for name in ("peak_output", "peak_control"))
    alt = f"Sensitivities of {title}: peak of S_o {peak:.2f}, of K S_o {control:.2f}"
    words = f"at its worst operating point, {place}: smallest damping factor {worst:.3f}"
    shown: list[Block] = [
        Shown(pictures.picture(plot_root_locus(locus), f"Root locus over a factor on the gains of {title}")),
        _damping_map(pictures, design),
        *(_impact(pictures, design, plant, controller, place, axis) for axis in "xy"),
    ]
    return [
        Words(f"Pictures of {design.name}, {words}."),
        Gallery(shown),
        Shown(pictures.picture(plot_magnitudes(curves), alt)),
    ]


def _damping_map(pictures: Pictures, design: AssessedDesign) -> Block:
    data = damping_map_data(design.plant, design.at, n=_GRID, points=design.figures.points, title=design.name)
    alt = (
        f"Smallest damping factor of {design.name} over pressure and speed, from {data.damping.min():.3f} to "
        f"{data.damping.max():.3f}; operating points marked"
    )
    return Shown(pictures.picture(plot_damping_map(data), alt))


def _impact(
    pictures: Pictures, design: AssessedDesign, plant: LinearModel, controller: LinearModel, place: str, axis: str
) -> Block:
    impact = design.impact.towards({"x": 0.0, "y": 90.0}[axis])
    opened, closed = (impact_response(plant, k, impact, duration_s=_SHOWN_S) for k in (None, controller))
    if not (len(opened.time_s) and len(closed.time_s)):
        return Words(f"No impact response along {axis} at {place}: the loop is not stable.", "bad")
    i = "xy".index(axis)
    data = ImpactCurves(
        opened.time_s,
        {"open loop": opened.p[:, i], f"{design.name}": closed.p[:, i]},
        {"force": opened.force_n},
        axis,
        f"{place}, impact along {axis}",
    )
    alt = (
        f"Disc position {axis} after an impact of {impact.peak_n:g} N along {axis} at {place}: open loop up to "
        f"{1e6 * opened.peak_p_m:.1f} µm, closed loop up to {1e6 * closed.peak_p_m:.1f} µm"
    )
    return Shown(pictures.picture(plot_impact(data), alt))
