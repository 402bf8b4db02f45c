"""Growth of small deviations of the state: of a constant transition, or along a trajectory."""

from __future__ import annotations

import numpy as np

from gbid.arrays import FloatArray
from gbid.identify.predictor import PredictorValues

_TENFOLD = 10.0  # growth that counts
_TINY = float(np.finfo(float).tiny)


def spectral_radius(values: list[PredictorValues]) -> float:
    """Largest magnitude of the predictors' eigenvalues; infinite where they overflow."""
    transitions = [v.F for v in values]
    if not all(np.isfinite(F).all() for F in transitions):
        return np.inf
    return max(float(np.abs(np.linalg.eigvals(F)).max()) for F in transitions)


def growth_along(transitions: FloatArray, samples: int) -> float:
    """Return the growth of a small deviation in a sample, along a trajectory.

    It is that over the second half of the trajectory: a deviation that grows like time, as the phase of an oscillator
    does, is not unstable. Less than a tenfold growth counts as none.

    Parameters
    ----------
    transitions : (n_windows, n, n) array
        Derivatives of the end of each window by its start, for states of the order of one.
    samples : int
        Number of samples in all windows.
    """
    if not np.isfinite(transitions).all():
        return np.inf
    half = len(transitions) // 2
    (first, _), (second, after) = (_product(steps) for steps in (transitions[:half], transitions[half:]))
    there, here = (max(float(np.linalg.norm(product)), _TINY) for product in (second @ first, first))
    growth = float(np.log(there)) + after - (float(np.log(here)) if half else 0.0)
    growth *= len(transitions) / (len(transitions) - half)
    return float(np.exp((growth if growth > np.log(_TENFOLD) else min(growth, 0.0)) / samples))


def _product(steps: FloatArray) -> tuple[FloatArray, float]:
    """Return the product of all steps, the last on the left, and the logarithm of the factor that is left out.

    Neighbours are multiplied with one another, then their products, so that few calls do all.
    """
    log = 0.0
    while len(steps) > 1:
        last = steps[len(steps) // 2 * 2 :]
        steps = np.concatenate([steps[1::2] @ steps[: len(steps) // 2 * 2 : 2], last])
        size = np.maximum(np.sqrt(np.einsum("kij,kij->k", steps, steps)), _TINY)
        steps, log = steps / size[:, None, None], log + float(np.log(size).sum())
    return (steps[0], log) if len(steps) else (np.eye(steps.shape[1]), log)
