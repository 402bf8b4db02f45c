"""Eigenvalues of loops and their derivatives by the gains: rates, damping, eigenvectors, clusters.

The loops of a sampled design are given by their bilinear transform, so that their stable region is the left half-plane.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import scipy

from gbid.control.tuning.kernels import (
    compiled_cluster,
    compiled_eigensystems,
    compiled_eigenvalues,
    compiled_schur_form,
    kernels,
)
from gbid.control.tuning.loops import Derivatives
from gbid.core.arrays import REAL, BoolArray, ComplexArray, FloatArray, IntArray

_FASTEST = 40.0
"""Largest decay of a mode in one sample, as an exponent; a dead-beat mode (z = 0) is given this rate."""
FADE = 0.25
"""Width of the fading in `fast_mode_weight`, in units of the decay rate times the sample time."""


def true_rates(values: ComplexArray, sample_time: float | None) -> ComplexArray:
    r"""Return the continuous-time rates of eigenvalues [rad/s], of any shape.

    A sampled loop with eigenvalues z is searched in the plane of :math:`w = (2 / T) (z - 1) / (z + 1)`, in which the
    stable region is the left half-plane and all gains over frequency are the same. The rate of a mode is
    :math:`\lambda = \log(z) / T = (2 / T) \operatorname{artanh}(w T / 2)`.

    Parameters
    ----------
    values : complex array
        Eigenvalues in the plane of the search.
    sample_time : float or None
        T [s]; None for a continuous loop, whose eigenvalues are its rates.
    """
    if sample_time is None:
        return values
    z = _z(values, sample_time)
    size = np.maximum(np.abs(z), np.exp(-_FASTEST))
    return np.asarray((np.log(size) + 1j * np.angle(z)) / sample_time)


def rate_slopes(values: ComplexArray, sample_time: float | None) -> ComplexArray:
    """Return the derivative of `true_rates` by the eigenvalue in the plane of the search, shape of the input."""
    if sample_time is None:
        return np.ones_like(values)
    half = values * sample_time / 2
    return np.asarray(1.0 / np.where(np.abs(1 - half**2) > 1e-12, 1 - half**2, 1e-12))


def true_frequencies(frequency: FloatArray, sample_time: float | None) -> FloatArray:
    """Return true angular frequencies [rad/s] of angular frequencies in the plane of the search."""
    if sample_time is None:
        return frequency
    return np.asarray(2 / sample_time * np.arctan(frequency * sample_time / 2))


def searched_frequencies(frequency: FloatArray, sample_time: float | None) -> FloatArray:
    """Return angular frequencies [rad/s] mapped to the plane of the search; the inverse of `true_frequencies`."""
    if sample_time is None:
        return frequency
    return np.asarray(2 / sample_time * np.tan(frequency * sample_time / 2))


def fast_mode_weight(rates: ComplexArray, sample_time: float | None) -> FloatArray:
    """Weight of fast modes: 0 for modes that last longer than a sample, rising to 1 below 0.8 of a sample.

    Modes that last shorter than a sample do not count in `gbid.control.smallest_damping`, because they do not oscillate
    visibly. The objective of a search must be continuous, so they fade out.
    """
    if sample_time is None:
        return np.zeros(rates.shape)
    return np.clip((-rates.real * sample_time - 1.0) / FADE, 0.0, 1.0)


def _z(values: ComplexArray, sample_time: float) -> ComplexArray:
    half = values * sample_time / 2
    below = 1 - half
    return np.asarray((1 + half) / np.where(np.abs(below) > 1e-300, below, 1e-300))


# ---- Eigenvalues of many loops, their damping, and the derivatives of both by the gains.
#
# Matrices may hold numbers that are not finite, or so large that their eigenvalues are not computed. Their eigenvalues
# are NaN, so that a search steps back from such gains.

LARGEST = 1e60
"""Entries of a matrix from which on it counts as not finite: powers of its eigenvalues would overflow."""
_DEFECTIVE = 1e13
"""Entry of a left eigenvector, with right ones of length one, from which on a matrix counts as defective."""
_LONGEST = 1e18
"""Largest length of a left eigenvector of a defective matrix, with right ones of length one."""


def damping_factors(rates: ComplexArray, sample_time: float | None = None) -> FloatArray:
    """Return the damping factors ``-Re/|.|`` of oscillatory modes; 1 for real poles.

    Parameters
    ----------
    rates : complex array
        Eigenvalues in continuous time [rad/s].
    sample_time : float, optional
        Sample time of a sampled loop [s], in which modes shorter than a sample fade out, see `fast_mode_weight`.
    """
    magnitude = np.maximum(np.abs(rates), 1e-300)
    factors = np.where(np.abs(rates.imag) > REAL * magnitude, -rates.real / magnitude, 1.0)
    if sample_time is None:
        return factors
    return np.asarray(factors + (1.0 - factors) * fast_mode_weight(rates, sample_time))


def damping_slopes(rates: ComplexArray, slopes: ComplexArray, sample_time: float | None = None) -> FloatArray:
    """Return the derivatives (k, d) of damping factors from derivatives of continuous-time eigenvalues."""
    magnitude = np.abs(rates)[:, None]
    along = (rates.conj()[:, None] * slopes).real
    by_gains = -slopes.real / magnitude + rates.real[:, None] * along / magnitude**3
    if sample_time is None:
        return np.asarray(by_gains)
    short = fast_mode_weight(rates, sample_time)[:, None]
    fading = np.where((short > 0) & (short < 1), -slopes.real * sample_time / FADE, 0.0)
    return np.asarray((1 - short) * by_gains + (1 - damping_factors(rates)[:, None]) * fading)


def _decomposed(decompose: Callable[[FloatArray], Any], A: FloatArray) -> tuple[Any, BoolArray]:
    """Return eigendecompositions for the decomposable matrices among (m, n, n), and the mask of these matrices (m,)."""
    usable = np.asarray((np.abs(A) < LARGEST).all(axis=(1, 2)))  # a comparison with NaN is false
    try:
        return decompose(A if usable.all() else A[usable]), usable
    except np.linalg.LinAlgError:
        for i in np.flatnonzero(usable):
            try:
                decompose(A[i])
            except np.linalg.LinAlgError:
                usable[i] = False
        return decompose(A[usable]), usable


def _with_gaps(parts: npt.NDArray[Any], usable: BoolArray) -> ComplexArray:
    """Return an array for all matrices: values of the decomposable matrices, NaN for all others."""
    if usable.all():
        return parts.astype(complex, copy=False)
    every = np.full((len(usable), *parts.shape[1:]), np.nan, complex)
    every[usable] = parts
    return every


def eigenvalues(A: FloatArray) -> ComplexArray:
    """Return the eigenvalues (m, n) of (m, n, n) matrices; NaN if they are not finite."""
    if (library := kernels()) is not None and (values := compiled_eigenvalues(library, A)) is not None:
        return values
    return _with_gaps(*_decomposed(np.linalg.eigvals, A))


@dataclass(frozen=True, eq=False)
class Eigensystem:
    """Eigenvalues (m, n) and eigenvectors of matrices; NaN if they are not finite.

    The eigenvalues of a defective matrix stay as they are: a change of the matrix by rounding errors would move k
    eigenvalues that coalesce by the k-th root of these.

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
        if (library := kernels()) is not None and (parts := compiled_eigensystems(library, A, _LONGEST)) is not None:
            return cls(A, *parts)
        (values, right), usable = _decomposed(np.linalg.eig, A)
        return cls(A, _with_gaps(values, usable), _with_gaps(right, usable))

    @cached_property
    def left(self) -> ComplexArray:
        """Left eigenvectors as rows, with ``W V = I``.

        A defective matrix has no complete set of eigenvectors. Its left ones are those that LAPACK finds by themselves,
        and are divided by the smallest number instead of zero.
        """
        if self.known_left is not None:
            return self.known_left
        try:
            left = np.asarray(np.linalg.inv(self.right))
        except np.linalg.LinAlgError:
            left = np.full(self.right.shape, np.inf, complex)
        defective = ~(np.abs(left).max(axis=(1, 2)) < _DEFECTIVE) & ~np.isnan(self.values[:, 0])
        for i in np.flatnonzero(defective):
            rows = scipy.linalg.eig(self.A[i], left=True, right=False, check_finite=False)[1].conj().T
            products = (rows * self.right[i].T).sum(axis=1, keepdims=True)
            left[i] = rows / np.where(np.abs(products) > 1.0 / _LONGEST, products, 1.0 / _LONGEST)
        return left

    def slopes(self, loops: IntArray, which: IntArray, derivatives: Derivatives) -> ComplexArray:
        """Return derivatives (k, d) of chosen eigenvalues: ``w dA v`` with left and right eigenvectors, ``w v = 1``."""
        return derivatives.along(loops, self.left[loops, which], self.right[loops, :, which])

    @np.errstate(divide="ignore", invalid="ignore")  # equal eigenvalues have no second derivatives
    def curvature(
        self, loops: IntArray, which: IntArray, derivatives: Derivatives, bend: FloatArray
    ) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
        """Return chosen eigenvalues with first (k, d) and second (k, d, d) derivatives; see `Derivatives.second`."""
        values, row = self.values[loops], np.arange(len(loops))
        gaps = values[row, which][:, None] - values
        gaps[row, which] = np.inf
        resolvent = (self.right[loops] / gaps[:, None]) @ self.left[loops]
        inner, outer = derivatives.factors(loops, self.left[loops, which], self.right[loops, :, which])
        by_row, _, second = derivatives.second(bend, loops, inner, outer, resolvent)
        return values[row, which], (by_row @ outer[:, :, None])[:, :, 0], second


