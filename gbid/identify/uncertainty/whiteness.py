"""Whiteness test of residuals."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft
from scipy.special import chdtrc

from gbid.arrays import FloatArray

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


def whiteness_test(errors: list[FloatArray], lags: int = 25) -> Whiteness:
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
    n_y = errors[0].shape[1]
    statistic = np.zeros(n_y)
    records = [e - e.mean(0) for e in errors if len(e) > 2 * lags]
    for e in records:
        n = len(e)
        for j in range(n_y):
            channel = e[:, j]
            rho = correlation(channel, channel, lags)[1:]
            statistic[j] += n * (n + 2) * float((rho**2 / (n - np.arange(1, lags + 1))).sum())
    freedom = lags * max(1, len(records))
    return Whiteness(statistic, np.asarray(chdtrc(freedom, statistic)), lags)


def correlation_length(errors: list[FloatArray]) -> int:
    """Return the correlation length of residuals in samples: the lag beyond which the autocorrelation is insignificant.

    The confidence band is that of Bartlett, which widens with the correlation at smaller lags. Estimated
    autocorrelations of coloured residuals are coloured themselves, and leave the band of white residuals.
    """
    longest = 1
    for e in (record - record.mean(0) for record in errors):
        n = len(e)
        most = min(n // 10, 2000)
        if most < 2:
            continue
        for j in range(e.shape[1]):
            channel = e[:, j]
            rho = correlation(channel, channel, most)[1:]
            variance = (1 + 2 * np.concatenate([[0.0], np.cumsum(rho[:-1] ** 2)])) / n
            # Smoothed over a few lags: of thousands of lags one leaves its band by chance.
            outside = np.flatnonzero(np.convolve(np.abs(rho), np.ones(5) / 5, "same") > 3.3 * np.sqrt(variance)) + 1
            reach = 0
            for lag in outside:
                if lag > 2 * reach + 50:  # inside the band for longer than before: later excursions are chance
                    break
                reach = int(lag)
            longest = max(longest, reach)
    return longest
