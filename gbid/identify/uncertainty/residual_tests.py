"""Tests of residuals: whiteness, and independence of the inputs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy

from gbid.core.arrays import BoolArray, FloatArray
from gbid.core.errors import UsageError
from gbid.identify.data import centred_rows

LAGS = 25
"""Number of lags of the tests that a fit runs."""
COLOURED = 0.01
"""Significance level of the whiteness test, shared by the outputs."""
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

    @property
    def accepted(self) -> BoolArray:
        """Whether the residuals of each output count as white, (n_y,)."""
        return np.asarray(self.p_value >= COLOURED / len(self.p_value))


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
    same = first is second
    first = np.ascontiguousarray(first)
    second = first if same else np.ascontiguousarray(second)
    if lags <= _FEW:
        size = len(first)
        product = np.array([first[: size - lag] @ second[lag:] if lag < size else 0.0 for lag in range(lags + 1)])
    else:
        n = scipy.fft.next_fast_len(len(first) + lags + 1, real=True)
        ahead = scipy.fft.rfft(first, n)
        behind = ahead if same else scipy.fft.rfft(second, n)
        product = scipy.fft.irfft(np.conj(ahead) * behind, n)[: lags + 1]
    scale = np.sqrt(float(first @ first) * float(second @ second))
    return np.asarray(product / scale) if scale > 0 else np.zeros(lags + 1)


def whiteness_test(errors: list[FloatArray], lags: int = LAGS) -> Whiteness:
    """Return the whiteness test of the residuals of one or several records.

    Parameters
    ----------
    errors : list of (n_samples, n_y) array
        Residuals of each record; records of at most twice as many samples as lags do not count.
    lags : int
        Number of lags.

    Returns
    -------
    Whiteness
        Statistic and p-value of each output.

    Raises
    ------
    UsageError
        When no record is given.
    """
    if not errors:
        raise UsageError("whiteness_test: no residuals given; give those of at least one record")
    statistic, used = np.zeros(errors[0].shape[1]), [record for record in errors if len(record) > 2 * lags]
    for record in used:
        n = len(record)
        if not record.all():  # samples are missing or left out: fewer pairs, each for itself
            statistic += [_statistic_of_pairs(channel, lags) for channel in record.T]
            continue
        rho = np.array([correlation(channel, channel, lags)[1:] for channel in centred_rows(record)])
        statistic += n * (n + 2) * (rho**2 / (n - np.arange(1, lags + 1))).sum(axis=1)
    return Whiteness(statistic, np.asarray(scipy.special.chdtrc(lags * max(1, len(used)), statistic)), lags)


def _statistic_of_pairs(residuals: FloatArray, lags: int) -> float:
    """Return the test statistic of residuals (n_samples,) with gaps, which are zeros.

    The correlation at each lag is over its variance for white residuals, one over the number of pairs; a lag without
    pairs has the statistic that it has on average.
    """
    present = residuals != 0
    count = int(present.sum())
    centred = np.where(present, residuals - residuals.sum() / max(count, 1), 0.0)
    rho, pairs = correlation(centred, centred, lags)[1:], correlation(present * 1.0, present * 1.0, lags)[1:] * count
    each = np.where(pairs > 0.5, (rho * count) ** 2 / np.maximum(pairs, 1.0), 1.0)
    return float(each.sum()) * (1 + 2 / max(count, 1))


class InputTest(NamedTuple):
    """Result of the test of residuals' independence from inputs.

    Attributes
    ----------
    correlation : (n_y, n_u, n_lags + 1) array
        Correlation of the residual behind the input, at lags from 0.
    variance : (n_y, n_u, n_lags + 1) array
        Number of samples times the covariance of correlations at lags 0, 1, ... apart, for independent signals.
    statistic, freedom : (n_y, n_u) array
        Test statistic over all lags together, and its degrees of freedom.
    """

    correlation: FloatArray
    variance: FloatArray
    statistic: FloatArray
    freedom: FloatArray

    @property
    def p_value(self) -> FloatArray:
        """Probability of a larger statistic for independent residuals, (n_y, n_u); 1 for a constant input."""
        return np.where(self.freedom > 0, scipy.special.chdtrc(np.maximum(self.freedom, 1), self.statistic), 1.0)


def input_test(residuals: FloatArray, inputs: FloatArray, lags: int, *, white: bool = False) -> InputTest:
    """Return the test of independence of one record's residuals from its inputs, at lags from 0.

    Parameters
    ----------
    residuals : (n_samples, n_y) array
        Residuals; their means do not count.
    inputs : (n_samples, n_u) array
        Inputs; their means do not count.
    lags : int
        Largest lag of the residual behind the input [samples].
    white : bool
        Whether the residuals are known to be white, so that their colour need not be estimated.

    Returns
    -------
    InputTest

    Notes
    -----
    The covariance of the correlations is ``sum_l rho_e(l) rho_u(l + k)`` (Bartlett), with a triangular window on the
    autocorrelation of the residuals. The window reduces the noise of long lags and keeps the covariance positive. For
    a slow input the correlations at neighbouring lags are almost equal: directions with hardly a variance do not count.
    """
    n, most = len(residuals), 0 if white else 2 * lags
    u = centred_rows(inputs)
    present = residuals != 0
    gaps = not present.all()  # samples are missing or left out
    if gaps:
        e = np.where(present, residuals - residuals.sum(0) / present.sum(0).clip(1), 0.0).T.copy()
    else:
        e = centred_rows(residuals)
    size_e, size_u = (np.sqrt(np.einsum("ik,ik->i", part, part)) for part in (e, u))
    scale = np.where((size_e > 0)[:, None] & (size_u > 0), np.outer(size_e, size_u), np.inf)
    cross = np.array([e[:, lag:] @ u[:, : n - lag].T for lag in range(lags + 1)]).transpose(1, 2, 0)
    cross /= scale[:, :, None]
    of_source = np.array([correlation(channel, channel, most + lags) for channel in u]).reshape(len(u), most + lags + 1)
    window = 1 - np.arange(most + 1) / (most + 1)
    of_residual = np.array([correlation(channel, channel, most) * window if most else [1.0] for channel in e])
    both = np.concatenate([of_residual[:, :0:-1], of_residual], axis=1)
    distance = np.abs(np.arange(-most, most + 1)[:, None] + np.arange(lags + 1))
    variance = np.einsum("yl,ulk->yuk", both, of_source[:, distance])
    statistic, freedom = np.zeros((2, *scale.shape))
    for i in range(len(u)):
        for j in range(len(e)):
            if j == 0 or gaps or not white:  # for white residuals it is the same for all outputs
                if gaps:
                    covariance = _of_pairs(e[j], u[i], of_residual[j], lags)
                else:
                    covariance = scipy.linalg.toeplitz(variance[j, i])
                variance[j, i] = covariance[0]
                values, vectors = np.linalg.eigh(covariance)
                kept = values > 1e-6 * values[-1]
                spread = vectors[:, kept] / np.sqrt(values[kept])
            statistic[j, i] = n * float(((cross[j, i] @ spread) ** 2).sum())
            freedom[j, i] = spread.shape[1]
    return InputTest(cross, variance, statistic, freedom)


def _of_pairs(residuals: FloatArray, source: FloatArray, colour: FloatArray, lags: int) -> FloatArray:
    """Return the covariance of correlations, (n_lags + 1, n_lags + 1), for residuals with gaps (zeros).

    It is that of the samples of the input that meet a residual. An input whose levels change in step with the gaps is
    not alike at all of them.
    """
    present, n = residuals != 0, len(residuals)
    count = float(present.sum())
    pairs = correlation(present * 1.0, present * 1.0, len(colour) - 1)
    rho = np.where(pairs * count > 0.5, colour / np.maximum(pairs, 1 / max(count, 1)), 0.0)
    met = np.array([np.concatenate([np.zeros(lag), source[: n - lag]]) for lag in range(lags + 1)]) * present
    size = scipy.fft.next_fast_len(n + len(rho), real=True)
    filtered = scipy.fft.irfft(scipy.fft.rfft(met, size) * (2 * scipy.fft.rfft(rho, size).real - rho[0]), size)[:, :n]
    return np.asarray(met @ filtered.T) * (n / max(count * float(source @ source), np.finfo(float).tiny))


def followed(errors: Sequence[FloatArray], inputs: Sequence[FloatArray], *, white: bool) -> FloatArray:
    """Return the p-value of the correlation of residuals with inputs, over several records, (n_y, n_u).

    Parameters
    ----------
    errors, inputs : sequence of (n_samples, n_y) and (n_samples, n_u) array
        Residuals and inputs of each record; records of less than four times the lags do not count.
    white : bool
        Whether the residuals are known to be white.
    """
    shape = errors[0].shape[1], inputs[0].shape[1]
    tests = [input_test(e, u, LAGS, white=white) for e, u in zip(errors, inputs, strict=True) if len(e) >= 4 * LAGS]
    total = InputTest(
        np.zeros((*shape, 0)),
        np.zeros((*shape, 0)),
        sum((test.statistic for test in tests), np.zeros(shape)),
        sum((test.freedom for test in tests), np.zeros(shape)),
    )
    return total.p_value
