"""Standard deviations of what follows from the model of a fit: modes, static gain, and slopes of its matrices."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from gbid.arrays import FloatArray
from gbid.discretise import Dual
from gbid.identify.curves.slopes import model_slopes, nonlinear_slopes
from gbid.identify.curves.uncertain_model import ModelSlopes
from gbid.identify.nlp.record_group import RecordGroup
from gbid.identify.nlp.shooting import Shooting
from gbid.identify.nonlinear.nonlinear_predictor import NonlinearPredictor
from gbid.identify.nonlinear.working_point import linearised
from gbid.identify.predictor import Predictor
from gbid.identify.uncertainty.propagation import mode_slopes, spread, static_gain_slopes
from gbid.structure import LinearModel, NonlinearModel


class ModelSpreads(NamedTuple):
    """Derivatives and standard deviations of the model of the first recording.

    Attributes
    ----------
    slopes : ModelSlopes
        Derivatives of its matrices by all free parameters.
    modes : (n_modes, 2) array
        Standard deviations of natural frequencies [Hz] and damping factors.
    static_gain : (n_outputs, n_inputs) array
        Standard deviations of the static gain; nan for a model with a pole at zero.
    """

    slopes: ModelSlopes
    modes: FloatArray
    static_gain: FloatArray


def model_spreads(
    problem: Shooting,
    theta: FloatArray,
    chosen: FloatArray,
    model: LinearModel | NonlinearModel,
    names: Sequence[str],
    tie: FloatArray | None = None,
) -> ModelSpreads:
    """Return slopes and standard deviations; of a nonlinear model those of the linear one at its working point.

    Parameters
    ----------
    problem : Shooting
        Problem of the fit.
    theta : (n_p,) array
        Free parameters.
    chosen : (n_p, n_p) array
        Their covariance.
    model : LinearModel or NonlinearModel
        Model of the first recording.
    names : sequence of str
        Names of the parameters of the structure.
    tie : (n_own, n_p) array, optional
        Matrix from all free parameters to the predictor's own at the model's point, for a scheduled structure.
    """
    part = problem.parts[0]
    if tie is not None:
        return _of_tied(part, theta, chosen, model, tie)
    if isinstance(part.predictor, Predictor):
        A, B, C, D, _, B_delayed, _ = part.predictor.matrices(theta[part.index])
        B = Dual(B.value + B_delayed.value, B.slope + B_delayed.slope)
        slopes = model_slopes(part.predictor, theta, part.index)
    else:
        assert isinstance(part.predictor, NonlinearPredictor)
        assert isinstance(model, NonlinearModel)
        A, B, C, D = linearised(model, names, [q.name for q in part.predictor.free])
        slopes = nonlinear_slopes([A, B, C, D], part.predictor, theta, part.index)
    own, gain_std = chosen[np.ix_(part.index, part.index)], np.full(D.value.shape, np.nan)
    if not (np.isfinite(own).all() and np.isfinite(A.value).all()):
        return ModelSpreads(slopes, np.full((len(model.modes()), 2), np.nan), gain_std)
    dt = model.dt if isinstance(model, LinearModel) else None
    still = A if dt is None else A - np.eye(A.shape[0])  # at rest x[k+1] = x[k]
    if np.linalg.cond(still.value) < 1e15:
        gain_std = spread(static_gain_slopes(still, B, C, D)[1], own)
    return ModelSpreads(slopes, spread(mode_slopes(A, dt)[1], own), gain_std)


def _of_tied(
    part: RecordGroup, theta: FloatArray, chosen: FloatArray, model: LinearModel | NonlinearModel, tie: FloatArray
) -> ModelSpreads:
    """Return the same where the parameters of the model are linear in the free ones."""
    assert isinstance(part.predictor, Predictor)
    own, every = tie @ theta, np.arange(len(tie))
    of_own = model_slopes(part.predictor, own, every)
    slopes = ModelSlopes(*(np.tensordot(tie.T, slope, 1) for slope in vars(of_own).values()))
    A, B, C, D, _, B_delayed, _ = part.predictor.matrices(own)
    B = Dual(B.value + B_delayed.value, B.slope + B_delayed.slope)
    covariance, gain_std = tie @ chosen @ tie.T, np.full(D.value.shape, np.nan)
    if not (np.isfinite(covariance).all() and np.isfinite(A.value).all()):
        return ModelSpreads(slopes, np.full((len(model.modes()), 2), np.nan), gain_std)
    if np.linalg.cond(A.value) < 1e15:
        gain_std = spread(static_gain_slopes(A, B, C, D)[1], covariance)
    return ModelSpreads(slopes, spread(mode_slopes(A, None)[1], covariance), gain_std)
