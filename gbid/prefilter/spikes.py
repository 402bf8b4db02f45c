"""Spikes: single wrong samples, found by their neighbours and replaced."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gbid.arrays import FloatArray, IntArray

THRESHOLD = 6.0
"""Robust standard deviations by which a sample must miss the cubic through its neighbours."""
LONGEST_RUN = 3
"""Most wrong samples in a row that are replaced."""
_WEIGHTS = np.array([-1.0, 4.0, 4.0, -1.0]) / 6  # cubic through two samples on each side, at the middle
_MAD_TO_STD = 1.4826
_QUANTA = 2.0


class Despiked(NamedTuple):
    """A signal without spikes, and where they were.

    Attributes
    ----------
    values : (n_samples, n_channels) array
        The signal, wrong samples replaced.
    samples : tuple of (n_spikes,) integer array
        Wrong samples of each channel, in order.
    """

    values: FloatArray
    samples: tuple[IntArray, ...]


def remove_spikes(values: FloatArray, threshold: float = THRESHOLD) -> Despiked:
    """Replace samples that both sides of their neighbourhood contradict.

    A Hampel identifier on the interpolation error: a sample is suspect when it misses the cubic through two samples on
    each side by more than `threshold` robust standard deviations (median of magnitudes) of that error. It is replaced
    by the cubic, alone or in a run of at most three samples, when this brings the error of the neighbourhood below the
    limit. A step in the signal fails this second test and stays.

    The error of a smooth signal is of fourth order: a wave of 10 um at 125 Hz, sampled at 5 kHz, has one of 1 nm. The
    distance from a running median is of second order (0.12 um there), so a limit on it would take crests for spikes.

    Parameters
    ----------
    values : (n_samples, n_channels) array
        The signal. Its first and last two samples have no neighbours on one side; they stay as they are.
    threshold : float
        In robust standard deviations.

    Returns
    -------
    Despiked

    Notes
    -----
    Hampel, F. R. (1974), The influence curve and its role in robust estimation; Pearson, R. K. (2002), Outliers in
    process modeling and identification, IEEE Trans. Control Syst. Technol. 10, 55-63.
    """
    cleaned = np.array(values, dtype=float)
    return Despiked(cleaned, tuple(_clean(column, threshold) for column in cleaned.T))


def _clean(x: FloatArray, threshold: float) -> IntArray:
    """Replace the spikes of one channel in place; return where they were."""
    if len(x) < 2 * 2 + 1:
        return np.zeros(0, dtype=np.int64)
    error = np.abs(_interpolation_error(x))
    limit = max(threshold * _MAD_TO_STD * float(np.median(error)), _QUANTA * _quantum(x))
    spikes: list[int] = []
    done = 0
    for k in np.flatnonzero(error > limit) + 2:
        if k < done:
            continue
        for length in range(1, LONGEST_RUN + 1):
            trials = [_bridged(x, start, start + length) for start in _starts(int(k), length, len(x))]
            left, start, bridge = min(trials, key=lambda trial: trial[0], default=(np.inf, 0, x[:0]))
            if left <= limit:
                x[start : start + length] = bridge
                spikes += range(start, start + length)
                done = start + length + 2
                break
    return np.array(spikes, dtype=np.int64)


def _starts(k: int, length: int, n: int) -> list[int]:
    """Where a run of wrong samples may start that a suspect sample belongs to or is next to."""
    return [start for start in range(k - length + 1, k + LONGEST_RUN) if 2 <= start <= n - 2 - length]


def _bridged(x: FloatArray, start: int, stop: int) -> tuple[float, int, FloatArray]:
    """Bridge a run; return the largest interpolation error that is left there, the start, and the bridge."""
    nodes = np.array([start - 2, start - 1, stop, stop + 1])
    run = np.arange(start, stop)
    bridge = np.zeros(len(run))
    for i, node in enumerate(nodes):
        others = np.delete(nodes, i)
        bridge += x[node] * np.prod((run[:, None] - others) / (node - others), axis=1)
    # Samples up to two away have an error that the run enters; their own neighbours reach two further.
    first, last = max(start - 4, 0), min(stop + 4, len(x))
    trial = np.concatenate([x[first:start], bridge, x[stop:last]])
    return float(np.abs(_interpolation_error(trial)).max()), start, bridge


def _interpolation_error(x: FloatArray) -> FloatArray:
    """Distance of each sample, but two at each end, from the cubic through its four neighbours (n - 4,)."""
    return np.asarray(x[2:-2] - (_WEIGHTS[0] * (x[:-4] + x[4:]) + _WEIGHTS[1] * (x[1:-3] + x[3:-1])))


def _quantum(x: FloatArray) -> float:
    """Smallest step between two different values: what a converter resolves."""
    steps = np.diff(np.unique(x))
    return float(steps.min()) if len(steps) else 0.0
