"""Linear predictor at the mean of a trajectory, for what the feedback of errors adds to the uncertainty."""

from __future__ import annotations

import numpy as np

from gbid.arrays import BoolArray, FloatArray
from gbid.identify.kernel.block_sums import Prediction
from gbid.identify.kernel.blocks import Blocks
from gbid.identify.nonlinear.mapped import MappedRunner
from gbid.identify.nonlinear.nonlinear_predictor import NonlinearValues
from gbid.identify.predictor import PredictorValues

_DIFFERENCE = 1e-5  # relative step of a central difference


def mean_predictor(run: MappedRunner, v: NonlinearValues, blocks: Blocks, prediction: Prediction) -> PredictorValues:
    """Return the predictor of small deviations from the mean state and the mean regressors.

    For a linear structure it is the predictor itself. Its regressors are the measured outputs alone.

    Parameters
    ----------
    run : MappedRunner
        Runner of the functions of a sample.
    v : NonlinearValues
        Predictor at the estimate.
    blocks : Blocks
        Samples.
    prediction : Prediction
        States and errors.
    """
    n_y = blocks.y.shape[2]
    live = np.arange(blocks.length)[None, :, None] < blocks.size.reshape(-1, 1, blocks.lanes)
    x, z, size = (
        _mean(prediction.states, live),
        _mean(blocks.z(v.shift), live),
        np.sqrt(_mean(blocks.z(v.shift) ** 2, live)[-n_y:]),
    )
    size = np.where(size > 0, size, 1.0)

    def at(theta: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        own = v._replace(theta=theta)
        F, C = run.one_sample(own, x, z)[1:]
        sides = []
        for j in range(n_y):
            moved = np.zeros(len(z))
            moved[len(z) - n_y + j] = step = _DIFFERENCE * size[j]
            sides.append((run.one_sample(own, x, z + moved)[0] - run.one_sample(own, x, z - moved)[0]) / (2 * step))
        return F, np.stack(sides, axis=1), C

    F, G, C = at(v.theta)
    slopes = []
    for i, value in enumerate(v.theta):
        moved = np.zeros(len(v.theta))
        moved[i] = step = _DIFFERENCE * (abs(value) if value else 1.0)
        slopes.append([(a - b) / (2 * step) for a, b in zip(at(v.theta + moved), at(v.theta - moved), strict=True)])
    dF, dG, dC = (np.array([slope[i] for slope in slopes]) for i in range(3))
    none = np.zeros((n_y, n_y))
    return PredictorValues(F, G, C, none, dF, dG, dC, np.zeros((len(v.theta), n_y, n_y)), ())


def _mean(values: FloatArray, live: BoolArray) -> FloatArray:
    """Return the mean of values (n_groups, length, n, lanes) over the samples of all blocks, (n,)."""
    return np.asarray(np.where(live[:, :, None], values, 0.0).sum(axis=(0, 1, 3)) / live.sum())
