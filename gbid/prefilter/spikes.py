"""Spikes: single wrong samples, found by their neighbours and replaced."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gbid.arrays import FloatArray, IntArray

THRESHOLD = 6.0
"""Robust standard deviations by which a sample must miss the cubic through its neighbours."""
ONE_SIDED = 4.0
"""Robust standard deviations by which it must also miss the cubic fitted to seven samples before, and after it."""
LONGEST_RUN = 3
"""Most wrong samples in a row that are replaced."""
_MIDDLE = np.array([-1.0, 4.0, 0.0, 4.0, -1.0]) / 6  # cubic through two samples on each side, at the middle
_BEFORE = np.array([-4.0, 6.0, 4.0, -3.0, -8.0, -4.0, 16.0]) / 7  # cubic fitted to seven samples, at the next one
_MAD_TO_STD = 1.4826
_QUANTA = 2.0
_REACH = 7  # samples at each end that have too few neighbours to be judged


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


class _SpikeLimits(NamedTuple):
    """Largest errors that a good sample may have in one channel."""

    middle: float
    side: float


def remove_spikes(values: FloatArray, threshold: float = THRESHOLD, measured: FloatArray | None = None) -> Despiked:
    """Replace samples that their neighbours on both sides contradict.

    A Hampel identifier on the interpolation error. A run of one to three samples is wrong under three conditions:

    - A sample there misses the cubic through its four neighbours by more than `threshold` robust standard deviations
      (median of magnitudes) of this error, and no neighbour does so when the run is replaced by a cubic.
    - The first sample of the run does not continue the samples before it (cubic fitted to seven, four
      standard deviations).
    - The last sample of the run does not continue the samples after it. Steps and kinks of the signal therefore stay:
      each of their samples continues one of its sides.

    The error of a smooth signal is of fourth order: a wave of 10 um at 125 Hz, sampled at 5 kHz, has one of 1 nm. The
    distance from a running median is of second order (0.12 um there), so a limit on it would take crests for spikes.

    Parameters
    ----------
    values : (n_samples, n_channels) array
        The signal. Its first and last seven samples have too few neighbours on one side; they stay as they are.
    threshold : float
        In robust standard deviations.
    measured : (n_samples, n_channels) array, optional
        The signal as the converter gave it, when something was already subtracted from `values`. Errors of up to two
        steps of the converter are no spikes.

    Returns
    -------
    Despiked

    Notes
    -----
    Hampel, F. R. (1974), The influence curve and its role in robust estimation; Pearson, R. K. (2002), Outliers in
    process modeling and identification, IEEE Trans. Control Syst. Technol. 10, 55-63.
    """
    cleaned = np.array(values, dtype=float)
    steps = [_converter_step(column) for column in (cleaned if measured is None else measured).T]
    found = [_clean(column, threshold, step) for column, step in zip(cleaned.T, steps, strict=True)]
    return Despiked(cleaned, tuple(found))


def _clean(x: FloatArray, threshold: float, step: float) -> IntArray:
    """Replace the spikes of one channel in place; return where they were."""
    spikes: list[int] = []
    if len(x) > 2 * _REACH:
        error = np.abs(_interpolation_error(x))
        sides = np.convolve(x, [1.0, *-_BEFORE[::-1]], mode="valid")
        limits = _SpikeLimits(
            max(threshold * _robust_std(error), _QUANTA * step), max(ONE_SIDED * _robust_std(sides), _QUANTA * step)
        )
        done = 0
        for k in np.flatnonzero(error > limits.middle) + 2:
            if k >= done:
                start, bridge = _wrong_run(x, int(k), limits)
                x[start : start + len(bridge)] = bridge
                spikes += range(start, start + len(bridge))
                done = start + len(bridge) + 2 if len(bridge) else done
    return np.array(spikes, dtype=np.int64)


def _wrong_run(x: FloatArray, k: int, limits: _SpikeLimits) -> tuple[int, FloatArray]:
    """Return the start of the shortest wrong run around a suspect sample, and its replacement, empty for none."""
    for length in range(1, LONGEST_RUN + 1):
        first, last = max(k - length + 1, _REACH), min(k + LONGEST_RUN, len(x) - _REACH - length + 1)
        starts = [start for start in range(first, last) if _off_both_sides(x, start, start + length, limits.side)]
        trials = [(start, *_bridged(x, start, start + length)) for start in starts]
        if trials:
            start, bridge, left = min(trials, key=lambda trial: trial[2])
            if left <= limits.middle:
                return start, bridge
    return k, x[:0]


def _off_both_sides(x: FloatArray, start: int, stop: int, limit: float) -> bool:
    """Whether the first sample of a run does not continue what is before, nor the last one what is after."""
    before = x[start] - _BEFORE @ x[start - _REACH : start]
    after = x[stop - 1] - _BEFORE[::-1] @ x[stop : stop + _REACH]
    return bool(min(abs(before), abs(after)) > limit)


def _bridged(x: FloatArray, start: int, stop: int) -> tuple[FloatArray, float]:
    """Return the cubic through two samples on each side of a run, and the largest interpolation error left."""
    nodes = np.array([start - 2, start - 1, stop, stop + 1])
    run = np.arange(start, stop)
    bridge = np.zeros(len(run))
    for i, node in enumerate(nodes):
        others = np.delete(nodes, i)
        bridge += x[node] * np.prod((run[:, None] - others) / (node - others), axis=1)
    # The run enters the errors of samples up to two away; the neighbours of those reach two further.
    trial = np.concatenate([x[max(start - 4, 0) : start], bridge, x[stop : stop + 4]])
    return bridge, float(np.abs(_interpolation_error(trial)).max())


def _interpolation_error(x: FloatArray) -> FloatArray:
    """Distance of each sample, but two at each end, from the cubic through its four neighbours (n - 4,)."""
    return np.asarray(x[2:-2] - np.convolve(x, _MIDDLE, mode="valid"))


def _robust_std(error: FloatArray) -> float:
    return _MAD_TO_STD * float(np.median(np.abs(error)))


def _converter_step(x: FloatArray) -> float:
    """Smallest step between two different values."""
    steps = np.diff(np.unique(x))
    return float(steps.min()) if len(steps) else 0.0
