"""Derivatives of the matrices of a fitted model by all free parameters of the fit."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gbid.arrays import FloatArray, IntArray
from gbid.discretise import Dual
from gbid.identify.curves.uncertain_model import ModelSlopes
from gbid.identify.nonlinear.nonlinear_predictor import NonlinearPredictor
from gbid.identify.predictor import Predictor


def model_slopes(predictor: Predictor, theta: FloatArray, index: IntArray) -> ModelSlopes:
    """Return the derivatives of the matrices of a model by the free parameters of a fit.

    Parameters
    ----------
    predictor : Predictor
        Predictor of a recording; its free parameters are some of those of the fit.
    theta : (n_free,) array
        All free parameters of the fit.
    index : (n,) integer array
        Positions of the free parameters of the predictor in `theta`.

    Returns
    -------
    ModelSlopes
        Derivatives; zero for the parameters of other recordings and for offsets.
    """

    def spread_out(slope: FloatArray) -> FloatArray:
        return _among_all(slope, len(theta), index)

    A, B, C, D, K, B_delayed, late = predictor.matrices(theta[index])
    return ModelSlopes(
        A=spread_out(A.slope),
        B=spread_out(B.slope),
        C=spread_out(C.slope),
        D=spread_out(D.slope),
        B_delayed=spread_out(B_delayed.slope),
        delay=spread_out(_delays(predictor, late)),
        K=spread_out(K.slope),
    )


def nonlinear_slopes(
    matrices: Sequence[Dual], predictor: NonlinearPredictor, theta: FloatArray, index: IntArray
) -> ModelSlopes:
    """Return the same for A, B, C and D of a linearised model; all inputs are in B."""
    A, B, C, D = (_among_all(m.slope, len(theta), index) for m in matrices)
    late = np.isin(np.arange(B.shape[2]), predictor.delayed)
    delay = _among_all(predictor.delay_slopes(theta[index]), len(theta), index)
    return ModelSlopes(A, np.where(late, 0.0, B), C, D, np.where(late, B, 0.0), delay)


def _among_all(slope: FloatArray, n_free: int, index: IntArray) -> FloatArray:
    found = np.zeros((n_free, *slope.shape[1:]))
    np.add.at(found, index, slope)
    return found


def _delays(predictor: Predictor, late: Dual) -> FloatArray:
    """Return the derivatives of the delays of all inputs; the predictor has those of the delayed inputs only."""
    slope = np.zeros((len(late.slope), predictor.n_inputs))
    slope[:, list(predictor.delayed)] = late.slope[:, :, 0]
    return slope
