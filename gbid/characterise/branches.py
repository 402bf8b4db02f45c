"""Up and down branches of a staircase, and the difference between them."""

from __future__ import annotations

import numpy as np

from gbid.arrays import FloatArray

_WIDEST = 2.5  # largest distance of neighbours, in median steps


def monotone_runs(level: FloatArray) -> list[tuple[int, list[int]]]:
    """Return the runs of rising or falling levels in a sequence.

    Parameters
    ----------
    level : (n,) array
        Levels in the order of time.

    Returns
    -------
    list of (direction, indices)
        Direction is +1 or -1. A turning point belongs to the run before it and to the run after it.
    """
    runs: list[tuple[int, list[int]]] = []
    for i in range(1, len(level)):
        step = int(np.sign(level[i] - level[i - 1]))
        if step == 0:
            continue
        if runs and runs[-1][0] == step:
            runs[-1][1].append(i)
        else:
            runs.append((step, [i - 1, i]))
    return runs


def branch_difference(at: FloatArray, value: FloatArray, error: FloatArray) -> tuple[float, float, float]:
    """Return the largest difference between an up branch and a down branch at the same input.

    Each point of one branch is compared with the straight line between its neighbours on the other branch, where the
    branches overlap. The neighbours must not be farther apart than 2.5 median steps: across a wider gap, curvature
    would look like hysteresis.

    Parameters
    ----------
    at : (n,) array
        Input, in the order of time.
    value : (n,) array
        Output.
    error : (n,) array
        Standard error of the output.

    Returns
    -------
    difference : float
        Absolute difference; NaN when there is no pair of branches.
    std_error : float
        Its standard error.
    place : float
        Input at which it occurs.
    """
    runs = monotone_runs(at)
    steps = np.abs(np.diff(at))
    widest = _WIDEST * float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0
    best = (float("nan"), float("nan"), float("nan"))
    for i, (one_way, one) in enumerate(runs):
        for other_way, other in runs[:i]:
            if one_way == other_way:
                continue
            for here, there in ((one, other), (other, one)):
                for candidate in _differences(here, there, at, value, error, widest):
                    if not candidate[0] <= best[0]:
                        best = candidate
    return best


def _differences(
    here: list[int], there: list[int], at: FloatArray, value: FloatArray, error: FloatArray, widest: float
) -> list[tuple[float, float, float]]:
    order = sorted(there, key=lambda j: float(at[j]))
    nodes = at[order]
    differences = []
    for k in here:
        if k in there or not nodes[0] <= at[k] <= nodes[-1]:
            continue
        right = min(max(int(np.searchsorted(nodes, at[k])), 1), len(nodes) - 1)
        a, b = order[right - 1], order[right]
        if at[b] - at[a] > widest:
            continue
        share = (at[k] - at[a]) / (at[b] - at[a])
        line = (1 - share) * value[a] + share * value[b]
        std = np.sqrt(error[k] ** 2 + ((1 - share) * error[a]) ** 2 + (share * error[b]) ** 2)
        differences.append((abs(float(value[k] - line)), float(std), float(at[k])))
    return differences
