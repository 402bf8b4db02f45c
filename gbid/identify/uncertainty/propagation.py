"""Uncertainty of modes and static gains, propagated from that of the parameters."""

from __future__ import annotations

import numpy as np

from gbid.arrays import FloatArray
from gbid.discretise import Dual
from gbid.poles import one_of_each_pair, oscillatory_modes, poles_of_samples


def mode_slopes(A: Dual, dt: float | None = None) -> tuple[FloatArray, FloatArray]:
    """Return the oscillatory modes of a state matrix and their derivatives.

    Parameters
    ----------
    A : Dual
        State matrix (n, n) with its derivatives by n_p parameters.
    dt : float, optional
        Sample time of a discrete-time matrix [s], whose poles are ``log(eigenvalue) / dt``.

    Returns
    -------
    modes : (n_modes, 2) array
        Natural frequency [Hz] and damping factor, in the order of rising frequency.
    slopes : (n_modes, 2, n_p) array
        Derivatives of the modes.

    Notes
    -----
    ``d lambda = w' dA v / (w' v)`` with right and left eigenvectors v and w; for
    ``f = |lambda| / 2 pi`` and ``zeta = -Re(lambda) / |lambda|`` the chain rule applies. For a double eigenvalue the
    derivative does not exist; near one the result is very large.
    """
    values, vectors = np.linalg.eig(A.value)
    poles = values.astype(complex) if dt is None else poles_of_samples(values, dt)
    left = np.linalg.inv(vectors)
    keep = one_of_each_pair(poles)
    order = [i for i in np.argsort(np.abs(poles)) if keep[i]]
    modes, slopes = oscillatory_modes(poles), np.zeros((len(order), 2, len(A.slope)))
    for row, i in enumerate(order):
        pole, size = poles[i], abs(poles[i])
        d_pole = np.einsum("a,pab,b->p", left[i], A.slope, vectors[:, i]) / (1.0 if dt is None else values[i] * dt)
        d_size = (np.conj(pole) * d_pole).real / size
        slopes[row] = d_size / (2 * np.pi), -d_pole.real / size + pole.real * d_size / size**2
    return modes, slopes


def static_gain_slopes(A: Dual, B: Dual, C: Dual, D: Dual) -> tuple[FloatArray, FloatArray]:
    """Return the static gain ``D - C A^-1 B`` and its derivatives.

    Parameters
    ----------
    A, B, C, D : Dual
        Matrices of a model without a pole at zero.

    Returns
    -------
    gain : (n_y, n_u) array
        Static gain.
    slopes : (n_y, n_u, n_p) array
        Derivatives of the gain.
    """
    inverse = np.asarray(np.linalg.inv(A.value), float)
    A_inverse = Dual(inverse, -inverse @ A.slope @ inverse)
    gain = D - C @ (A_inverse @ B)
    return gain.value, gain.slope.transpose(1, 2, 0)


def spread(slopes: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return standard deviations from derivatives (..., n_p) and the covariance of the parameters."""
    return np.asarray(np.sqrt(np.maximum(np.einsum("...p,pq,...q->...", slopes, covariance, slopes), 0.0)))
