"""Eigenvalues of many loops, their damping, and the derivatives of both by the gains.

Matrices may hold numbers that are not finite, or so large that their eigenvalues are not computed. Their eigenvalues
are NaN, so that a search steps back from such gains.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy.linalg import eig

from gbid.arrays import BoolArray, ComplexArray, FloatArray
from gbid.control.tuning.search.kernels.compiled import compiled_eigensystems, kernels
from gbid.control.tuning.search.plane import FADE, brevity
from gbid.poles import REAL

LARGEST = 1e60
"""Entries of a matrix from which on it counts as not finite: powers of its eigenvalues would overflow."""
_DEFECTIVE = 1e13
"""Entry of a left eigenvector, with right ones of length one, from which on a matrix counts as defective."""
_LONGEST = 1e18
"""Largest length of a left eigenvector of a defective matrix, with right ones of length one."""


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


def eigenvalues(A: FloatArray) -> ComplexArray:
    """Return the eigenvalues (m, n) of (m, n, n) matrices, NaN for those without finite eigenvalues."""
    usable: BoolArray | None = None
    if np.abs(A).max(initial=0.0) < LARGEST:
        try:
            return np.asarray(np.linalg.eigvals(A), complex)
        except np.linalg.LinAlgError:
            usable = _one_by_one(A)
    usable = _usable(A) if usable is None else usable
    found = np.full(A.shape[:2], np.nan, complex)
    if usable.any():
        found[usable] = np.linalg.eigvals(A[usable])
    return found


def _usable(A: FloatArray) -> BoolArray:
    """Return which matrices have finite entries whose squares are finite, too."""
    # a comparison with NaN is false
    return np.asarray((np.abs(A) < LARGEST).all(axis=(1, 2)))


def _one_by_one(A: FloatArray) -> BoolArray:
    """Return for which matrices the eigenvalue iteration converges."""
    found = np.zeros(len(A), bool)
    for i, matrix in enumerate(A):
        try:
            np.linalg.eig(matrix)
            found[i] = _usable(matrix[None])[0]
        except np.linalg.LinAlgError:
            pass
    return found


def _inverses(right: ComplexArray) -> tuple[ComplexArray, BoolArray]:
    """Return the inverses of matrices of eigenvectors, and which of them are useless because a matrix is defective."""
    try:
        left = np.linalg.inv(right)
    except np.linalg.LinAlgError:
        left = np.full(right.shape, np.inf, complex)
        for i, matrix in enumerate(right):
            with suppress(np.linalg.LinAlgError):
                left[i] = np.linalg.inv(matrix)
    size = np.abs(left).max(axis=(1, 2))
    return np.asarray(left, complex), np.asarray(~(size < _DEFECTIVE))


def _left_of(A: FloatArray, right: ComplexArray) -> ComplexArray:
    """Return left eigenvectors as rows for right ones as columns, with ``W V = I``.

    A defective matrix has no complete set of eigenvectors. Its left ones are those that LAPACK finds by themselves,
    and are divided by the smallest number instead of zero.
    """
    left, defective = _inverses(right)
    for i in np.flatnonzero(defective):
        found = eig(A[i], left=True, right=False, check_finite=False)[1].conj().T
        products = (found * right[i].T).sum(axis=1, keepdims=True)
        left[i] = found / np.where(np.abs(products) > 1.0 / _LONGEST, products, 1.0 / _LONGEST)
    return left


@dataclass(frozen=True, eq=False)
class Eigensystem:
    """Eigenvalues (m, n) and eigenvectors of matrices, NaN for those without finite eigenvalues.

    The eigenvalues of a defective matrix stay as they are: a change of the matrix by rounding errors would move k
    eigenvalues that meet by the k-th root of these.

    Attributes
    ----------
    A : (m, n, n) array
        The matrices.
    values : (m, n) array
        Eigenvalues.
    right : (m, n, n) array
        Right eigenvectors as columns.
    known_left : (m, n, n) array, optional
        Left eigenvectors, where they were computed with the right ones.
    """

    A: FloatArray
    values: ComplexArray
    right: ComplexArray
    known_left: ComplexArray | None = None

    @classmethod
    def of(cls, A: FloatArray) -> Eigensystem:
        """Return the eigensystems of (m, n, n) matrices."""
        if np.abs(A).max(initial=0.0) < LARGEST:
            if (library := kernels()) is not None and (found := compiled_eigensystems(library, A, _LONGEST)):
                return cls(A, *found)
            try:
                values, right = np.linalg.eig(A)
                return cls(A, values.astype(complex, copy=False), right.astype(complex, copy=False))
            except np.linalg.LinAlgError:
                usable = _one_by_one(A)
        else:
            usable = _usable(A)
        values, right = np.full(A.shape[:2], np.nan, complex), np.full(A.shape, np.nan, complex)
        if usable.any():
            values[usable], right[usable] = np.linalg.eig(A[usable])
        return cls(A, values, right)

    @cached_property
    def left(self) -> ComplexArray:
        """Left eigenvectors as rows, with ``W V = I``."""
        if self.known_left is not None:
            return self.known_left
        usable = ~np.isnan(self.values[:, 0])
        if usable.all():
            return _left_of(self.A, self.right)
        found = np.full(self.right.shape, np.nan, complex)
        if usable.any():
            found[usable] = _left_of(self.A[usable], self.right[usable])
        return found

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
