"""Comparison of control designs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from gbid.control.assessment.assess import Assessment
from gbid.errors import UsageError
from gbid.tables.html import html_table
from gbid.tables.table import Cell, Column, Entry, Table

COLUMNS = (
    ("smallest damping", "damping", 1.0, ".3f"),
    ("peak S_o", "peak_output", 1.0, ".3f"),
    ("peak K S_o", "peak_control", 1.0, ".3f"),
    ("disk margin", "disk_margin", 1.0, ".3f"),
    ("static S_o", "static_amplification", 1.0, ".3f"),
    ("stiffness ratio", "stiffness_ratio", 1.0, ".3f"),
    ("slowest decay [Hz]", "slowest_decay_hz", 1.0, ".1f"),
    ("disc [um]", "impact_p_m", 1e6, ".2f"),
    ("stack [um]", "stack_travel_m", 1e6, ".2f"),
    ("decay [ms]", "decay_time_s", 1e3, ".1f"),
    ("sampled damping", "sampled_damping", 1.0, ".3f"),
    ("sampled peak S_o", "sampled_peak_output", 1.0, ".3f"),
)
"""Heading, figure of `Assessment.worst`, factor and format of each column."""


@dataclass(frozen=True)
class Comparison:
    """Worst figures of several designs.

    Attributes
    ----------
    columns : tuple of str
        Headings; the first is for the name of the design.
    values : tuple of tuple of float
        One row per design, without its name, in the units of the headings.
    rows : tuple of tuple of str
        One row per design as formatted texts.
    """

    columns: tuple[str, ...]
    values: tuple[tuple[float, ...], ...]
    rows: tuple[tuple[str, ...], ...]

    def __repr__(self) -> str:
        return str(self)

    def _repr_html_(self) -> str:
        return html_table(self.table())

    def table(self) -> Table:
        """Return the table with its values; `to_frame` of it makes a data frame."""
        names = [row[0] for row in self.rows]
        shown = zip(names, self.rows, self.values, strict=True)
        rows: list[list[Entry]] = [[name, *map(Cell, values, texts[1:])] for name, texts, values in shown]
        return Table("", [Column(heading) for heading in self.columns], rows)

    def to_frame(self) -> Any:
        """Return the figures as a pandas.DataFrame, a row for each design.

        Raises
        ------
        UsageError
            When pandas is not installed.
        """
        return self.table().to_frame().set_index(self.columns[0])

    def __str__(self) -> str:
        """Return a table with aligned columns."""
        table = (self.columns, *self.rows)
        widths = [max(len(row[i]) for row in table) for i in range(len(self.columns))]
        return "\n".join("  ".join([row[0].ljust(widths[0]), *map(str.rjust, row[1:], widths[1:])]) for row in table)


def compare_designs(assessments: Sequence[Assessment]) -> Comparison:
    """Return the worst figures of several designs in one table.

    Parameters
    ----------
    assessments : sequence of Assessment
        Assessments over the same operating points, with the same impact and sampling.

    Returns
    -------
    Comparison

    Raises
    ------
    UsageError
        When there are no assessments, or when their conditions differ.
    """
    if not assessments:
        raise UsageError("compare_designs: no designs")
    first = assessments[0]
    for other in assessments[1:]:
        if _conditions(other) != _conditions(first):
            raise UsageError(
                f"compare_designs: {other.name!r} and {first.name!r} were assessed at other points, with other impacts "
                "or another sampling; assess them alike"
            )
    values = tuple(
        tuple(factor * assessment.worst[figure][0] for _, figure, factor, _ in COLUMNS) for assessment in assessments
    )
    rows = tuple(
        (assessment.name, *(format(value, spec) for value, (*_, spec) in zip(row, COLUMNS, strict=True)))
        for assessment, row in zip(assessments, values, strict=True)
    )
    return Comparison(("design", *(heading for heading, *_ in COLUMNS)), values, rows)


def _conditions(assessment: Assessment) -> tuple[object, ...]:
    points = tuple((point.pressure_bar, point.speed_rpm) for point in assessment.points)
    return points, assessment.impact, assessment.sample_time, assessment.computation_s, assessment.method
