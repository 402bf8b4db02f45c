"""Section on the controller: designs side by side, the Pareto front, pictures of each, and the gain explorer."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gbid.control import (
    Assessment,
    Scheduled,
    assess,
    close_loop,
    compare_designs,
    controller_at,
    controller_structure,
    impact_response,
    smallest_damping,
)
from gbid.control.loop.curves import sensitivity_data
from gbid.errors import GbidError
from gbid.lpv import LPVModel
from gbid.operating_point import point_label
from gbid.report.eigenvalues import plot_root_locus, root_locus_data
from gbid.report.frequency import plot_magnitudes, sensitivity_curves
from gbid.report.html.explorer import explorer_part
from gbid.report.html.gather import Gathered
from gbid.report.html.page import Block, Fold, Gallery, Listed, Section, Shown, Table, Words
from gbid.report.html.pictures import Picture, Pictures
from gbid.report.html.tuned_blocks import tuned_blocks
from gbid.report.impact import ImpactCurves, plot_impact
from gbid.report.tuning import DampingMap, plot_damping_map
from gbid.structure import LinearModel
from gbid.structure.linear import Structure

TITLE = "Controller"
_GRID = 11
_FACTORS = np.linspace(0.0, 1.3, 66)
_SHOWN_S = 0.1


@dataclass(frozen=True, eq=False)
class Design:
    """A controller that is looked at: its structure, gains, and how it did."""

    name: str
    structure: Structure | Scheduled
    gains: dict[str, float]
    assessment: Assessment

    def at(self, point: tuple[float, float]) -> LinearModel:
        """Return the controller at an operating point."""
        return controller_at(self.structure, self.gains, *point)


def loop_model(gathered: Gathered) -> tuple[LPVModel | None, str]:
    """Choose the model that loops are closed on, and say which it is.

    Returns
    -------
    LPVModel or None
        The surfaces of this experiment, else the model behind the rig; one without actuators cannot be used.
    str
        What it is, or why there is none.
    """
    for item, fit in gathered.surfaces.items():
        if fit.model.actuators:
            return fit.model, f"the surfaces {item} of this experiment"
    rig = gathered.rig
    if rig is not None and rig.actuators:
        why = "have no actuators (lpv: actuators)" if gathered.surfaces else "were not drawn here"
        return rig, f"the model {rig.name} behind the virtual rig, because surfaces {why}"
    if gathered.surfaces:
        return None, "The surfaces have no actuators, so no loop can be closed; add lpv: actuators."
    return None, "No loop can be closed: there are no surfaces over pressure and speed (section lpv)."


def controller_section(gathered: Gathered, pictures: Pictures) -> tuple[Section, list[Design]]:
    """Compare the designs, show the first of them, and add the gain explorer."""
    model, words = loop_model(gathered)
    if model is None:
        return Section("controller", TITLE, [Words(words)]), []
    points = model.operating_points or _corners(model)
    designs, faults = _designs(gathered, model, points)
    blocks: list[Block] = [Words(f"Loops are closed on {words}.")]
    own = gathered.designs[0]
    if not own:
        blocks.append(
            Words("This experiment designed no controller; the gains shown are those that came with the machine.")
        )
    blocks += [Words(text, "warn") for text in faults]
    if designs:
        blocks += _compared(designs, points)
    blocks += tuned_blocks(gathered, pictures)
    if designs:
        try:
            blocks += _modes(gathered, designs[-1], model)
        except GbidError as error:  # surfaces that make no sense somewhere
            blocks.append(Words(f"modes cannot be compared: {error}", "warn"))
    for i, design in enumerate(designs):
        try:
            drawn = _pictured(pictures, design, model)
        except GbidError as error:
            drawn = [Words(f"{design.name} cannot be drawn: {error}", "warn")]
        blocks += drawn if i == 0 else [Fold(f"Pictures of {design.name}", drawn)]
    blocks.append(explorer_part(model, words, points, [(d.name, d.structure, d.gains) for d in designs]))
    return Section("controller", TITLE, blocks), designs


def _corners(model: LPVModel) -> tuple[tuple[float, float], ...]:
    return tuple((p, n) for p in model.domain.pressure_bar for n in model.domain.speed_rpm)


def _designs(
    gathered: Gathered, model: LPVModel, points: tuple[tuple[float, float], ...]
) -> tuple[list[Design], list[str]]:
    """Assess the designs of this experiment, then the published one; say why one could not be."""
    found, faults = gathered.designs
    wanted: list[tuple[str, Structure | Scheduled, dict[str, float]]] = [
        (d.name, d.structure, dict(d.gains)) for d in found if d.structure is not None
    ]
    faults = [
        *faults,
        *(f"{d.name}: of a structure of your own; not assessed here" for d in found if d.structure is None),
    ]
    came = model.controller or (gathered.rig.controller if gathered.rig else None)
    if came is not None:
        structure = controller_structure("P", lowpass_hz=came.lowpass_hz, order=came.lowpass_order)
        wanted.append(("published P", structure, {"kappa_x": came.kappa_x, "kappa_y": came.kappa_y}))
    designs = []
    for name, form, gains in wanted:
        try:
            performance = assess(model, form, gains, points, name=name)  # type: ignore[arg-type]  # scheduled ones as well
            designs.append(Design(name, form, gains, performance))
        except GbidError as error:
            faults.append(f"{name}: {error}")
    return designs, faults


def _compared(designs: list[Design], points: tuple[tuple[float, float], ...]) -> list[Block]:
    compared = compare_designs([d.assessment for d in designs])
    impact = designs[0].assessment.impact
    caption = (
        f"Designs at their worst over {len(points)} operating points; disc and stack under a half-sine of "
        f"{impact.peak_n:g} N, {1e3 * impact.duration_s:g} ms; "
        f"sampled at {1e3 * designs[0].assessment.sample_time:g} ms with one sample for computation"
    )
    rows = [
        (heading.replace("um", "µm"), *(row[i + 1] for row in compared.rows))
        for i, heading in enumerate(compared.columns[1:])
    ]
    columns = ("figure", *(d.name for d in designs))
    gains = [f"{d.name}: " + ", ".join(f"{key} = {value:.4g}" for key, value in d.gains.items()) for d in designs]
    return [Table(caption, columns, rows), Listed(gains)]


def _modes(gathered: Gathered, design: Design, model: LPVModel) -> list[Block]:
    """Modes that the paper gives, beside those of this model; only for the paper's machine and its own gains."""
    source = model if model.reference_modes else gathered.rig
    if source is None or design.name != "published P":
        return []
    rows = []
    for known in source.reference_modes:
        point = (known.pressure_bar, known.speed_rpm)
        if known.kind != "expected" or not model.domain.contains(*point):
            continue
        plant = model.plant_at(*point)
        found = (close_loop(plant, design.at(point)) if known.loop == "closed" else plant).modes()
        for k, (frequency, damping) in enumerate(known.modes):
            rows.append(
                (
                    f"{point_label(*point)}, {known.loop} loop, mode {k + 1}",
                    f"{found[k][0]:.1f}" if k < len(found) else "–",
                    f"{frequency:.1f}",
                    f"{found[k][1]:.3f}" if k < len(found) else "–",
                    f"{damping:.3f}",
                    known.source,
                )
            )
    if not rows:
        return []
    columns = ("where", "frequency [Hz]", "paper [Hz]", "damping", "paper", "source")
    return [Table("Modes with the published gains, beside the paper's", columns, rows, left=("source",))]


