"""Tables of recordings in closed loop: what the loop costs in precision, and the rounds of the cycle."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from itertools import groupby

from gbid.experiment.stages.cycle.rows import CycleRow
from gbid.experiment.stages.loop.cost import LoopCostRow
from gbid.operating_point import point_label
from gbid.report.tables.fit_document import Row
from gbid.tables.table import Cell, Column, Table, formatted

_INTERVAL, _DIGITS = 1.96, 2
_STDS = ("std", "std_beside")


def loop_documents(rows: Sequence[LoopCostRow]) -> list[Row]:
    """Return the rows as plain values, with the ratio of the standard deviations."""
    return [{**asdict(row), "ratio": row.std / row.std_beside} for row in rows]


def loop_tables(documents: Sequence[Row]) -> list[Table]:
    """Return a table for each fit in a loop and operating point.

    Parameters
    ----------
    documents : sequence of dict
        Documents of `loop_documents`.
    """
    tables = []
    for (fit, point), group in groupby(documents, key=lambda row: (row["fit"], row["point"])):
        rows = list(group)
        columns = [Column("parameter"), *(Column(name, format=_DIGITS) for name in ("std in the loop", "std without"))]
        cells = [
            [row["parameter"], *(formatted(row[key], _DIGITS, row["unit"]) for key in _STDS), row["ratio"]]
            for row in rows
        ]
        title = f"{fit}, {point}: what the loop costs in precision, beside {rows[0]['beside']}"
        tables.append(Table(title, [*columns, Column("ratio", format=".2f")], cells, _cost_notes(rows[0])))
    return tables


def _cost_notes(row: Row) -> list[str]:
    notes = []
    for words, end in (("in the loop", ""), ("without", "_beside")):
        peak = formatted(row[f"peak{end}"], _DIGITS, row["peak_unit"])
        shown = peak.text if isinstance(peak, Cell) else "?"
        count, length = row[f"recordings{end}"], row[f"duration{end}_s"]
        notes.append(f"{words}: {count} fits, recordings of {length:g} s, {row['peak_of']} up to {shown}")
    return [
        *notes,
        "medians over the converged fits; above a ratio of 1 the loop costs precision, below it gains",
    ]


def cycle_documents(rows: Sequence[CycleRow]) -> list[Row]:
    """Return the rows of a cycle as plain values."""
    return [asdict(row) for row in rows]


def cycle_summary(documents: Sequence[Row]) -> Table:
    """Return the table of the rounds.

    Parameters
    ----------
    documents : sequence of dict
        Documents of `cycle_documents`.
    """
    columns = [
        Column("round", format="d"),
        Column("where"),
        Column("recordings", format="d"),
        Column("std of frequencies", "Hz"),
        Column("std of dampings"),
        Column("promised", format=".3f"),
        Column("expected", format=".3f"),
        Column("reached, 95 %"),
    ]
    notes = (
        "std: of both modes of the bearing without controller, by the surfaces of the round; promised: smallest "
        "damping of the design over all points and plants; expected: of the sampled loop at this point, by the "
        "surfaces; reached: smaller damping of both modes of the loop on the rig, measured by impacts",
    )
    return Table("Rounds of the cycle", columns, [_cells(CycleRow(**document)) for document in documents], notes)


def _cells(row: CycleRow) -> list[str | int | float]:
    damping, std = row.reached
    reached = f"{damping:.4f} ± {_INTERVAL * std:.4f}" if row.converged else "ring-downs not fitted"
    return [
        row.round,
        point_label(row.pressure_bar, row.speed_rpm),
        row.recordings,
        f"{row.model_frequency_1_hz_std:.3f}, {row.model_frequency_2_hz_std:.3f}",
        f"{row.model_damping_1_std:.5f}, {row.model_damping_2_std:.5f}",
        row.promised_damping,
        row.expected_damping,
        reached,
    ]
