"""Table of the identification-for-control cycle: what each round gains in damping and certainty."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict

from gbid.experiment.stages.cycle.rows import CycleRow
from gbid.operating_point import point_label
from gbid.report.tables.fit_document import Row
from gbid.tables.table import Column, Table

_INTERVAL = 1.96


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