# ---- Clusters of eigenvalues near coalescence, by functions of the gains that stay smooth at coalescence.

_FARTHEST = 1e8
"""Angle between a subspace and the others, as a cotangent, from which on it is not determined."""


@dataclass(frozen=True)
class Cluster:
    """Cluster of k eigenvalues of one loop: mean, power sums of the distances from the mean, and derivatives.

    Attributes
    ----------
    values : (k,) array
        The eigenvalues.
    mean : complex
        Their mean.
    mean_slope : (d,) array
        Its derivatives.
    powers : (k - 1,) array
        Power sums ``sum_i ((lambda_i - mean) / rate)^j / k`` for j = 2 ... k; all are zero where the k coalesce.
    powers_slope : (k - 1, d) array
        Their derivatives.
    """

    values: ComplexArray
    mean: complex
    mean_slope: ComplexArray
    powers: ComplexArray
    powers_slope: ComplexArray

    @property
    def real(self) -> bool:
        """Whether mean and power sums are real, because the cluster holds the conjugate of each of its eigenvalues."""
        return abs(self.mean.imag) <= 1e-9 * abs(self.mean)


def power_sums(values: ComplexArray, rate: float) -> tuple[complex, ComplexArray]:
    """Return mean and power sums of eigenvalues, see `Cluster`; rounding of single eigenvalues hardly changes them."""
    size = len(values)
    mean = complex(values.sum() / size)
    powers = np.multiply.accumulate(np.broadcast_to((values - mean) / rate, (size, size)))
    return mean, powers[1:].sum(axis=1) / size


