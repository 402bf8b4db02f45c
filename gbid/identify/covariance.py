"""Covariance of the estimates from the Gauss-Newton information."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from gbid.identify.blocks import Blocks
from gbid.identify.predictor import PredictorValues
from gbid.identify.sweep import Sweep, sweep

FloatArray = npt.NDArray[np.float64]
_UNDETERMINED = 1e-14  # eigenvalue of the scaled information below which a direction counts as not determined


class Covariance(NamedTuple):
    """Uncertainty of the free parameters, initial states estimated along.

    Attributes
    ----------
    parameters : (n_p, n_p) array
    undetermined : (n_directions, n_p) array
        Unit directions, in scaled parameters, that the data say nothing about; mostly empty.
    """

    parameters: FloatArray
    undetermined: FloatArray


def covariance(
    values: PredictorValues,
    records: Blocks,
    initial_states: FloatArray,
    weight: FloatArray,
    error_covariance: FloatArray,
    held: npt.NDArray[np.bool_],
) -> Covariance:
    """Covariance of the parameters for white prediction errors.

    Parameters
    ----------
    values : PredictorValues
        At the estimate.
    records : Blocks
        The data, each record as one window.
    initial_states : (n_records, n) array
    weight : (n_y, n_y) array
        Weight ``W`` that the estimate was found with.
    error_covariance : (n_y, n_y) array
        ``Lambda``, covariance of the prediction errors.
    held : (n_p,) boolean array
        Parameters on a bound: they count as known, and get zero rows.

    Returns
    -------
    Covariance

    Notes
    -----
    With ``H = sum psi' W psi`` and ``J = sum psi' W Lambda W psi`` over parameters and initial states,
    ``P = H^-1 J H^-1`` (Ljung, System Identification, Sec. 9.4); for ``W = Lambda^-1`` that is ``H^-1``.
    """
    n_p = len(values.dF)
    H = _arrow(sweep(values, records, initial_states, weight))
    J = _arrow(sweep(values, records, initial_states, weight @ error_covariance @ weight))
    keep = np.concatenate([~held, np.ones(len(H) - n_p, bool)])
    H, J = H[np.ix_(keep, keep)], J[np.ix_(keep, keep)]
    scale = np.sqrt(np.maximum(np.diag(H), np.finfo(float).tiny))
    eigenvalues, vectors = np.linalg.eigh(H / np.outer(scale, scale))
    dark = eigenvalues < _UNDETERMINED * eigenvalues[-1]
    inverse = (vectors[:, ~dark] / eigenvalues[~dark]) @ vectors[:, ~dark].T
    full = inverse @ (J / np.outer(scale, scale)) @ inverse / np.outer(scale, scale)
    n_kept = int((~held).sum())
    result = np.zeros((n_p, n_p))
    result[np.ix_(~held, ~held)] = full[:n_kept, :n_kept]
    directions = np.zeros((int(dark.sum()), n_p))
    directions[:, ~held] = vectors[:n_kept, dark].T
    # A direction among initial states alone is no concern of the parameters.
    return Covariance(result, directions[np.linalg.norm(directions, axis=1) > 1e-3])


def _arrow(s: Sweep) -> FloatArray:
    """Information matrix over parameters and the initial state of every record."""
    n_records, n_p, n = s.hessian_mixed.shape
    H = np.zeros((n_p + n_records * n, n_p + n_records * n))
    H[:n_p, :n_p] = s.hessian
    for i in range(n_records):
        part = slice(n_p + i * n, n_p + (i + 1) * n)
        H[:n_p, part] = s.hessian_mixed[i]
        H[part, :n_p] = s.hessian_mixed[i].T
        H[part, part] = s.hessian_start[i]
    return H
