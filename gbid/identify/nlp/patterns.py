"""Sparsity patterns of the Jacobian of the gaps and of the Hessian of the shooting problem."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from gbid.arrays import IntArray
from gbid.identify.nlp.record_group import RecordGroup

LinksByPart = list[tuple[IntArray, IntArray, RecordGroup]]
"""Links that start in each part: row numbers, first windows, and the part."""


class Pattern(NamedTuple):
    """Nonzeros of a sparse matrix in column order, and the order that brings computed entries there."""

    shape: tuple[int, int]
    rows: IntArray
    columns: IntArray
    order: IntArray


def jacobian_pattern(
    links: IntArray,
    links_by_part: LinksByPart,
    n: int,
    n_theta: int,
    n_unknowns: int,
) -> Pattern:
    """Return where the gaps depend on the parameters of a window, its start, and the next start.

    Parameters
    ----------
    links : (n_links, 2) integer array
    links_by_part : sequence of (rows, windows, RecordGroup)
        Links that start in each part, and their first windows.
    n, n_theta, n_unknowns : int
        Number of states, parameters and unknowns.
    """
    rows, columns = [], []
    for link_rows, windows, part in links_by_part:
        own = (link_rows[:, None] * n + np.arange(n))[:, :, None]
        rows += [own.repeat(len(part.index), 2), own.repeat(n, 2)]
        columns += [
            np.broadcast_to(part.index, rows[-2].shape),
            np.broadcast_to((n_theta + windows[:, None] * n + np.arange(n))[:, None, :], rows[-1].shape),
        ]
    rows.append(np.arange(len(links) * n))
    columns.append((n_theta + links[:, 1:] * n + np.arange(n)).ravel())
    return _in_column_order((len(links) * n, n_unknowns), rows, columns)


def hessian_pattern(
    parts: Sequence[RecordGroup],
    first_window: IntArray,
    theta_pairs: tuple[IntArray, IntArray],
    n: int,
    n_unknowns: int,
    places: IntArray | None = None,
) -> Pattern:
    """Return where the upper triangle of the Hessian has entries, an arrow.

    Parameters
    ----------
    parts : sequence of RecordGroup
    first_window : (n_parts + 1,) integer array
    theta_pairs : (n_pairs,) integer array, (n_pairs,) integer array
        Pairs of parameters that meet in some part.
    n, n_unknowns : int
        Number of states and of unknowns.
    places : (n_used,) integer array, optional
        Unknowns that meet in extra terms. What they add to the pattern are the last entries before the order.
    """
    rows, columns = [theta_pairs[0]], [theta_pairs[1]]
    upper, n_theta = np.triu_indices(n), n_unknowns - int(first_window[-1]) * n
    for part, first, last in zip(parts, first_window[:-1], first_window[1:], strict=True):
        base = n_theta + np.arange(first, last) * n
        shape = (last - first, len(part.index), n)
        rows += [np.broadcast_to(part.index[None, :, None], shape), base[:, None] + upper[0]]
        columns += [np.broadcast_to((base[:, None] + np.arange(n))[:, None, :], shape), base[:, None] + upper[1]]
    if places is not None:
        have = np.concatenate([np.ravel(r) + n_unknowns * np.ravel(c) for r, c in zip(rows, columns, strict=True)])
        low, high = pairs_of(places)
        new = ~np.isin(low + n_unknowns * high, have)
        rows.append(low[new])
        columns.append(high[new])
    return _in_column_order((n_unknowns, n_unknowns), rows, columns)


def pairs_of(places: IntArray) -> tuple[IntArray, IntArray]:
    """Return rows and columns, in the upper triangle, of all pairs of unknowns, in the order of ``triu_indices``."""
    i, j = np.triu_indices(len(places))
    return np.minimum(places[i], places[j]), np.maximum(places[i], places[j])


def theta_pairs(parts: Sequence[RecordGroup], n_theta: int) -> tuple[IntArray, IntArray]:
    """Return the pairs of parameters that are in the same part, upper triangle."""
    meet = np.eye(n_theta, dtype=bool)
    for part in parts:
        meet[np.ix_(part.index, part.index)] = True
    rows, columns = np.nonzero(np.triu(meet))
    return rows, columns


def links_by_part(links: IntArray, parts: Sequence[RecordGroup], first_window: IntArray) -> LinksByPart:
    """Return the links that start in each part: row numbers, first windows, and the part."""
    result = []
    for part, first, last in zip(parts, first_window[:-1], first_window[1:], strict=True):
        own = np.flatnonzero((links[:, 0] >= first) & (links[:, 0] < last))
        result.append((own, links[own, 0], part))
    return result


def _in_column_order(shape: tuple[int, int], rows: list[IntArray], columns: list[IntArray]) -> Pattern:
    """Order entries by column, then row."""
    row = np.concatenate([np.ravel(part) for part in rows]).astype(np.int64)
    column = np.concatenate([np.ravel(part) for part in columns]).astype(np.int64)
    order = np.lexsort((row, column))
    return Pattern(shape, row[order], column[order], order)