class SchurForm(NamedTuple):
    """Complex Schur form of a matrix in balanced units of its states: ``A / unit[:, None] * unit = basis form basis*``.

    Attributes
    ----------
    form, basis : (n, n) arrays
        Upper triangular matrix, and unitary one.
    unit : (n,) array
        Units of the states.
    packed : array, optional
        All three as the kernels have them.
    """

    form: ComplexArray
    basis: ComplexArray
    unit: FloatArray
    packed: ComplexArray | None = None


def schur_form(A: FloatArray) -> SchurForm | None:
    """Return the Schur form of a finite matrix (n, n); None if the QR iteration fails."""
    if (library := kernels()) is not None and (packed := compiled_schur_form(library, A)) is not None:
        n = len(A)
        form, rows = packed[: 2 * n * n].reshape(2, n, n)
        return SchurForm(form, rows.T, packed[2 * n * n :].view(float)[:n], packed)
    balanced, _, _, unit, _ = scipy.linalg.lapack.dgebal(A, scale=1)
    form, _, _, basis, _, failed = scipy.linalg.lapack.zgees(lambda _: None, balanced)
    return None if failed else SchurForm(form, basis, unit)


class InvariantSubspaces:
    """Invariant subspaces of the matrix of a loop, from one Schur form.

    Parameters
    ----------
    loops : Derivatives
        Matrices of loops and their derivatives by the gains.
    i : int
        The loop.
    """

    def __init__(self, loops: Derivatives, i: int) -> None:
        n = loops.A.shape[-1]
        self._slopes = loops.left[i, :n], loops.core[i], loops.right[i, :, :n]
        usable = np.abs(loops.A[i]).max() < LARGEST and all(np.isfinite(part).all() for part in self._slopes)
        self._schur = schur_form(loops.A[i]) if usable else None  # a comparison with NaN is false

    def cluster(self, centre: complex, size: int, rate: float) -> Cluster | None:
        """Return the cluster of eigenvalues nearest to a point of the complex plane.

        The eigenvalues belong to the invariant subspace ``A Q = Q M``, which is accurate where eigenvectors are not.
        With the left basis ``L Q = I`` the derivative is ``dM = L dA Q``, and with ``N = M - mean I`` those of the
        power sums are ``d tr N^j = j tr(N^(j-1) dN)``.

        Parameters
        ----------
        centre : complex
            Place in the complex plane.
        size : int
            Number of eigenvalues.
        rate : float
            Unit of distances [rad/s].

        Returns
        -------
        Cluster, or None when the subspace is not determined up to rounding.
        """
        if self._schur is None or size > len(self._schur.unit):
            return None
        form, basis, unit, packed = self._schur
        if packed is not None and (library := kernels()) is not None:
            parts = compiled_cluster(library, packed, self._slopes, size, centre, rate, _FARTHEST)
            return None if parts is None else Cluster(parts[0], complex(parts[1][0]), *parts[2:])
        n = len(unit)
        left = basis.conj().T
        if size < n:
            distance = np.abs(form.diagonal() - centre)
            order = np.argsort(distance, kind="stable")
            if distance[order[size]] <= distance[order[size - 1]] * (1 + 1e-9):
                return None
            chosen = np.zeros(n, np.int32)
            chosen[order[:size]] = 1
            form, basis, _, inside, *_, failed = scipy.linalg.lapack.ztrsen(chosen, form, basis, job=b"N")
            if failed or inside != size:
                return None
            inside, outside, between = form[:size, :size], form[size:, size:], form[:size, size:]
            X, scale, failed = scipy.linalg.lapack.ztrsyl(inside, outside, between, isgn=-1)
            if failed < 0 or not np.abs(X).max() < _FARTHEST * scale:
                return None
            left = basis.conj().T
            left = left[:size] + (X / scale) @ left[size:]
        L, core, R = self._slopes
        return _cluster(form[:size, :size], left / unit @ L, R @ (unit[:, None] * basis[:, :size]), core, rate)


def _cluster(M: ComplexArray, left: ComplexArray, right: ComplexArray, core: FloatArray, rate: float) -> Cluster:
    """Return the cluster of all eigenvalues of an upper triangular matrix with derivatives ``left core right``."""
    size, d = len(M), len(core)
    values = M.diagonal().copy()
    mean = complex(values.sum() / size)
    N = M / rate
    N[range(size), range(size)] = (values - mean) / rate
    # trace of N^(j-1) left core right as a product of right N^(j-1) left with core, for all j at once
    powers = [np.eye(size, dtype=complex)]
    for _ in range(size):
        powers.append(powers[-1] @ N)
    traces = np.array([power.trace() for power in powers], complex)
    flat = (right @ np.array(powers[:-1]) @ left).transpose(0, 2, 1).reshape(size, -1)
    products = np.vstack([flat.real, flat.imag]) @ core.reshape(d, -1).T
    inner = products[:size] + 1j * products[size:]
    mean_slope = inner[0] / size
    factors = np.arange(2, size + 1)[:, None] / (size * rate)
    slopes = np.asarray(factors * (inner[1:] - traces[1:-1, None] * mean_slope), complex)
    return Cluster(values, mean, mean_slope, np.asarray(traces[2:] / size, complex), slopes)
