"""Growth of small deviations of the state: of a constant transition, or along a trajectory."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gbid.arrays import FloatArray
from gbid.identify.predictor import PredictorValues

_TENFOLD = 10.0  # growth that counts


def spectral_radius(values: list[PredictorValues]) -> float:
    """Largest magnitude of the predictors' eigenvalues; infinite where they overflow."""
    transitions = [v.F for v in values]
    if not all(np.isfinite(F).all() for F in transitions):
        return np.inf
    return max(float(np.abs(np.linalg.eigvals(F)).max()) for F in transitions)


def growth_along(transitions: Sequence[FloatArray], samples: int) -> float:
    """Return the growth of a small deviation in a sample, along a trajectory.

    It is that over the second half of the trajectory: a deviation that grows like time, as the phase of an oscillator
    does, is not unstable. Less than a tenfold growth counts as none.

    Parameters
    ----------
    transitions : sequence of (n, n) array
        Derivatives of the end of each window by its start, for states of the order of one.
    samples : int
        Number of samples in all windows.
    """
    if not all(np.isfinite(step).all() for step in transitions):
        return np.inf
    product, logs = np.eye(len(transitions[0])), [0.0]
    for step in transitions:
        product = step @ product
        size = max(float(np.linalg.norm(product)), float(np.finfo(float).tiny))
        logs.append(logs[-1] + float(np.log(size)))
        product = product / size
    half = len(transitions) // 2
    growth = (logs[-1] - logs[half]) * len(transitions) / (len(transitions) - half)
    return float(np.exp((growth if growth > np.log(_TENFOLD) else min(growth, 0.0)) / samples))
