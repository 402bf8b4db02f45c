"""Tables over pressure and speed with bilinear interpolation, as the generated source has them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np

from gbid.arrays import FloatArray
from gbid.errors import UsageError
from gbid.lpv import Domain

TOLERANCE = 1e-3
"""Largest error of the interpolation between nodes, as a share of the largest magnitude of an entry."""
MOST_NODES = 9
"""Most nodes along pressure and along speed."""


@dataclass(frozen=True, eq=False)
class GridTable:
    """Rows of numbers over a grid of pressure and speed; one row when nothing is scheduled.

    Attributes
    ----------
    pressure_bar, speed_rpm : tuple of float
        Nodes, ascending; both empty for a single row, else at least two each.
    rows : (n_nodes, n_entries) array
        Rows, the nodes of speed within those of pressure.
    error : float
        Largest error between nodes that was found, as a share of the largest magnitude of an entry.
    """

    pressure_bar: tuple[float, ...]
    speed_rpm: tuple[float, ...]
    rows: FloatArray
    error: float = 0.0

    @property
    def is_scheduled(self) -> bool:
        """Whether there is more than one row."""
        return len(self.rows) > 1

    @cached_property
    def _lists(self) -> list[list[float]]:
        return [[float(v) for v in row] for row in self.rows]

    def row(self, pressure_bar: float, speed_rpm: float) -> list[float]:
        """Return the row at an operating point, by the operations of the C source in their order.

        Parameters
        ----------
        pressure_bar, speed_rpm : float
            Operating point [bar], [rpm]; outside the nodes the nearest is taken.
        """
        rows = self._lists
        if not self.is_scheduled:
            return rows[0]
        i, a = _place(self.pressure_bar, pressure_bar)
        j, b = _place(self.speed_rpm, speed_rpm)
        first, n = i * len(self.speed_rpm) + j, len(self.speed_rpm)
        w00, w01, w10, w11 = (1.0 - a) * (1.0 - b), (1.0 - a) * b, a * (1.0 - b), a * b
        corners = zip(rows[first], rows[first + 1], rows[first + n], rows[first + n + 1], strict=True)
        return [((w00 * p + w01 * q) + w10 * r) + w11 * s for p, q, r, s in corners]


def inverse_widths(nodes: tuple[float, ...]) -> list[float]:
    """Return one over the distance of each node from the next.

    Parameters
    ----------
    nodes : tuple of float
        Nodes, ascending.
    """
    return [1.0 / (nodes[i + 1] - nodes[i]) for i in range(len(nodes) - 1)]


def _place(nodes: tuple[float, ...], value: float) -> tuple[int, float]:
    """Return the node before a value within the nodes, and how far the value is on the way to the next."""
    value = min(max(value, nodes[0]), nodes[-1])
    i = sum(value >= node for node in nodes[1:-1])
    return i, (value - nodes[i]) * inverse_widths(nodes)[i]


def table_of_points(rows: dict[tuple[float, float], FloatArray], what: str) -> GridTable:
    """Return the table of rows that are known at the points of a full grid.

    Parameters
    ----------
    rows : dict of (pressure_bar, speed_rpm) to (n_entries,) array
        Rows by operating point.
    what : str
        What the rows are, for the message.

    Raises
    ------
    UsageError
        When points of the grid are missing.
    """
    pressures, speeds = (tuple(sorted({point[i] for point in rows})) for i in (0, 1))
    missing = [(p, s) for p in pressures for s in speeds if (p, s) not in rows]
    if missing:
        p, s = missing[0]
        raise UsageError(
            f"{what}: the operating points are no full grid, {p:g} bar at {s:g} rpm is missing; add it, or choose one "
            "operating point (--at BAR RPM)"
        )
    if len(rows) == 1:
        return GridTable((), (), np.array(list(rows.values())))
    pressures, speeds, rows = _at_least_two(pressures, speeds, rows)
    return GridTable(pressures, speeds, np.array([rows[p, s] for p in pressures for s in speeds]))


def _at_least_two(
    pressures: tuple[float, ...], speeds: tuple[float, ...], rows: dict[tuple[float, float], FloatArray]
) -> tuple[tuple[float, ...], tuple[float, ...], dict[tuple[float, float], FloatArray]]:
    """Repeat the only node of an axis, so that the source needs one form of interpolation."""
    if len(pressures) == 1:
        rows = rows | {(p + 1.0, s): row for (p, s), row in rows.items()}
        pressures = (pressures[0], pressures[0] + 1.0)
    if len(speeds) == 1:
        rows = rows | {(p, s + 1.0): row for (p, s), row in rows.items()}
        speeds = (speeds[0], speeds[0] + 1.0)
    return pressures, speeds, rows


def table_over_domain(row_at: Callable[[float, float], FloatArray], domain: Domain) -> GridTable:
    """Return a table over a rectangle, with as many nodes as the interpolation needs.

    Parameters
    ----------
    row_at : callable
        From pressure [bar] and speed [rpm] to the exact row.
    domain : Domain
        The rectangle.

    Returns
    -------
    GridTable
        Its error is at most `TOLERANCE`, or that of `MOST_NODES` nodes along an axis.
    """
    known: dict[tuple[float, float], FloatArray] = {}

    def exact(p: float, s: float) -> FloatArray:
        if (p, s) not in known:
            known[p, s] = np.asarray(row_at(p, s), float)
        return known[p, s]

    count = [2, 2]
    while True:
        axes = [
            np.linspace(*bounds, n) for bounds, n in zip((domain.pressure_bar, domain.speed_rpm), count, strict=True)
        ]
        if domain.pressure_bar[0] == domain.pressure_bar[1]:
            axes[0] = axes[0][:1]
        if domain.speed_rpm[0] == domain.speed_rpm[1]:
            axes[1] = axes[1][:1]
        pressures, speeds = ([float(v) for v in axis] for axis in axes)
        table = table_of_points({(p, s): exact(p, s) for p in pressures for s in speeds}, "schedule")
        if not table.is_scheduled:
            return table
        largest = np.abs(table.rows).max(axis=0)
        scale = np.maximum(largest, max(1e-6 * float(largest.max(initial=0.0)), 1e-300))
        errors = [0.0, 0.0]
        for axis, places in enumerate(
            (
                [(p, s) for p in _middles(pressures) for s in speeds],
                [(p, s) for p in pressures for s in _middles(speeds)],
            )
        ):
            for p, s in places:
                errors[axis] = max(errors[axis], float((np.abs(table.row(p, s) - exact(p, s)) / scale).max()))
        refined = [e > TOLERANCE / 2 and n < MOST_NODES for e, n in zip(errors, count, strict=True)]
        if not any(refined):
            return GridTable(table.pressure_bar, table.speed_rpm, table.rows, sum(errors))
        count = [2 * n - 1 if more else n for n, more in zip(count, refined, strict=True)]


def _middles(nodes: list[float]) -> list[float]:
    return [0.5 * (a + b) for a, b in pairwise(nodes)]
