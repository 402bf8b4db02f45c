"""Tables over scheduling variables with multilinear interpolation, as in the generated source."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from itertools import pairwise, product
from typing import Any

import numpy as np

from gbid.core.arrays import FloatArray, Point, point_label
from gbid.core.errors import UsageError
from gbid.lpv import Domain
from gbid.structure.scheduling import SCHEDULING

TOLERANCE = 1e-3
"""Largest error of the interpolation between nodes, as a share of the largest magnitude of an entry."""
MOST_NODES = 9
"""Most nodes along each of one or two variables."""
FEWER_NODES = 5
"""Most nodes along each of three or more variables, whose rows are many."""


@dataclass(frozen=True, eq=False)
class GridTable:
    """Rows of numbers over a grid of scheduling variables; a single row if the controller is not scheduled.

    Attributes
    ----------
    axes : dict of str to tuple of float
        Nodes of each variable, ascending; empty for a single row, else at least two.
    rows : (n_nodes, n_entries) array
        Rows, the nodes of the last variable within those of the variables before it.
    error : float
        Largest error between nodes that was found, as a share of the largest magnitude of an entry.
    """

    axes: Mapping[str, tuple[float, ...]]
    rows: FloatArray
    error: float = 0.0

    @property
    def is_scheduled(self) -> bool:
        """Whether the table has more than one row."""
        return len(self.rows) > 1

    @cached_property
    def _lists(self) -> list[list[float]]:
        return [[float(v) for v in row] for row in self.rows]

    def row(self, *point: float) -> list[float]:
        """Return the row at an operating point, with the operations of the C source in their order.

        Parameters
        ----------
        *point : float
            Variables in the order of `axes`; outside the nodes the nearest is taken.
        """
        rows = self._lists
        if not self.is_scheduled:
            return rows[0]
        axes = [*self.axes.values()]
        places = [_place(nodes, value) for nodes, value in zip(axes, point, strict=True)]
        total: list[float] = []
        for corner in product((0, 1), repeat=len(places)):
            weight, at = 1.0, 0
            for up, (i, share), nodes in zip(corner, places, axes, strict=True):
                weight, at = weight * (share if up else 1.0 - share), at * len(nodes) + i + up
            part = [weight * v for v in rows[at]]
            total = [a + b for a, b in zip(total, part, strict=True)] if total else part
        return total


def inverse_widths(nodes: tuple[float, ...]) -> list[float]:
    """Return the reciprocal of the distance between each node and the next node.

    Parameters
    ----------
    nodes : tuple of float
        Nodes, ascending.
    """
    return [1.0 / (nodes[i + 1] - nodes[i]) for i in range(len(nodes) - 1)]


def _place(nodes: tuple[float, ...], value: float) -> tuple[int, float]:
    """Return the index of the grid node below a value, and the fraction of the interval up to the value."""
    value = min(max(value, nodes[0]), nodes[-1])
    i = sum(value >= node for node in nodes[1:-1])
    return i, (value - nodes[i]) * inverse_widths(nodes)[i]


def table_of_points(rows: dict[Point, FloatArray], what: str, variables: Sequence[str] = SCHEDULING) -> GridTable:
    """Return a table from rows at the points of a full grid.

    Parameters
    ----------
    rows : dict of point to (n_entries,) array
        Rows by operating point, such as (pressure_bar, speed_rpm).
    what : str
        What the rows are, for the message.
    variables : sequence of str
        Names of the scheduling variables.

    Raises
    ------
    UsageError
        When points of the grid are missing.
    """
    axes = [tuple(sorted(set(values))) for values in zip(*rows, strict=True)]
    grid = [*product(*axes)]
    missing = [point for point in grid if point not in rows]
    if missing:
        where = point_label(*missing[0], variables=variables)
        raise UsageError(
            f"{what}: the operating points are no full grid, {where} is missing; add it, or choose one operating point "
            "(--at BAR RPM)"
        )
    values = np.array([rows[point] for point in grid])
    if len(rows) == 1:
        return GridTable(dict.fromkeys(variables, ()), values)
    # the only node of an axis is repeated, so that the source needs one form of interpolation
    nodes = [each if len(each) > 1 else (each[0], each[0] + 1.0) for each in axes]
    values = values.reshape(*map(len, axes), -1)
    values = np.broadcast_to(values, (*map(len, nodes), values.shape[-1]))
    return GridTable(dict(zip(variables, nodes, strict=True)), values.reshape(-1, values.shape[-1]))


def table_over_domain(row_at: Callable[..., FloatArray], domain: Domain) -> GridTable:
    """Return a table over a domain, with as many nodes as the interpolation error requires.

    Parameters
    ----------
    row_at : callable
        From the scheduling variables, such as pressure [bar] and speed [rpm], to the exact row.
    domain : Domain
        The domain.

    Returns
    -------
    GridTable
        Its error is at most `TOLERANCE`, or that of `MOST_NODES` or `FEWER_NODES` along an axis.
    """
    exact: Any = cache(lambda *point: np.asarray(row_at(*point), float))
    count, most = [2] * len(domain.bounds), MOST_NODES if len(domain.bounds) < 3 else FEWER_NODES
    while True:  # one node where both bounds are equal
        axes = [np.unique(np.linspace(*ends, n)).tolist() for ends, n in zip(domain.bounds, count, strict=True)]
        table = table_of_points({point: exact(*point) for point in product(*axes)}, "schedule", domain.variables)
        if not table.is_scheduled:
            return table
        largest = np.abs(table.rows).max(axis=0)
        scale = np.maximum(largest, max(1e-6 * float(largest.max(initial=0.0)), 1e-300))
        errors = []
        for i, nodes in enumerate(axes):
            places = product(*axes[:i], [0.5 * (a + b) for a, b in pairwise(nodes)], *axes[i + 1 :])
            errors.append(max((float((np.abs(table.row(*q) - exact(*q)) / scale).max()) for q in places), default=0.0))
        refined = [e > TOLERANCE / 2 and n < most for e, n in zip(errors, count, strict=True)]
        if not any(refined):
            return replace(table, error=sum(errors))
        count = [2 * n - 1 if more else n for n, more in zip(count, refined, strict=True)]
