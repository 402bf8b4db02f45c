"""Whiteness test of residuals."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft
from scipy.special import chdtrc

from gbid.arrays import FloatArray

LAGS = 25
"""Number of lags of the test."""
_LONGEST = 2000  # largest correlation length that is looked for
_FEW = 64  # largest number of lags for which products are faster than transforms


class Whiteness(NamedTuple):
    """Result of the portmanteau test of residuals (Ljung and Box, 1978).

    Attributes
    ----------
    statistic : (n_y,) array
        Test statistic of each output.
    p_value : (n_y,) array
        Probability of a larger statistic for white residuals.
    lags : int
        Number of lags.
    """

    statistic: FloatArray
    p_value: FloatArray
    lags: int


def correlation(first: FloatArray, second: FloatArray, lags: int) -> FloatArray:
    """Return the correlation of two signals, ``sum_k a[k] b[k+l] / sqrt(sum a^2 sum b^2)``, for lags 0 to `lags`.

    Parameters
    ----------
    first, second : (n_samples,) array
        Signals; their means are not removed.
    lags : int
        Largest lag.

    Returns
    -------
    (lags + 1,) array
        Correlation at each lag.
    """
    own = first is second
    first = np.ascontiguousarray(first)
    second = first if own else np.ascontiguousarray(second)
    if lags <= _FEW:
        size = len(first)
        product = np.array([first[: size - lag] @ second[lag:] if lag < size else 0.0 for lag in range(lags + 1)])
    else:
        n = next_fast_len(len(first) + lags + 1, real=True)
        ahead = rfft(first, n)
        behind = ahead if own else rfft(second, n)
        product = irfft(np.conj(ahead) * behind, n)[: lags + 1]
    scale = np.sqrt(float(first @ first) * float(second @ second))
    return np.asarray(product / scale) if scale > 0 else np.zeros(lags + 1)


class _Autocorrelation(NamedTuple):
    """Autocorrelation of the residuals of one record about their means."""

    n_samples: int
    rho: FloatArray  # (n_y, lags), from lag 1


def whiteness_test(errors: list[FloatArray], lags: int = LAGS) -> Whiteness:
    """Return the whiteness test of the residuals of one or several records.

    Parameters
    ----------
    errors : list of (n_samples, n_y) array
        Residuals of each record.
    lags : int
        Number of lags.

    Returns
    -------
    Whiteness
        Statistic and p-value of each output.
    """
    return _portmanteau([_autocorrelation(record, lags) for record in errors], lags)


def whiteness_and_memory(errors: list[FloatArray]) -> tuple[Whiteness, int]:
    """Return the whiteness test of residuals, and their correlation length in samples.

    Both come from one autocorrelation. The correlation length is the lag beyond which the autocorrelation is
    insignificant, at least 1. The confidence band is that of Bartlett, which widens with the correlation at smaller
    lags. Estimated autocorrelations of coloured residuals are coloured themselves, and leave the band of white
    residuals.

    Parameters
    ----------
    errors : list of (n_samples, n_y) array
        Residuals of each record, finite.
    """
    found = [_autocorrelation(record, max(LAGS, min(len(record) // 10, _LONGEST))) for record in errors]
    return _portmanteau(found, LAGS), max([1, *(_reach(n, rho) for n, record in found for rho in record)])


def _autocorrelation(errors: FloatArray, lags: int) -> _Autocorrelation:
    centred = errors - errors.mean(0)
    return _Autocorrelation(len(errors), np.array([correlation(channel, channel, lags)[1:] for channel in centred.T]))


def _portmanteau(records: list[_Autocorrelation], lags: int) -> Whiteness:
    """Sum up the statistic of Ljung and Box over the records that are long enough."""
    used = [(n, rho[:, :lags]) for n, rho in records if n > 2 * lags]
    statistic = np.zeros(len(records[0].rho))
    for n, rho in used:
        statistic += n * (n + 2) * (rho**2 / (n - np.arange(1, lags + 1))).sum(axis=1)
    return Whiteness(statistic, np.asarray(chdtrc(lags * max(1, len(used)), statistic)), lags)


def _reach(n: int, rho: FloatArray) -> int:
    """Return the lag beyond which an autocorrelation stays inside its band; 0 when it never leaves it."""
    rho = rho[: min(n // 10, _LONGEST)]
    if len(rho) < 2:
        return 0
    variance = (1 + 2 * np.concatenate([[0.0], np.cumsum(rho[:-1] ** 2)])) / n
    # Smoothed over a few lags: of thousands of lags one leaves its band by chance.
    outside = np.flatnonzero(np.convolve(np.abs(rho), np.ones(5) / 5, "same") > 3.3 * np.sqrt(variance)) + 1
    reach = 0
    for lag in outside:
        if lag > 2 * reach + 50:  # inside the band for longer than before: later excursions are chance
            break
        reach = int(lag)
    return reach
