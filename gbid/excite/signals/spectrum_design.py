r"""Optimal spectrum of the inputs: a convex programme over the cross spectra of all lines.

With the cross spectrum :math:`\Phi_f \succeq 0` of the inputs at line f the information is
:math:`M = M_0 + \sum_f \mathrm{Re}\,\Psi_f \Phi_f \Psi_f^H`. The criterion of M is maximised while the mean squares of
the limited signals, :math:`\sum_f \mathrm{tr}(C_{if} \Phi_f)`, stay below one.

With :math:`\Phi_f = L_f L_f^H` and the limits as one norm of the mean squares, which is smooth and scales with the
signals, this is an unconstrained problem for a quasi-Newton method. In the cross spectra it is convex, so the
stationary point is the optimum; but this is not relied on.

The equivalence theorem (Kiefer and Wolfowitz 1960) gives the certificate: with multipliers w, no spectrum within the
limits has a criterion higher by more than :math:`\max_f \lambda_{max}(S_f; \sum_i w_i C_{if}) - \mathrm{tr}(P (M -
M_0))`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy

from gbid.arrays import ComplexArray, FloatArray
from gbid.excite.design_goal import DesignGoal

_NORMS = (15.0, 100.0)  # exponents of the norm of the mean squares, one after the other
_OPTIONS = {"maxiter": 400, "maxcor": 30}


class Spectrum(NamedTuple):
    """Optimal spectrum with its certificate.

    Attributes
    ----------
    cross : (n_lines, n_inputs, n_inputs) array
        Cross spectra: mean squares and mean products of the inputs at each line, for limits of one.
    multipliers : (n_limits,) array
        Multipliers of the limits; zero for those that do not matter.
    gap : float
        Duality gap per counted quantity: standard deviations are on average at most half of this, as a part, above
        those of the best spectrum.
    sensitivity : (n_lines, n_inputs, n_inputs) array
        Sensitivities S at the optimum: ``tr(S Phi)`` is what a cross spectrum adds.
    """

    cross: ComplexArray
    multipliers: FloatArray
    gap: float
    sensitivity: ComplexArray


def optimal_spectrum(
    goal: DesignGoal, sensitivity: ComplexArray, costs: ComplexArray, n_samples: int, earlier: FloatArray
) -> Spectrum:
    """Return the spectrum with the best criterion within limits of the mean squares.

    Parameters
    ----------
    goal : DesignGoal
        The criterion.
    sensitivity : (n_lines, n_free, n_outputs, n_inputs) array
        Sensitivities of the predictions, for errors of unit covariance.
    costs : (n_limits, n_lines, n_inputs, n_inputs) array
        Mean square of each limited signal over its limit, by the cross spectra.
    n_samples : int
        Length of the recording.
    earlier : (n_free, n_free) array
        Information that is there without the excitation.

    Returns
    -------
    Spectrum
    """
    n_lines, _, _, n_u = sensitivity.shape
    psi = np.sqrt(n_samples) * sensitivity  # the mean square Phi of a line has the information Re psi Phi psi^H
    scale = costs.mean(axis=0)
    into = _root(scale, -0.5)
    psi, costs = psi @ into[:, None], into @ costs @ into
    root = np.repeat(np.eye(n_u, dtype=complex)[None], n_lines, axis=0)

    def loss(flat: FloatArray, exponent: float) -> tuple[float, FloatArray]:
        factors = _complex(flat, root.shape)
        cross = factors @ factors.conj().transpose(0, 2, 1)
        used = _mean_squares(costs, cross)
        size = float(np.linalg.norm(used, exponent))
        raw = _information(psi, factors) / size
        value = goal.loss(raw + earlier)
        P = goal.gradient(raw + earlier)
        turn = np.sum(P * raw) * (used / size) ** (exponent - 1)
        slope = (np.einsum("i,ifuv->fuv", turn, costs) - _sensitivities(psi, P)) @ factors * (2 / size)
        return value, np.ascontiguousarray(slope).view(float).ravel()

    for exponent in _NORMS:
        root /= np.sqrt(np.linalg.norm(_mean_squares(costs, root @ root.conj().transpose(0, 2, 1)), exponent))
        found = scipy.optimize.minimize(
            loss, root.view(float).ravel(), (exponent,), jac=True, method="L-BFGS-B", options=_OPTIONS
        )
        root = _complex(found.x, root.shape)
    used = _mean_squares(costs, root @ root.conj().transpose(0, 2, 1))
    root /= np.sqrt(used.max())
    multipliers = (used / used.max()) ** (_NORMS[-1] - 1)
    multipliers /= multipliers.sum()
    gap = _gap(goal, psi, root, costs, multipliers, earlier)
    S = _sensitivities(psi, goal.gradient(_information(psi, root) + earlier))
    back, root = _root(scale, 0.5), into @ root
    return Spectrum(root @ root.conj().transpose(0, 2, 1), multipliers, gap, back @ S @ back)


def _complex(flat: FloatArray, shape: tuple[int, ...]) -> ComplexArray:
    return np.ascontiguousarray(flat).view(complex).reshape(shape)


def _mean_squares(costs: ComplexArray, cross: ComplexArray) -> FloatArray:
    return np.asarray(np.einsum("ifuv,fvu->i", costs, cross).real)


def _information(psi: ComplexArray, root: ComplexArray) -> FloatArray:
    moved = (psi @ root[:, None]).transpose(1, 0, 2, 3).reshape(psi.shape[1], -1)
    return np.asarray((moved @ moved.conj().T).real)


def _sensitivities(psi: ComplexArray, P: FloatArray) -> ComplexArray:
    """Return ``Psi^H P Psi`` at each line, (n_lines, n_u, n_u), which is not negative."""
    values, vectors = np.linalg.eigh(P)
    turned = np.einsum("pq,fpyu->fqyu", vectors * np.sqrt(np.maximum(values, 0.0)), psi, optimize=True)
    flat = turned.reshape(len(psi), -1, psi.shape[3])
    return np.asarray(flat.conj().transpose(0, 2, 1) @ flat)


def _gap(
    goal: DesignGoal,
    psi: ComplexArray,
    root: ComplexArray,
    costs: ComplexArray,
    multipliers: FloatArray,
    earlier: FloatArray,
) -> float:
    """Return by how much the criterion per quantity could still be better, at most."""
    own = _information(psi, root)
    P = goal.gradient(own + earlier)
    into = _root(np.einsum("i,ifuv->fuv", multipliers, costs), -0.5)
    highest = np.linalg.eigvalsh(into @ _sensitivities(psi, P) @ into)[:, -1].max()
    return float(highest - np.sum(P * own))


def _root(matrices: ComplexArray, power: float) -> ComplexArray:
    """Return a power of Hermitian matrices that are not negative."""
    values, vectors = np.linalg.eigh(matrices)
    values = np.maximum(values, np.finfo(float).tiny if power < 0 else 0.0) ** power
    return np.asarray((vectors * values[:, None, :]) @ vectors.conj().transpose(0, 2, 1))
