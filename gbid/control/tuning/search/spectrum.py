"""Eigenvalues of many loops, their damping, and the derivatives of both by the gains."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from gbid.arrays import ComplexArray, FloatArray
from gbid.control.tuning.search.plane import FADE, brevity
from gbid.poles import REAL


def damping_factors(rates: ComplexArray, sample_time: float | None = None) -> FloatArray:
    """Return the damping factors ``-Re/|.|`` of oscillatory modes; 1 for real ones.

    Parameters
    ----------
    rates : complex array
        Eigenvalues in continuous time [rad/s].
    sample_time : float, optional
        Sample time of a sampled loop [s], in which modes shorter than a sample fade out, see `plane.brevity`.
    """
    magnitude = np.maximum(np.abs(rates), 1e-300)
    found = np.where(np.abs(rates.imag) > REAL * magnitude, -rates.real / magnitude, 1.0)
    return np.asarray(found + (1.0 - found) * brevity(rates, sample_time))


def bilinear(w: ComplexArray, M: FloatArray, v: ComplexArray) -> ComplexArray:
    """Return ``w M v`` of rows w (k, i), real matrices M (k, d, i, j) and columns v (k, j): (k, d)."""
    both = (w[:, :, None] * v[:, None, :]).reshape(len(w), w.shape[1] * v.shape[1])
    # One real product for real and imaginary part is faster than a complex copy of M.
    product = M.reshape(*M.shape[:2], both.shape[1]) @ np.stack([both.real, both.imag], axis=-1)
    return np.asarray(product[..., 0] + 1j * product[..., 1])


@dataclass(frozen=True)
class Eigensystem:
    """Eigenvalues (m, n), right eigenvectors as columns and left eigenvectors as rows, with ``W V = I``."""

    values: ComplexArray
    right: ComplexArray
    left: ComplexArray

    @classmethod
    def of(cls, A: FloatArray) -> Eigensystem:
        """Return the eigensystems of (m, n, n) matrices; a defective matrix is first changed by rounding errors."""
        values, right = np.linalg.eig(A)
        try:
            left = np.linalg.inv(right)
        except np.linalg.LinAlgError:
            n = A.shape[-1]
            nudge = 1e-13 * np.linalg.norm(A, axis=(1, 2), keepdims=True) * np.random.default_rng(0).normal(size=(n, n))
            values, right = np.linalg.eig(A + nudge)
            left = np.linalg.inv(right)
        return cls(values.astype(complex), right.astype(complex), left.astype(complex))

    def slopes(self, loops: npt.NDArray[np.intp], which: npt.NDArray[np.intp], dA: FloatArray) -> ComplexArray:
        """Return derivatives (k, d) of chosen eigenvalues: ``w dA v`` with ``w v = 1``; dA is (m, d, n, n)."""
        return bilinear(self.left[loops, which], dA[loops], self.right[loops, :, which])


def damping_slopes(rates: ComplexArray, slopes: ComplexArray, sample_time: float | None = None) -> FloatArray:
    """Return derivatives (k, d) of the damping factor from those of the eigenvalues in continuous time."""
    magnitude = np.abs(rates)[:, None]
    along = (rates.conj()[:, None] * slopes).real
    found = -slopes.real / magnitude + rates.real[:, None] * along / magnitude**3
    if sample_time is None:
        return np.asarray(found)
    short = brevity(rates, sample_time)[:, None]
    fading = np.where((short > 0) & (short < 1), -slopes.real * sample_time / FADE, 0.0)
    return np.asarray((1 - short) * found + (1 - damping_factors(rates)[:, None]) * fading)


@dataclass(frozen=True)
class Pair:
    """Two eigenvalues a, b that nearly meet: their mean and ``((a - b)/2)^2``, which are smooth where they meet."""

    mean: complex
    mean_slope: ComplexArray
    gap: complex
    gap_slope: ComplexArray


def pair_of(system: Eigensystem, dA: FloatArray, loop: int, first: int, second: int) -> Pair | None:
    """Return mean and squared half distance of two eigenvalues with their derivatives.

    The two span the invariant subspace ``A Q = Q M``, with left basis ``L Q = I``. Both derivatives follow from
    ``dM = L dA Q``: the trace of M is twice the mean, and ``gap = ((M_11 - M_22)/2)^2 + M_12 M_21``.

    Parameters
    ----------
    system : Eigensystem
        Eigenvalues and eigenvectors.
    dA : (d, n, n) array
        Derivatives of the matrix of the loop.
    loop, first, second : int
        Indices of the loop and of the two eigenvalues.

    Returns
    -------
    Pair, or None when the subspace is not determined up to rounding.
    """
    which, n = [first, second], system.values.shape[1]
    right = np.linalg.qr(system.right[loop][:, which])[0]
    left = np.linalg.qr(system.left[loop][which].T)[0].T
    overlap = left @ right
    if n < 2 or np.linalg.cond(overlap) > 1e10:
        return None
    L = np.linalg.solve(overlap, left)
    # A Q = V diag(values) (V^-1 Q), which needs no A
    M = L @ (system.right[loop] * system.values[loop]) @ (system.left[loop] @ right)
    dM = L @ dA @ right
    half, d_half = (M[0, 0] - M[1, 1]) / 2, (dM[:, 0, 0] - dM[:, 1, 1]) / 2
    return Pair(
        complex(np.trace(M) / 2),
        np.trace(dM, axis1=1, axis2=2) / 2,
        complex(half**2 + M[0, 1] * M[1, 0]),
        2 * half * d_half + dM[:, 0, 1] * M[1, 0] + M[0, 1] * dM[:, 1, 0],
    )
