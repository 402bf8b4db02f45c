"""Plateaus of a staircase, and their steady means with standard errors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gbid.core.arrays import FloatArray
from gbid.core.errors import DataError
from gbid.recording import Recording

MIN_SAMPLES = 40
"""Smallest number of samples in a steady part from which a standard error can be estimated."""
_BATCHES = 10
_HARMONICS = 6


@dataclass(frozen=True, eq=False)
class Plateaus:
    """Stretches of a recording on which all channels of a command are constant.

    Attributes
    ----------
    start, stop : (n_plateaus,) array of int
        First sample and the one after the last.
    level : (n_plateaus, n_channels) array
        Command on each plateau.
    """

    start: FloatArray
    stop: FloatArray
    level: FloatArray

    def __len__(self) -> int:
        return len(self.start)


def find_plateaus(rec: Recording, command: str) -> Plateaus:
    """Return the plateaus of a staircase, found from its command.

    The command must be without noise. A step is a change by more than 0.1 % of the whole travel from one sample to the
    next. Stretches of less than 80 samples are transitions between plateaus.

    Parameters
    ----------
    rec : Recording
        The staircase.
    command : str
        Name of the commanded signal, e.g. r.

    Returns
    -------
    Plateaus
        At least three, in the order of time.

    Raises
    ------
    DataError
        When there is no such signal, when it does not move, or when it has fewer than three plateaus.
    """
    values = rec.signal(command)
    travel = float(np.ptp(values, axis=0).max())
    if travel == 0:
        raise DataError(f"recording {rec.name!r}: {command} does not move; a staircase steps up and down")
    changes = np.abs(np.diff(values, axis=0)).max(axis=1) > 1e-3 * travel
    edges = np.concatenate([[0], np.flatnonzero(changes) + 1, [len(values)]])
    start, stop = edges[:-1], edges[1:]
    long = stop - start >= 2 * MIN_SAMPLES
    start, stop = start[long], stop[long]
    if len(start) < 3:
        raise DataError(
            f"recording {rec.name!r}: {command} has {len(start)} plateaus of at least {2 * MIN_SAMPLES} samples; "
            f"a staircase has three or more, and {command} must be the command itself, not a noisy measurement of it"
        )
    level = np.array([np.median(values[a:b], axis=0) for a, b in zip(start, stop, strict=True)])
    return Plateaus(start, stop, level)


@dataclass(frozen=True, eq=False)
class SteadyMeans:
    """Means of a signal on the steady parts of plateaus.

    Attributes
    ----------
    mean : (n_plateaus, n_channels) array
        Means, in the unit of the signal.
    std_error : (n_plateaus, n_channels) array
        Standard errors of the means; they include correlation between samples and drift.
    drift : (n_plateaus, n_channels) array
        Change over the steady part, from a straight line.
    """

    mean: FloatArray
    std_error: FloatArray
    drift: FloatArray


def steady_parts(rec: Recording, plateaus: Plateaus, keep: float) -> list[tuple[int, int]]:
    """Return the steady part of each plateau: its first sample and the one after its last.

    Parameters
    ----------
    rec : Recording
        The staircase.
    plateaus : Plateaus
        Its plateaus.
    keep : float
        Share of each plateau that is kept, from its end; above 0 and at most 1.

    Raises
    ------
    DataError
        When too few samples remain.
    """
    parts = []
    for a, b in zip(plateaus.start.astype(int), plateaus.stop.astype(int), strict=True):
        first = b - round(keep * (b - a))
        if b - first < MIN_SAMPLES:
            raise DataError(
                f"recording {rec.name!r}: {b - first} steady samples on the plateau from sample {a}, at least "
                f"{MIN_SAMPLES} are needed; hold each step longer or keep more of it"
            )
        parts.append((first, b))
    return parts


def steady_means(values: FloatArray, parts: list[tuple[int, int]], angle: FloatArray | None = None) -> SteadyMeans:
    r"""Return means over the steady parts, with standard errors for correlated noise and drift.

    Each part is cut into ten batches. The scatter s of the batch means contains noise of any colour on that time
    scale, and :math:`s / \sqrt{10}` is the standard error of the mean. When the slope of a straight line is more than
    four times its standard error, the signal is not yet at rest. Then half its rise over the part is added in square.

    Parameters
    ----------
    values : (n_samples, n_channels) array
        The signal.
    parts : list of (first, stop)
        Steady parts, as from `steady_parts`.
    angle : (n_samples,) array, optional
        Shaft angle [rad]. In a part with two turns or more, the first six harmonics are removed by least squares. So
        run-out and unbalance do not change the mean, even when the part is not a whole number of turns.

    Returns
    -------
    SteadyMeans
    """
    means, errors, drifts = [], [], []
    for first, stop in parts:
        part = values[first:stop]
        if angle is not None:
            part = _without_harmonics(part, angle[first:stop])
        size = len(part) // _BATCHES
        batch = part[len(part) - size * _BATCHES :].reshape(_BATCHES, size, -1).mean(axis=1)
        place = np.arange(_BATCHES) - (_BATCHES - 1) / 2
        slope = place @ batch / (place @ place)
        scatter = batch - batch.mean(axis=0) - np.outer(place, slope)
        slope_error = np.sqrt((scatter**2).sum(axis=0) / (_BATCHES - 2) / (place @ place))
        drift = slope * _BATCHES
        unsettled = np.where(np.abs(slope) > 4 * slope_error, drift / 2, 0.0)
        means.append(part.mean(axis=0))
        errors.append(np.sqrt(batch.var(axis=0, ddof=1) / _BATCHES + unsettled**2))
        drifts.append(drift)
    return SteadyMeans(np.array(means), np.array(errors), np.array(drifts))


def _without_harmonics(part: FloatArray, angle: FloatArray) -> FloatArray:
    """Remove the harmonics of the shaft angle, but not the mean."""
    turns = abs(float(np.unwrap(angle)[-1] - angle[0])) / (2 * np.pi)
    if turns < 2:
        return part
    orders = np.arange(1.0, min(_HARMONICS, len(part) / turns / 3) + 1)
    phase = np.outer(angle, orders)
    basis = np.hstack([np.ones((len(part), 1)), np.cos(phase), np.sin(phase)])
    solution = np.linalg.lstsq(basis, part, rcond=None)[0]
    return np.asarray(part - basis[:, 1:] @ solution[1:])


# ---- Up and down branches of a staircase, and the difference between them.

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
    for i, (one_way, branch) in enumerate(runs):
        for other_way, other in runs[:i]:
            if one_way == other_way:
                continue
            for points, levels in ((branch, other), (other, branch)):
                for candidate in _differences(points, levels, at, value, error, widest):
                    if not candidate[0] <= best[0]:
                        best = candidate
    return best


def _differences(
    points: list[int], levels: list[int], at: FloatArray, value: FloatArray, error: FloatArray, widest: float
) -> list[tuple[float, float, float]]:
    order = sorted(levels, key=lambda j: float(at[j]))
    nodes = at[order]
    differences = []
    for k in points:
        if k in levels or not nodes[0] <= at[k] <= nodes[-1]:
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
