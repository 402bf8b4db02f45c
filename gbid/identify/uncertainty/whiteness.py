"""Whiteness test of residuals."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft
from scipy.special import chdtrc

from gbid.arrays import FloatArray
from gbid.identify.data import column_means

LAGS = 25
"""Number of lags of the test."""
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


def _autocorrelation(errors: FloatArray, lags: int) -> _Autocorrelation:
    centred = errors - column_means(errors)
    return _Autocorrelation(len(errors), np.array([correlation(channel, channel, lags)[1:] for channel in centred.T]))


def _portmanteau(records: list[_Autocorrelation], lags: int) -> Whiteness:
    """Sum up the statistic of Ljung and Box over the records that are long enough."""
    used = [(n, rho[:, :lags]) for n, rho in records if n > 2 * lags]
    statistic = np.zeros(len(records[0].rho))
    for n, rho in used:
        statistic += n * (n + 2) * (rho**2 / (n - np.arange(1, lags + 1))).sum(axis=1)
    return Whiteness(statistic, np.asarray(chdtrc(lags * max(1, len(used)), statistic)), lags)
