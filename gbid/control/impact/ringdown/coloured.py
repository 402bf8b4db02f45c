"""Covariance of least squares when the residuals are correlated in time and between channels."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gbid.arrays import BoolArray, FloatArray

MEMORY_S = 20e-3
"""Longest correlation time of the residuals that is taken into account [s]: two periods of the slowest mode."""


def autocovariance(residuals: Sequence[FloatArray], used: Sequence[BoolArray], n_lags: int) -> FloatArray:
    """Return the autocovariance of residuals up to a number of lags, pooled over recordings.

    Parameters
    ----------
    residuals : sequence of (n_samples, n_channels) array
        Residuals of each recording; zero where not used.
    used : sequence of (n_samples,) bool array
        Samples that are used.
    n_lags : int
        Largest lag [samples].

    Returns
    -------
    (n_lags + 1, n_channels, n_channels) array
        Entry [l, i, j] is E[e_i(t + l) e_j(t)], with the triangular weights of Bartlett, which keep the whole matrix
        positive semidefinite (Newey and West 1987).
    """
    n = residuals[0].shape[1]
    total, count = np.zeros((n_lags + 1, n, n)), 0
    for e, mask in zip(residuals, used, strict=True):
        for lag in range(min(n_lags, len(e) - 1) + 1):
            total[lag] += e[lag:].T @ e[: len(e) - lag]
        count += int(mask.sum())
    weights = 1 - np.arange(n_lags + 1) / (n_lags + 1)
    return np.asarray(total * weights[:, None, None] / max(count, 1))


def sandwich(influence: Sequence[FloatArray], covariance: FloatArray) -> FloatArray:
    r"""Return the covariance of :math:`\sum_t J(t)^T e(t)` for stationary e and independent recordings.

    Parameters
    ----------
    influence : sequence of (n_samples, n_channels, n_parameters) array
        J of each recording, zero where samples are not used.
    covariance : (n_lags + 1, n_channels, n_channels) array
        Autocovariance from `autocovariance`.

    Returns
    -------
    (n_parameters, n_parameters) array
        Covariance of the sum.
    """
    n_parameters = influence[0].shape[2]
    total = np.zeros((n_parameters, n_parameters))
    for J in influence:
        for lag, gamma in enumerate(covariance[: len(J)]):
            late, early = J[lag:].reshape(-1, n_parameters), np.matmul(gamma, J[: len(J) - lag])
            part = late.T @ early.reshape(-1, n_parameters)
            total += part if lag == 0 else part + part.T
    return total
