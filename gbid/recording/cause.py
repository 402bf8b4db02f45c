"""Causality check: a signal cannot respond before its source moves."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gbid.core.arrays import FloatArray

_ORDER = 8  # past samples of source and target that predict the target
_HARMONICS = 6  # of the shaft angle: steps of a source may keep time with the shaft
_REACH = (3, 5, 8, 13, 24, 48, 96, 192)  # samples before and behind a step over which its effect is summed
_STEP = 8.0  # smallest step of a source, in robust standard deviations of what its past does not predict
_APART = 6  # samples after a step, or before white noise, in which a controller may answer
_LEAST_STEPS, _EACH_WAY = 20, 0.2  # fewest steps; smallest share of either direction, which impacts do not have
_ROWS = 8_000  # largest number of samples that are looked at
_NOISE = 5e-3  # of its standard deviation, added to the target: what is smaller may be an error of the linear model
_CONSTANT = 1e-9
_LAGS, _WHITE = (8, 200), 4.0  # of white noise: sums of squared correlations, largest in standard deviations above mean
_CLIPPED = 4.0  # robust standard deviations that a residual counts at most
_EXPLAINED, _CHI2 = 0.015, 120.0  # of what the past leaves: share that steps to come must explain, and its evidence


class Lead(NamedTuple):
    """Time by which a signal responds before its source.

    Attributes
    ----------
    channel : int
        Channel of the target that shows it most.
    samples : int
        Samples by which it moves before the source, roughly: one of a few values.
    """

    channel: int
    samples: int


def lead_before(source: FloatArray, target: FloatArray, angle: FloatArray | None = None) -> Lead | None:
    """Return by how much a target responds before steps of its source; None where it does not.

    A step is a sample of the source far beyond what its own past predicts, as the edges of a PRBS; neither a controller
    nor a resonance makes one. What the past of both signals and a step at the present or the next sample leave of the
    target is regressed on sums of later steps. White noise counts as steps at every sample: feedback of a resonance
    would colour it. Another source may follow the target by feedback, and is not judged.

    Parameters
    ----------
    source, target : (n_samples, n_channels) array
        Samples without gaps, of one clock.
    angle : (n_samples,) array, optional
        Shaft angle [rad].
    """
    source, target = source[:_ROWS], target[:_ROWS]
    n, far, size = len(target), _REACH[-1], target.std(axis=0)
    target = target + _NOISE * size * np.random.Generator(np.random.PCG64(0)).standard_normal(target.shape)
    if n < 6 * far:
        return None
    steps = [found for column in source.T if (found := _steps(column)) is not None]
    shortest = 0 if steps else _APART
    if not (steps := steps or [column - column.mean() for column in source.T if _is_white(column)]):
        return None
    total = np.cumsum(np.stack(steps, axis=1), axis=0)  # a difference of two rows is a sum of steps

    def at(values: FloatArray, lag: int) -> FloatArray:
        return values[far + lag : n - far + lag - 1]

    shaft = [] if angle is None else [np.exp(1j * k * at(angle, 0)) for k in range(1, _HARMONICS + 1)]
    past = [at(values, -k) for k in range(1, _ORDER + 1) for values in (source, target)]
    behind = [at(total, 0) - at(total, -m) for m in _REACH]
    ahead = [at(total, m) - at(total, 1) for m in _REACH]
    waves = [np.stack([wave.real, wave.imag], axis=1) for wave in shaft]
    constant = np.ones((n - 2 * far - 1, 1))
    now = [at(total, 1) - at(total, 0), at(total, 0) - at(total, -1)]
    basis = np.hstack([constant, *now, *past, *waves, *behind, *ahead])
    basis /= np.sqrt(np.maximum(np.mean(basis**2, axis=0), 1e-300))
    gram = basis.T @ basis + 1e-10 * len(basis) * np.eye(basis.shape[1])
    wide = ahead[0].shape[1]
    n_known = basis.shape[1] - wide * len(_REACH)

    def left_by(values: FloatArray, columns: list[int]) -> FloatArray:
        moments = basis[:, columns].T @ values
        return np.asarray(values - basis[:, columns] @ np.linalg.solve(gram[np.ix_(columns, columns)], moments))

    known = list(range(n_known))
    left = left_by(at(target, 0), known)
    usual = 1.4826 * np.median(np.abs(left), axis=0)
    left = left_by(np.clip(left, -_CLIPPED * usual, _CLIPPED * usual), known)  # a spike weighs no more than noise
    rest = np.sum(left_by(left, list(range(basis.shape[1]))) ** 2, axis=0)
    rest /= np.maximum(np.sum(left**2, axis=0), 1e-300)
    rest[size <= _CONSTANT * np.abs(target).max(axis=0)] = 1.0
    channel = int(np.argmin(rest))
    if 1 - rest[channel] < _EXPLAINED or -len(left) * np.log(max(rest[channel], 1e-300)) < _CHI2:
        return None
    sums = [known + list(range(n_known + wide * k, n_known + wide * (k + 1))) for k in range(len(_REACH))]
    fits = [float(np.sum(left_by(left[:, channel], columns) ** 2)) for columns in sums]
    samples = _REACH[int(np.argmin(fits))]
    return Lead(channel, samples) if samples > shortest else None


def _steps(column: FloatArray) -> FloatArray | None:
    """Return the step directions of a source, -1, 0 or 1 for each sample; None if there are too few steps."""
    rows = np.lib.stride_tricks.sliding_window_view(column - column.mean(), _ORDER + 1)
    past, present = rows[:, :-1], rows[:, -1]
    gram = past.T @ past
    gram += 1e-10 * np.trace(gram) * np.eye(_ORDER)
    left = present - past @ np.linalg.solve(gram, past.T @ present) if gram.any() else present
    limit = max(_STEP * 1.4826 * float(np.median(np.abs(left))), 1e-6 * float(np.ptp(column)))
    steps, last = np.zeros(len(column)), -_APART
    for at in np.flatnonzero(np.abs(left) > limit).tolist():
        if at - last >= _APART:
            steps[at + _ORDER], last = np.sign(left[at]), at
    ups, downs = int(np.sum(steps > 0)), int(np.sum(steps < 0))
    return steps if ups + downs >= _LEAST_STEPS and min(ups, downs) >= _EACH_WAY * (ups + downs) else None


def _is_white(column: FloatArray) -> bool:
    """Return whether a signal is white noise: feedback of a resonance would colour it."""
    power = np.abs(np.fft.rfft(column - column.mean(), 2 * len(column))) ** 2
    correlation = np.fft.irfft(power)
    squares = len(column) * np.cumsum(correlation[1 : _LAGS[-1] + 1] ** 2) / max(correlation[0] ** 2, 1e-300)
    return bool(power.any()) and all(squares[m - 1] < m + _WHITE * np.sqrt(2 * m) for m in _LAGS)
