"""Frequency grid adapted to the poles of a model."""

from __future__ import annotations

from math import inf

import numpy as np

from gbid.arrays import FloatArray
from gbid.structure.numeric.linear_model import LinearModel


def frequency_grid(model: LinearModel, n: int = 400) -> FloatArray:
    """Return frequencies with logarithmic spacing, and dense around each oscillatory pole.

    Parameters
    ----------
    model : LinearModel
        The model.
    n : int
        Number of frequencies with logarithmic spacing.

    Returns
    -------
    (n_frequencies,) array
        Frequencies from 0 [Hz], ascending, up to ten times the fastest pole or half the sampling frequency.
    """
    poles = model.poles()
    rates = np.abs(poles)[np.isfinite(poles) & (np.abs(poles) > 0)] / (2 * np.pi)
    slowest, fastest = (rates.min(), rates.max()) if len(rates) else (0.1, 10.0)
    nyquist = inf if model.dt is None else 0.5 / model.dt
    even = np.geomspace(slowest / 30, min(10 * fastest, nyquist), n)
    pairs = poles[np.isfinite(poles) & (poles.imag > 0)]
    spread = np.concatenate([-np.geomspace(0.05, 5, 8)[::-1], [0.0], np.geomspace(0.05, 5, 8)])
    around = (pairs.imag[:, None] + np.abs(pairs.real)[:, None] * spread).ravel() / (2 * np.pi)
    grid = np.unique(np.concatenate([[0.0], even, around, rates]))
    return np.asarray(grid[(grid >= 0) & (grid <= nyquist)])
