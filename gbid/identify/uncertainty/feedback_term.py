"""Share of the disturbance gain in the covariance of the gradient, when errors are coloured."""

from __future__ import annotations

import numpy as np

from gbid.arrays import FloatArray
from gbid.identify.predictor import PredictorValues
from gbid.identify.uncertainty.error_model import ErrorModel

_UNIFORM = 256  # frequencies from 0 to pi
_NEAR = np.geomspace(0.1, 100.0, 14)  # distances of further frequencies from a pole, in units of its half width


def feedback_term(v: PredictorValues, model: ErrorModel, weight: FloatArray) -> FloatArray | None:
    """Return what the feedback of errors adds to the covariance of the gradient, for each sample.

    Parameters
    ----------
    v : PredictorValues
        One-step predictor whose last regressors are the measured outputs.
    model : ErrorModel
        Model of the errors.
    weight : (n_y, n_y) array
        Weight W of the errors.

    Returns
    -------
    (n_p, n_p) array or None
        The term; None for a model that is unstable without its predictor.

    Notes
    -----
    A disturbance gain feeds the errors back into the sensitivities, ``psi_i = G_i e + ...``. The gradient is then
    quadratic in the errors. For Gaussian errors with spectrum S its covariance is, besides the sum over
    ``psi_i' W E[e e'] W psi_j``, the mean over frequencies of ``trace(W G_i S W G_j S)`` (Isserlis, 1918). It is zero
    for white errors, because G_i contains only earlier errors.
    """
    n, n_y = v.F.shape[0], v.C.shape[0]
    gain, gain_slopes = v.G[:, -n_y:], v.dG[:, :, -n_y:]
    own = v.F + gain @ v.C
    poles = np.concatenate([np.linalg.eigvals(own), np.linalg.eigvals(v.F)])
    if np.abs(poles).max() >= 1:
        return None
    w = _frequencies(poles)
    z = np.exp(1j * w)[:, None, None]
    state = np.linalg.solve(z * np.eye(n) - own, np.broadcast_to(gain + 0j, (len(w), n, n_y)))
    output = v.C @ state + np.eye(n_y)
    onto = np.linalg.solve(z * np.eye(n) - v.F.T, np.broadcast_to(v.C.T + 0j, (len(w), n, n_y))).transpose(0, 2, 1)
    spectrum = model.spectrum(w)
    terms = []
    for dF, dG, dC in zip(v.dF, gain_slopes, v.dC, strict=True):
        response = dC @ state + onto @ (dF @ state + dG @ output)
        terms.append(weight @ response @ spectrum)
    found = np.array(terms)
    steps = np.diff(w, prepend=w[0]) / 2 + np.diff(w, append=w[-1]) / 2
    return np.asarray(np.einsum("ifab,jfba,f->ij", found, found, steps, optimize=True).real / np.pi)


def _frequencies(poles: FloatArray) -> FloatArray:
    """Return frequencies from 0 to pi, close together near the poles."""
    angles, widths = np.abs(np.angle(poles)), 1 - np.abs(poles)
    near = angles[:, None] + widths[:, None] * np.concatenate([-_NEAR, [0.0], _NEAR])
    grid = np.concatenate([np.linspace(0, np.pi, _UNIFORM), near.ravel()])
    return np.unique(grid[(grid >= 0) & (grid <= np.pi)])
