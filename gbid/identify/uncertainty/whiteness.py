"""Whether residuals are white."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft
from scipy.special import chdtrc

from gbid.arrays import FloatArray

_FEW = 64  # lags up to which plain products are quicker than transforms


class Whiteness(NamedTuple):
    """Portmanteau test of residuals (Ljung and Box, 1978).

    Attributes
    ----------
    statistic : (n_y,) array
    p_value : (n_y,) array
        Probability of a larger statistic for white residuals.
    lags : int
    """

    statistic: FloatArray
    p_value: FloatArray
    lags: int


def correlation(first: FloatArray, second: FloatArray, lags: int) -> FloatArray:
    """Correlation of two signals, ``sum_k a[k] b[k+l] / sqrt(sum a^2 sum b^2)``, for lags 0 to `lags`.

    Parameters
    ----------
    first, second : (n_samples,) array
        Means are not removed.
    lags : int

    Returns
    -------
    (lags + 1,) array
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
    """Test the residuals of one or several records together.

    Parameters
    ----------
    errors : list of (n_samples, n_y) array
    lags : int
        Lags that enter.

    Returns
    -------
    Whiteness
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
    """Count the samples over which residuals remember: to the lag after which the autocorrelation stays in its band.

    The band is Bartlett's, which widens with the correlation before a lag: estimated autocorrelations of coloured
    residuals are coloured themselves, and wander far outside of the band of white ones.
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
            # Smoothed over a few lags: one of thousands leaves its band by chance.
            outside = np.flatnonzero(np.convolve(np.abs(rho), np.ones(5) / 5, "same") > 3.3 * np.sqrt(variance)) + 1
            reach = 0
            for lag in outside:
                if lag > 2 * reach + 50:  # silent for longer than it spoke: chance
                    break
                reach = int(lag)
            longest = max(longest, reach)
    return longest
