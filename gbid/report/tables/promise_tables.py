"""Tables of what designs reached of their goals, under caps on the peak of S_o, and promise on drawn plants."""

from __future__ import annotations

from collections.abc import Mapping

from gbid.control.assessment.tuned_design import TunedDesign
from gbid.tables.table import Column, Table


def goals_table(designs: Mapping[str, TunedDesign]) -> Table | None:
    """Return the table of the goals of designs that have a figure of their own; None when there are none."""
    rows = [
        (name, figure.name, "objective" if figure.soft else "limit", figure.excess, figure.where)
        for name, design in designs.items()
        for figure in design.result.goals
    ]
    note = "excess: logarithm of the value over its limit, of damping factors the limit minus the value; met at most 0"
    columns = [Column("design"), Column("goal"), Column("kind"), Column("excess", format="+.4f"), Column("where")]
    return Table("Goals of the designs", columns, rows, [note]) if rows else None


def caps_table(designs: Mapping[str, TunedDesign]) -> Table | None:
    """Return the table of what each design reaches under each cap on the peak of S_o; None without caps."""
    caps = sorted({cap for design in designs.values() for cap, _ in design.front})
    rows = []
    for name, design in designs.items():
        under = dict(design.front)
        if under:
            results = [under.get(cap) for cap in caps]
            structure = design.performance[0].structure if design.performance else ""
            rows.append((name, structure, *(r.value if r and r.success else None for r in results)))
    columns = [Column("design"), Column("structure"), *(Column(f"peak {cap:g}", format=".4f") for cap in caps)]
    return Table("Aim reached under caps on the peak of S_o", columns, rows) if rows else None


def promises_table(designs: Mapping[str, TunedDesign]) -> Table | None:
    """Return the table of the promises of robust designs, beside the nominal designs; None without any."""
    rows = [
        (name, p.probability, p.promised, p.keeps_limits, p.of_nominal, p.limits_of_nominal, p.plants, p.fresh)
        for name, design in designs.items()
        for p in design.promises
    ]
    if not rows:
        return None
    columns = [
        Column("design"),
        Column("probability", format="g"),
        Column("promised", format=".4f"),
        Column("keeps limits", format=".3f"),
        Column("nominal design", format=".4f"),
        Column("its limits", format=".3f"),
        Column("plants", format="d"),
        Column("fresh", format="d"),
    ]
    promises = [p for design in designs.values() for p in design.promises]
    confidence = ", ".join(f"{100 * c:g} %" for c in sorted({p.confidence for p in promises}))
    note = (
        f"promised: reached with the probability, at a confidence of {confidence}, on fresh drawn plants that the "
        "design has not seen; keeps limits: lower bound of the probability; "
        "plants: drawn plants for which it was optimised"
    )
    return Table("Robust designs", columns, rows, [note])
