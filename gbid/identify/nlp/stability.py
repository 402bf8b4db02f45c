"""Distance of predictors from instability, which a disturbance gain can reduce."""

from __future__ import annotations

import numpy as np

from gbid.arrays import FloatArray
from gbid.identify.kernel.growth import spectral_radius
from gbid.identify.predictor import Predictor

EDGE = 0.02
"""Of the model's own margin: a gain that leaves no more is no estimate."""
CLEAR = 0.2
"""Of the same: a gain that leaves more can be started from."""


def near_instability(predictor: Predictor, own: FloatArray, share: float) -> bool:
    """Return whether the disturbance gain leaves at most a share of the stability margin of the model.

    Parameters
    ----------
    predictor : Predictor
        The predictor.
    own : (n_own,) array
        Values of its parameters.
    share : float
        The share.
    """
    still = np.array(own, float)
    still[[i for i in predictor.noise if i not in predictor.walks]] = 0.0  # a slow random walk is a valid estimate
    margin = 1 - spectral_radius([predictor.at(still)])
    return (margin > 0 or not predictor.walks) and 1 - spectral_radius([predictor.at(own)]) <= share * margin
