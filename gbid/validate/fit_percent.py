"""Fit percent: share of a signal that a model explains."""

from __future__ import annotations

import numpy as np

from gbid.arrays import FloatArray


def fit_percent(measured: FloatArray, simulated: FloatArray) -> FloatArray:
    """Return the fit in percent, ``100 (1 - |y - yhat| / |y - mean y|)``, per output.

    Parameters
    ----------
    measured, simulated : (n_samples, n_outputs) array
        Measured and simulated outputs.

    Returns
    -------
    (n_outputs,) array
        100 for a perfect model, 0 for a model that is as good as the mean.
    """
    error = np.linalg.norm(measured - simulated, axis=0)
    return np.asarray(100 * (1 - error / np.linalg.norm(measured - measured.mean(axis=0), axis=0)))
