"""Report sections on designs, impacts, the identification-for-control cycle, and recordings in closed loop."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import zip_longest
from math import isnan

import numpy as np

from gbid.control.assessment import FIGURES as POINT_FIGURES
from gbid.control.assessment import (
    NO_IMPACT,
    TunedDesign,
    assessment_tables,
    comparison_table,
    conditions_words,
    design_tables,
)
from gbid.control.loop.close import close_loop
from gbid.control.loop.half_sine import impact_response
from gbid.control.loop.sensitivity import sensitivity_data
from gbid.core.arrays import FloatArray, point_label
from gbid.core.errors import GbidError, UsageError
from gbid.core.tables import Column, Entry, Table
from gbid.experiment.controllers import published_machine
from gbid.experiment.stages.cycle import rounds_table
from gbid.experiment.stages.loop import cost_tables, made_costs
from gbid.report.canvas import scheduling_words
from gbid.report.explorer import explorer_part
from gbid.report.impact_pictures import ImpactCurves, impact_loops_data, plot_impact, plot_impact_loops
from gbid.report.loop_pictures import (
    DampingMap,
    damping_map_data,
    designs_pareto_data,
    plot_cycle,
    plot_damping_map,
    plot_magnitudes,
    plot_pareto,
    plot_robustness_price,
    plot_root_locus,
    root_locus_data,
)
from gbid.report.page import Block, Fold, Gallery, PageSection, Pictures, Shown, Words
from gbid.report.read import AssessedDesign, Results, place_of
from gbid.structure import LinearModel

_GRID = 11
_FACTORS = np.linspace(0.0, 1.3, 66)
_SHOWN_S = 0.1


def design_pictures(pictures: Pictures, design: AssessedDesign) -> list[Block]:
    """Return pictures of a design: its worst operating point, and its damping over the operating range."""
    worst, point = design.figures.worst["sampled_damping"]
    row = int(np.flatnonzero((design.figures.points == point).all(axis=1))[0])
    place, plant, controller = design.figures.where(row), design.plant.plant_at(*point), design.at(point)
    title = f"{design.name}, {place}"
    locus = root_locus_data(
        plant, lambda f: replace(controller, C=f * controller.C, D=f * controller.D), _FACTORS, title=title
    )
    frequency = _shown_frequencies(plant, design.sample_time)
    data = sensitivity_data(plant, controller, frequency)
    peak, control = (design.figures.at(row)[name] for name in ("peak_output", "peak_control"))
    alt = f"Sensitivities of {title}: peak of S_o {peak:.2f}, of K S_o {control:.2f}"
    caption = (
        f"at its worst operating point, {place}: smallest damping factor {worst:.3f} {_sampled_words(design)}; root "
        "locus, sensitivities and impacts are those of the continuous loop"
    )
    shown: list[Block] = [
        Shown(pictures.picture(plot_root_locus(locus), f"Root locus over a factor on the gains of {title}")),
        *([_damping_map(pictures, design)] if len(design.plant.scheduling) == 2 else []),
        *(_impact(pictures, design, plant, controller, place, axis) for axis in "xy"),
    ]
    return [
        Words(f"Pictures of {design.name}, {caption}."),
        Gallery(shown),
        Shown(pictures.picture(plot_magnitudes(data, title=title), alt)),
    ]


def _shown_frequencies(plant: LinearModel, sample_time: float) -> FloatArray:
    """Return frequencies [Hz] from 1/30 of the slowest mode to ten times the fastest, up to the Nyquist frequency."""
    modes = [frequency for frequency, _ in plant.modes()] or [1e-3 / sample_time]
    highest = 0.5 / sample_time
    return np.geomspace(min(min(modes) / 30, highest / 10), min(10 * max(modes), highest), 300)


def design_damping_map(design: AssessedDesign) -> DampingMap:
    """Return the smallest damping factor of the sampled loop of a design over its two scheduling variables."""
    return damping_map_data(
        design.plant,
        design.at,
        n=_GRID,
        points=design.figures.points,
        title=f"{design.name}, {_sampled_words(design)}",
        sample_time=design.sample_time,
        method=design.method,
    )


def _sampled_words(design: AssessedDesign) -> str:
    return f"sampled at {1e3 * design.sample_time:g} ms"


def _damping_map(pictures: Pictures, design: AssessedDesign) -> Block:
    data = design_damping_map(design)
    alt = (
        f"Smallest damping factor over {scheduling_words(data.variables)}, {data.title}, from "
        f"{data.damping.min():.3f} to {data.damping.max():.3f}; operating points marked"
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


def held_back(design: TunedDesign) -> list[str]:
    """Return the warnings of a design: violated limits and gains at their bounds."""
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
    """Return blocks with the tuning result of each design, and a figure of robustness and damping of all designs."""
    tuned = results.designs.complete
    blocks: list[Block] = [Words(f"{name}: {text}", "warn") for name, text in results.designs.missing.items()]
    if not tuned:
        return blocks
    blocks += [Words(f"{name}: {text}", "warn") for name, design in tuned.items() for text in held_back(design)]
    drawn_over = {design.name for design in results.assessed}
    blocks += assessment_tables({name: design for name, design in tuned.items() if name not in drawn_over})
    blocks += design_tables(tuned)
    if any(design.promises for design in tuned.values()):
        caption = "Promised objective of robust designs over the probability; the table above has its numbers"
        blocks.append(Shown(pictures.picture(plot_robustness_price(tuned), caption)))
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


_BY_POINT = (
    *("damping", "peak_output", "peak_control", "static_amplification", "slowest_decay_hz"),
    *("impact_p_m", "stack_travel_m", "sampled_damping"),
)
"""Figures of the table by operating point."""


def controller_section(results: Results, pictures: Pictures) -> PageSection | None:
    """Return the section on designs with the gain explorer; None without designs and surfaces for closed loops."""
    designs, model, spec = results.assessed, results.loop_model, results.experiment.spec
    item = next((name for name, fit in results.surfaces.items() if fit.model is model), None)
    if not spec.controller and item is None:
        return None
    blocks: list[Block] = []
    if not spec.controller:
        text = "This experiment designed no controller; the gains shown are those that came with the machine."
        blocks.append(Words(text))
    for group in dict.fromkeys(design.group for design in designs):
        blocks += _compared([design for design in designs if design.group == group])
    blocks += tuned_blocks(results, pictures)
    try:
        blocks += [block for design in designs if design.is_published for block in _modes(results, design)][:1]
    except GbidError as error:  # surfaces without physical meaning at some point
        blocks.append(Words(f"modes cannot be compared: {error}", "warn"))
    for i, design in enumerate(designs):
        try:
            drawn = [*design_pictures(pictures, design), _by_point(design)]
        except GbidError as error:
            drawn = [Words(f"{design.name} cannot be drawn: {error}", "warn")]
        blocks += drawn if i == 0 else [Fold(f"Pictures of {design.name}", drawn)]
    if model is not None:
        source = f"the surfaces {item} of this experiment" if item else f"the model {model.name} behind the virtual rig"
        blocks.append(explorer_part(model, source, [(d.name, d.structure, d.figures.gains) for d in designs]))
    return PageSection("controller", "Controller", blocks)


def _compared(designs: Sequence[AssessedDesign]) -> list[Block]:
    first = designs[0]
    points = first.figures.points
    where = first.figures.where(0) if len(points) == 1 else f"{len(points)} operating points"
    conditions = conditions_words(first.impact, first.sample_time, first.method)
    title = f"Designs on {first.plant.name}, worst over {where}"
    return [comparison_table(title, [design.figures for design in designs], conditions)]


def _modes(results: Results, design: AssessedDesign) -> list[Block]:
    """Return a table that compares the modes in the paper with the modes of this model at the published gains."""
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
        [design.figures.where(i), *(figure.factor * design.figures.at(i)[name] for name, figure in shown.items())]
        for i in range(len(design.figures.points))
    ]
    columns = [Column("operating point"), *(Column(figure.heading, format=figure.format) for figure in shown.values())]
    return Fold(f"{design.name} at each operating point", [Table(design.name, columns, rows)])


def cycle_section(results: Results, pictures: Pictures) -> PageSection | None:
    """Return the section on the rounds of recording, fit and tuning; None if the experiment has no cycle."""
    section = results.experiment.spec.cycle
    if section is None:
        return None
    blocks: list[Block] = [Words("the cycle is not complete; run `gbid cycle` or `gbid run`", "warn")]
    if results.cycle:
        caption = (
            "Rounds of the cycle: smallest damping of the loop on the rig with 95 % intervals, lines as expected from "
            "the surfaces of the round; standard deviations of the modes of the bearing, relative to round 0"
        )
        blocks = [rounds_table(results.cycle), Shown(pictures.picture(plot_cycle(results.cycle), caption))]
    elif not section.in_run:
        blocks = [Words("`gbid cycle` runs the rounds; `gbid run` leaves them out")]
    return PageSection("cycle", "Cycle", blocks)


def impacts_section(results: Results, pictures: Pictures) -> PageSection | None:
    """Return the section on the impact studies; None if the experiment has no impacts."""
    if results.experiment.spec.impacts is None:
        return None
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
    blocks += [table for study in results.studies.complete.values() for table in study.tables()]
    return PageSection("impacts", "Impacts", blocks)


def loops_section(results: Results) -> PageSection | None:
    """Return the section that compares standard deviations in closed and open loop; None without such fits."""
    fits = results.experiment.spec.fits.values()
    if not any(fit.loop is not None and fit.loop.beside for fit in fits):
        return None
    missing = [Words("the comparison is not made yet; run `gbid run`", "warn")]
    return PageSection("loops", "Loops", list(cost_tables(made_costs(results.job))) or missing)
