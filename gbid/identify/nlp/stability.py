"""How far predictors are from instability, to which a disturbance gain can lead them."""

from __future__ import annotations

import numpy as np

from gbid.arrays import FloatArray
from gbid.identify.predictor import Predictor, PredictorValues

EDGE = 0.02
"""Of the model's own margin: a gain that leaves no more is no estimate."""
CLEAR = 0.2
"""Of the same: a gain that leaves more can be started from."""


def spectral_radius(values: list[PredictorValues]) -> float:
    """Largest magnitude of the predictors' eigenvalues; infinite where they overflow."""
    transitions = [v.F for v in values]
    if not all(np.isfinite(F).all() for F in transitions):
        return np.inf
    return max(float(np.abs(np.linalg.eigvals(F)).max()) for F in transitions)


def near_instability(predictor: Predictor, own: FloatArray, share: float) -> bool:
    """Whether the disturbance gain leaves no more than a share of the model's own margin of stability.

    Parameters
    ----------
    predictor : Predictor
    own : (n_own,) array
        Values of its parameters.
    share : float
    """
    still = np.array(own, float)
    still[list(predictor.noise)] = 0.0
    return 1 - spectral_radius([predictor.at(own)]) <= share * (1 - spectral_radius([predictor.at(still)]))