def _pictured(pictures: Pictures, design: Design, model: LPVModel) -> list[Block]:
    worst = min(design.assessment.points, key=lambda q: q.damping)
    point = (worst.pressure_bar, worst.speed_rpm)
    place, plant, controller = point_label(*point), model.plant_at(*point), design.at(point)
    title = f"{design.name}, {place}"
    locus = root_locus_data(
        plant, lambda f: replace(controller, C=f * controller.C, D=f * controller.D), _FACTORS, title=title
    )
    words = f"at its worst operating point, {place}: smallest damping factor {worst.damping:.3f}"
    shown: list[Block] = [
        Shown(pictures.picture(plot_root_locus(locus), f"Root locus over a factor on the gains of {title}")),
        Shown(_map(pictures, design, model)),
    ]
    curves = sensitivity_curves(sensitivity_data(plant, controller, np.geomspace(5.0, 1000.0, 300)), title)
    alt = (
        f"Sensitivities of {title}: peak of S_o {worst.peak_output.value:.2f}, of K S_o {worst.peak_control.value:.2f}"
    )
    impacts = [_impact(pictures, design, plant, controller, place, axis) for axis in "xy"]
    return [
        Words(f"Pictures of {design.name}, {words}."),
        Gallery([*shown, *impacts]),
        Shown(pictures.picture(plot_magnitudes(curves), alt)),
        _by_point(design),
    ]


def _map(pictures: Pictures, design: Design, model: LPVModel) -> Picture:
    pressure, speed = (np.linspace(*ends, _GRID) for ends in (model.domain.pressure_bar, model.domain.speed_rpm))
    damping = np.array(
        [
            [
                smallest_damping(close_loop(model.plant_at(float(p), float(n)), design.at((float(p), float(n)))))
                for n in speed
            ]
            for p in pressure
        ]
    )
    marked = np.array([(q.pressure_bar, q.speed_rpm) for q in design.assessment.points])
    data = DampingMap(pressure, speed, damping, marked, design.name)
    alt = (
        f"Smallest damping factor of {design.name} over pressure and speed, from {damping.min():.3f} to "
        f"{damping.max():.3f}; operating points marked"
    )
    return pictures.picture(plot_damping_map(data), alt)


def _impact(
    pictures: Pictures, design: Design, plant: LinearModel, controller: LinearModel, place: str, axis: str
) -> Block:
    impact = replace(design.assessment.impact, direction_deg={"x": 0.0, "y": 90.0}[axis])
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


def _by_point(design: Design) -> Block:
    rows = [
        (
            point_label(q.pressure_bar, q.speed_rpm),
            f"{q.damping:.3f}",
            f"{q.peak_output.value:.3f}",
            f"{q.peak_control.value:.3f}",
            f"{q.static_amplification:.2f}",
            f"{q.slowest_decay_hz:.1f}",
            f"{1e6 * q.impact_p_m:.2f}",
            f"{1e6 * q.stack_travel_m:.2f}",
            f"{q.sampled_damping:.3f}",
        )
        for q in design.assessment.points
    ]
    columns = (
        "operating point",
        "damping",
        "peak S_o",
        "peak K S_o",
        "static S_o",
        "slowest decay [Hz]",
        "disc [µm]",
        "stack [µm]",
        "sampled damping",
    )
    return Fold(f"{design.name} at each operating point", [Table(design.name, columns, rows)])
