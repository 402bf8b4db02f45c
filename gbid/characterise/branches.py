"""Up and down branches of a staircase, and how far apart they lie."""

from __future__ import annotations

import numpy as np

from gbid.arrays import FloatArray

_WIDEST = 2.5  # usual steps between neighbours


def monotone_runs(level: FloatArray) -> list[tuple[int, list[int]]]:
    """Split a course of levels where it turns back.

    Parameters
    ----------
    level : (n,) array
        Levels in time order.

    Returns
    -------
    list of (direction, indices)
        Direction +1 or -1; a turning point belongs to the run before and to the one after it.
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
    """Largest difference between an up and a down branch at the same input.

    Each point of one branch is compared with the straight line between its neighbours of the other, where they overlap
    and the neighbours are no farther apart than 2.5 usual steps: a straight line across a wide gap would show
    curvature as hysteresis.

    Parameters
    ----------
    at : (n,) array
        Input, in time order.
    value : (n,) array
        Output.
    error : (n,) array
        Standard error of the output.

    Returns
    -------
    difference : float
        Without sign; NaN when there is no pair of branches.
    std_error : float
        Standard error of it.
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
                for found in _differences(here, there, at, value, error, widest):
                    if not found[0] <= best[0]:
                        best = found
    return best


def _differences(
    here: list[int], there: list[int], at: FloatArray, value: FloatArray, error: FloatArray, widest: float
) -> list[tuple[float, float, float]]:
    order = sorted(there, key=lambda j: float(at[j]))
    nodes = at[order]
    found = []
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
        found.append((abs(float(value[k] - line)), float(std), float(at[k])))
    return found
