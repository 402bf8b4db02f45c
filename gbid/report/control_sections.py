"""Section on the controller: comparison of designs, Pareto front, pictures of each, and the gain explorer."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import zip_longest
from math import isnan
from typing import Any, Literal

import numpy as np

from gbid.control import HalfSine, PStructure, close_loop, impact_response
from gbid.control.assessment import FIGURES as POINT_FIGURES
from gbid.control.assessment import TunedDesign
from gbid.control.loop.sensitivity import sensitivity_data
from gbid.core.arrays import FloatArray, point_label
from gbid.core.errors import GbidError, UsageError
from gbid.core.tables import Column, Entry, Row, Table
from gbid.experiment.controllers import published_machine
from gbid.experiment.stages.loop import made_costs
from gbid.lpv import LPVFit, LPVModel
from gbid.lpv.model import TERMS
from gbid.report.control_tables import (
    assessment_tables,
    comparison_table,
    cycle_documents,
    cycle_summary,
    design_tables,
    gains_words,
    impact_documents,
    impact_tables,
    loop_documents,
    loop_tables,
    tuning_documents,
)
from gbid.report.fit_tables import lpv_document, lpv_table
from gbid.report.impact_pictures import ImpactCurves, impact_loops_data, plot_impact, plot_impact_loops
from gbid.report.loop_pictures import (
    damping_map_data,
    designs_pareto_data,
    plot_damping_map,
    plot_magnitudes,
    plot_pareto,
    plot_robustness_price,
    plot_root_locus,
    root_locus_data,
)
from gbid.report.page import Block, Fold, Gallery, Listed, PageSection, Pictures, Shown, Templated, Words
from gbid.report.read import NO_IMPACT, AssessedDesign, Results, conditions_words, place_of
from gbid.report.surface_pictures import over_pressure_data, plot_over_pressure, plot_surfaces, surfaces_data
from gbid.structure import KEY_PARAMETERS, LinearModel

# ---- Pictures of a design at its worst operating point: root locus, damping map, sensitivities, impact responses.

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
    frequency = _shown_frequencies(plant, design.sample_time)
    data = sensitivity_data(plant, controller, frequency)
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
        Shown(pictures.picture(plot_magnitudes(data, title=title), alt)),
    ]


def _shown_frequencies(plant: LinearModel, sample_time: float) -> FloatArray:
    """Return frequencies from a thirtieth of the slowest mode to ten times the fastest, up to half the rate [Hz]."""
    modes = [frequency for frequency, _ in plant.modes()] or [1e-3 / sample_time]
    highest = 0.5 / sample_time
    return np.geomspace(min(min(modes) / 30, highest / 10), min(10 * max(modes), highest), 300)


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
    if design.impact.mass_kg is None:
        return Words(NO_IMPACT)
    impact = design.impact.towards({"x": 0.0, "y": 90.0}[axis])
    opened, closed = (impact_response(plant, k, impact, duration_s=_SHOWN_S) for k in (None, controller))
    if not (len(opened.time_s) and len(closed.time_s)):
        return Words(f"No impact response along {axis} at {place}: the loop is not stable.", "bad")
    i = "xy".index(axis)
    curves = {"open loop": opened.p[:, i], f"{design.name}": closed.p[:, i]}
    data = ImpactCurves(opened.time_s, curves, {"force": opened.force_n}, axis, f"{place}, impact along {axis}")
    alt = (
        f"Disc position {axis} after an impact of {impact.peak_n:g} N along {axis} at {place}: open loop up to "
        f"{1e6 * opened.peak_p_m:.1f} µm, closed loop up to {1e6 * closed.peak_p_m:.1f} µm"
    )
    return Shown(pictures.picture(plot_impact(data), alt))


# ---- Blocks on the results of the tuning: objective, active limits, goals, promises, notes, and the Pareto front.


def held_back(design: TunedDesign) -> list[str]:
    """Return the warnings of a design: limits that are not met, and gains on their bounds."""
    result = design.result
    texts = []
    if not result.success:
        texts.append(f"{result.status}, limits exceeded by {100 * result.violation:.2g} %")
    stuck = [text for text in result.active if text.endswith("bound")]
    if stuck:
        texts.append(f"limited by {', '.join(stuck)}; wider bounds may damp more")
    texts += [f"under the cap {cap:g}: {entry.status}" for cap, entry in design.front if not entry.success]
    return texts


def tuned_blocks(results: Results, pictures: Pictures) -> list[Block]:
    """Return blocks with the tuning result of each design, and all designs over robustness and damping."""
    tuned = results.designs.made
    blocks: list[Block] = [Words(f"{name}: {text}", "warn") for name, text in results.designs.missing.items()]
    if not tuned:
        return blocks
    blocks += [Words(f"{name}: {text}", "warn") for name, design in tuned.items() for text in held_back(design)]
    drawn_over = {design.name for design in results.assessed}
    documents = tuning_documents((), tuned)
    blocks += assessment_tables([document for document in documents if document["design"] not in drawn_over])
    blocks += design_tables(documents)
    if any(design.promises for design in tuned.values()):
        words = "Promised objective of robust designs over the probability; the table above has its numbers"
        blocks.append(Shown(pictures.picture(plot_robustness_price(tuned), words)))
    try:
        data = designs_pareto_data(tuned)
    except GbidError as error:
        return [*blocks, Words(f"The Pareto front cannot be drawn: {error}", "warn")]
    reached = "; ".join(
        f"{label} " + ", ".join(f"{z:.3f} at {peak:.2f}" for peak, z in front) for label, front in data.fronts.items()
    )
    alt = f"Smallest damping factor over the peak of the output sensitivity: {reached}"
    drawn = sum(map(len, data.fronts.values())) + len(data.designs)
    return [*blocks, Shown(pictures.picture(plot_pareto(data), alt))] if drawn > 1 else blocks


TITLE = "Controller"
_BY_POINT = (
    *("damping", "peak_output", "peak_control", "static_amplification", "slowest_decay_hz"),
    *("impact_p_m", "stack_travel_m", "sampled_damping"),
)
"""Figures of the table by operating point."""


def controller_section(results: Results, pictures: Pictures) -> PageSection:
    """Return the section with the tuned and published designs, and the figures that the tuning stored."""
    designs, model, words = results.assessed, results.loop_model, loop_words(results)
    blocks: list[Block] = []
    if model is None and not results.designs.made:
        return PageSection("controller", TITLE, [Words(words, "warn")])
    if not results.designs.made:
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
        impact = designs[0].impact if designs else HalfSine().on(model.machine)
        shown = [(design.name, design.structure, design.figures.gains) for design in designs]
        blocks.append(explorer_part(model, words, shown, impact))
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
    gains = [f"{d.name}: {gains_words(d.figures.gains)}" for d in designs]
    title = f"Designs on {first.plant.name}, worst over {where}"
    return [comparison_table(title, [design.figures for design in designs], words), Listed(gains)]


def _modes(results: Results, design: AssessedDesign) -> list[Block]:
    """Return a table of the modes in the paper, and those of this model with the published gains."""
    source = published_machine(results.experiment, results.experiment.spec.controller.get(design.group))
    rows: list[list[Entry]] = []
    for known in source.reference_modes if source is not None else ():
        point = (known.pressure_bar, known.speed_rpm)
        if known.kind != "expected" or not design.plant.domain.contains(*point):
            continue
        plant = design.plant.plant_at(*point)
        modes = (close_loop(plant, design.at(point)) if known.loop == "closed" else plant).modes()
        pairs = zip_longest(known.modes, modes[: len(known.modes)], fillvalue=(None, None))
        for k, ((frequency, damping), (ours, our_damping)) in enumerate(pairs, 1):
            where = f"{point_label(*point)}, {known.loop} loop, mode {k}"
            rows.append([where, ours, frequency, our_damping, damping, known.source])
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
    shown = {name: POINT_FIGURES[name] for name in _BY_POINT if not isnan(design.figures.worst[name][0])}
    rows: list[list[Entry]] = [
        [point_label(*point), *(figure.factor * design.figures.at(i)[name] for name, figure in shown.items())]
        for i, point in enumerate(design.figures.points)
    ]
    columns = [Column("operating point"), *(Column(figure.heading, format=figure.format) for figure in shown.values())]
    return Fold(f"{design.name} at each operating point", [Table(design.name, columns, rows)])


# ---- Data of the gain explorer in the page: numbers of the model, ranges, and gains at the start.

PEAK_SENSITIVITY = 2.6
"""Largest peak of S_o without a warning: the default cap of `gbid.tune`."""
GAIN_RANGE = (-1.0, 3.0)
CORNER_RANGE = (100.0, 2500.0)
FREQUENCY_RANGE = (5.0, 1000.0)


def explorer_model(model: LPVModel, impact: HalfSine) -> dict[str, Any]:
    """Return the numbers from which the page computes the loop.

    Parameters
    ----------
    model : LPVModel
        Model with actuators.
    impact : HalfSine
        Impact; the page chooses its direction.

    Returns
    -------
    dict
        coefficients (Eq. 16), actuators (Eq. 12), pade_order, impact (peak [N], duration [s], mass [kg]; None
        without a moving mass), frequency [Hz] (first and last), peak_sensitivity.
    """
    return {
        "name": model.name,
        "coefficients": {key: list(values) for key, values in model.coefficients.items()},
        "actuators": dict(model.actuators),
        "pade_order": model.pade_order,
        "impact": None
        if impact.mass_kg is None
        else {"peak": impact.peak_n, "duration": impact.duration_s, "mass": impact.mass_kg},
        "frequency": list(FREQUENCY_RANGE),
        "peak_sensitivity": PEAK_SENSITIVITY,
    }


def explorer_part(
    model: LPVModel,
    words: str,
    designs: Sequence[tuple[str, Any, Mapping[str, float]]],
    impact: HalfSine,
) -> Templated:
    """Return the gain explorer as a block of the page.

    Parameters
    ----------
    model : LPVModel
        Model with actuators. The explorer starts at its operating point nearest to the middle of the domain.
    words : str
        Description of the model.
    designs : sequence of (name, structure, gains)
        Designs. P controllers with a first-order low-pass become buttons; the explorer starts with the last of them.
    impact : HalfSine
        Impact of the response.
    """
    buttons: list[tuple[str, list[float | None]]] = [("no feedback", [0.0, 0.0, None])]
    for name, structure, gains in designs:
        if isinstance(structure, PStructure) and structure.order == 1:
            corner = 1e3 * gains["lowpass_khz"] if structure.tune_corner else structure.lowpass_hz
            buttons.append((name, [gains["kappa_x"], gains["kappa_y"], corner]))
    pressures, speeds = ranges = model.domain.pressure_bar, model.domain.speed_rpm
    middle = sum(pressures) / 2, sum(speeds) / 2

    def far(point: tuple[float, float]) -> float:
        parts = zip(point, middle, ranges, strict=True)
        return sum(abs(value - centre) / (high - low or 1) for value, centre, (low, high) in parts)

    start = min(model.operating_points, key=far, default=middle)
    gain_x, gain_y, lowpass = buttons[-1][1]
    controls = [
        ("pressure", "Injection pressure", "bar", *pressures, 0.05, start[0]),
        ("speed", "Speed", "rpm", *speeds, 50, start[1]),
        ("kappa_x", "Gain κx", "m/m", *GAIN_RANGE, 0.005, gain_x),
        ("kappa_y", "Gain κy", "m/m", *GAIN_RANGE, 0.005, gain_y),
        ("corner", "Low-pass corner", "Hz", *CORNER_RANGE, 10, lowpass or 1000.0),
    ]
    keys = ("name", "label", "unit", "low", "high", "step", "value")
    return Templated(
        "explorer.html.j2",
        {
            "words": words,
            "model": explorer_model(model, impact),
            "controls": [dict(zip(keys, control, strict=True)) for control in controls],
            "buttons": buttons,
        },
    )


# ---- Section on the identification-for-control cycle: its rounds.


def cycle_section(results: Results) -> PageSection | None:
    """Return the section with the rounds of the cycle; None when the experiment has none."""
    section = results.experiment.spec.cycle
    if section is None:
        return None
    block: Block = Words("the cycle is not complete; run `gbid cycle` or `gbid run`", "warn")
    if results.cycle:
        block = cycle_summary(cycle_documents(results.cycle))
    elif not section.in_run:
        block = Words("`gbid cycle` runs the rounds; `gbid run` leaves them out")
    return PageSection("cycle", "Cycle", [block])


# ---- Section on the impacts: modes identified from hammer impacts, compared with the model and the paper.


def impacts_section(results: Results, pictures: Pictures) -> PageSection | None:
    """Return the section with the impact studies; None when the experiment has none."""
    if results.experiment.spec.impacts is None:
        return None
    studies = results.studies.made
    paths = {name: results.job.path("impacts", name) for name in studies}
    blocks: list[Block] = []
    for loops in map(results.labelled, results.loops):
        where = place_of(next(iter(loops.values())).conditions)
        alt = (
            f"Disc on the rig at {where} after the same impact along x and along y: {', '.join(loops)}; lines are "
            "means over the impacts, bands a standard deviation"
        )
        try:
            blocks.append(Shown(pictures.picture(plot_impact_loops(impact_loops_data(loops)), alt)))
        except UsageError as error:
            blocks.append(Words(f"{where}: {error}", "warn"))
    blocks += [Words(why, "warn") for why in results.studies.missing.values()]
    blocks += impact_tables(impact_documents(results.experiment, studies, paths))
    return PageSection("impacts", "Impacts", blocks)


# ---- Section on recordings in closed loop: what the loop costs in precision.


def loops_section(results: Results) -> PageSection | None:
    """Return the section with standard deviations in the loop and without; None when no fit stands beside another."""
    fits = results.experiment.spec.fits.values()
    if not any(fit.loop is not None and fit.loop.beside for fit in fits):
        return None
    missing = [Words("the comparison is not made yet; run `gbid run`", "warn")]
    return PageSection("loops", "Loops", loop_tables(loop_documents(made_costs(results.job))) or missing)


# ---- Section on the surfaces over pressure and speed, with the estimates.

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
        path = results.job.path("lpv", item, ending=".yaml").relative_to(results.experiment.results)
        blocks += _drawn(pictures, fit, lpv_document(item, fit, path, published=results.published))
    return PageSection("surfaces", title, blocks)


def _drawn(pictures: Pictures, fit: LPVFit, document: Row) -> list[Block]:
    item, n, points = document["item"], document["recordings"], fit.estimates.points
    blocks: list[Block] = [] if fit.success else [Words(f"{item}: {fit.status}.", "bad")]
    lacking = [key for key, p in document["lack_of_fit"].items() if p < LACK]
    if lacking:
        blocks.append(Words(f"The surfaces miss the means of {', '.join(lacking)} by more than chance.", "warn"))
    blocks.append(lpv_table(document))
    estimates = {key: fit.estimates.values[:, i] for i, key in enumerate(KEY_PARAMETERS)}
    for i, (word, names) in enumerate(_GROUPS.items()):
        data = surfaces_data(fit.model, names, points=points, estimates=estimates, n=11)
        alt = f"{item}: {word} over injection pressure and speed as surfaces, {n} estimates on stems"
        shown = Shown(pictures.picture(plot_surfaces(data), alt))
        blocks.append(shown if i == 0 else Fold(f"{item}: {word}", [shown]))
    for what, word in _MODES.items():
        try:
            speeds = np.unique(np.linspace(*fit.model.domain.speed_rpm, 3))
            panels = over_pressure_data(fit.model, what, speeds_rpm=speeds)
        except GbidError as error:  # surfaces without physical meaning at some point
            blocks.append(Words(f"{item}: {word} cannot be drawn: {error}", "warn"))
            continue
        where = ", ".join(f"{speed:g}" for speed in speeds)
        alt = f"{item}: {word} of the two modes of the open loop over pressure, at {where} rpm"
        blocks.append(Fold(f"{item}: {word}", [Shown(pictures.picture(plot_over_pressure(panels), alt))]))
    coefficients = [
        (key, *(f"{c:.4g} ({s:.1g})" for c, s in zip(values, document["coefficients_std"][key], strict=True)))
        for key, values in document["coefficients"].items()
    ]
    title = "Coefficients, SI per kg, per bar and rpm; in brackets the standard deviation"
    columns = [Column("parameter"), *(Column(term, format=4) for term in TERMS)]
    blocks.append(Fold(f"{item}: coefficients", [Table(title, columns, coefficients)]))
    if document["left_out"]:
        blocks.append(Listed([f"left out: {text}" for text in document["left_out"]]))
    return blocks
