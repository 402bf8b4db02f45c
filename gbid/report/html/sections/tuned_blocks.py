"""Blocks on the results of the tuning: objective, active limits, goals, promises, notes, and the Pareto front."""

from __future__ import annotations

from gbid.control.assessment.tuned_design import TunedDesign
from gbid.errors import GbidError
from gbid.report.figures.loop.pareto_curves import designs_pareto_data, plot_pareto
from gbid.report.figures.loop.robustness_price import plot_robustness_price
from gbid.report.html.page import Block, Listed, Shown, Words
from gbid.report.html.pictures import Pictures
from gbid.report.reader import Results
from gbid.report.tables.promise_tables import caps_table, goals_table, promises_table
from gbid.tables.table import Column, Table


def held_back(design: TunedDesign) -> list[str]:
    """Return the warnings of a design: limits that are not met, and gains on their bounds."""
    result = design.result
    found = []
    if not result.success:
        found.append(f"{result.status}, limits exceeded by {100 * result.violation:.2g} %")
    stuck = [text for text in result.active if text.endswith("bound")]
    if stuck:
        found.append(f"limited by {', '.join(stuck)}; wider bounds may damp more")
    found += [f"under the cap {cap:g}: {entry.status}" for cap, entry in design.front if not entry.success]
    return found


def tuned_blocks(results: Results, pictures: Pictures) -> list[Block]:
    """Return blocks with the tuning result of each design, and all designs over robustness and damping."""
    tuned = results.designs.found
    blocks: list[Block] = [Words(f"{name}: {text}", "warn") for name, text in results.designs.missing.items()]
    if not tuned:
        return blocks
    rows = []
    for name, design in tuned.items():
        result, unit = design.result, " 1/s" if design.result.objective == "decay" else ""
        worst = f"{result.worst.frequency_hz:.1f} Hz, damping {result.worst.damping:.3f}, {result.worst.where}"
        held = ", ".join(result.active) or "–"
        rows.append((name, str(result.status), f"{result.value:.4f}{unit}", worst, held, result.verified_on))
        blocks += [Words(f"{name}: {text}", "warn") for text in held_back(design)]
    columns = ("design", "status", "aim reached", "worst mode", "limited by", "checked")
    blocks.append(Table("What the tuning found", [Column(name) for name in columns], rows))
    tables = (goals_table(tuned), caps_table(tuned), promises_table(tuned))
    blocks += [table for table in tables if table is not None]
    if any(design.promises for design in tuned.values()):
        words = "Promised objective of robust designs over the probability; the table above has its numbers"
        blocks.append(Shown(pictures.picture(plot_robustness_price(tuned), words)))
    notes = [f"{name}: {note}" for name, design in tuned.items() for note in design.result.notes]
    if notes:
        blocks.append(Listed(notes))
    try:
        data = designs_pareto_data(tuned)
    except GbidError as error:
        return [*blocks, Words(f"The Pareto front cannot be drawn: {error}", "warn")]
    reached = "; ".join(
        f"{label} "
        + ", ".join(f"{z:.3f} at {peak:.2f}" for peak, z in zip(data.peak_sensitivity[label], damping, strict=True))
        for label, damping in data.damping.items()
    )
    alt = f"Smallest damping factor over the peak of the output sensitivity: {reached}"
    return [*blocks, Shown(pictures.picture(plot_pareto(data), alt))]
