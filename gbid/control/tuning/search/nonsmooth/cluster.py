"""Clusters of eigenvalues that are about to meet, by functions of the gains that are smooth where they meet."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg.lapack import dgebal, zgees, ztrsen, ztrsyl

from gbid.arrays import ComplexArray, FloatArray
from gbid.control.tuning.search.spectrum import LARGEST

_FARTHEST = 1e8
"""Angle between a subspace and the others, as a cotangent, from which on it is not determined."""


@dataclass(frozen=True)
class Cluster:
    """Cluster of k eigenvalues of one loop: mean, and power sums of their distances from it, with derivatives.

    Attributes
    ----------
    size : int
        Number k of eigenvalues.
    values : (k,) array
        The eigenvalues.
    mean : complex
        Their mean.
    mean_slope : (d,) array
        Its derivatives.
    powers : (k - 1,) array
        Power sums ``sum_i ((lambda_i - mean) / rate)^j / k`` for j = 2 ... k; all are zero where the k meet.
    powers_slope : (k - 1, d) array
        Their derivatives.
    """

    size: int
    values: ComplexArray
    mean: complex
    mean_slope: ComplexArray
    powers: ComplexArray
    powers_slope: ComplexArray

    @property
    def radius(self) -> float:
        """Largest distance of an eigenvalue from the mean, with room for rounding."""
        return float(np.abs(self.values - self.mean).max()) * 1.01 + 1e-6 * abs(self.mean)

    @property
    def real(self) -> bool:
        """Whether mean and power sums are real, because the cluster holds the conjugate of each of its eigenvalues."""
        return abs(self.mean.imag) <= 1e-9 * abs(self.mean)


class InvariantSubspaces:
    """Invariant subspaces of the matrix of a loop, from one Schur form of the balanced matrix.

    Parameters
    ----------
    A : (n, n) array
        Matrix of the loop.
    dA : (d, n, n) array
        Its derivatives by the gains.
    """

    def __init__(self, A: FloatArray, dA: FloatArray) -> None:
        self.dA = dA
        self.usable = bool(np.isfinite(A).all() and np.isfinite(dA).all() and np.abs(A).max() < LARGEST)
        if self.usable:
            balanced, _, _, self._units, _ = dgebal(A, scale=1)
            self._form, _, _, self._basis, _, failed = zgees(lambda _: None, balanced)
            self.usable = failed == 0

    @property
    def values(self) -> ComplexArray:
        """Eigenvalues of the matrix (n,); NaN where it is not usable."""
        return np.diag(self._form) if self.usable else np.full(self.dA.shape[-1], np.nan, complex)

    def cluster(self, centre: complex, size: int, rate: float) -> Cluster | None:
        """Return the cluster of the eigenvalues nearest to a place in the complex plane.

        They span the invariant subspace ``A Q = Q M``, which is accurate where eigenvectors are not. With the left
        basis ``L Q = I`` the derivative is ``dM = L dA Q``, and with ``N = M - mean I`` those of the power sums are
        ``d tr N^j = j tr(N^(j-1) dN)``.

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
        if not self.usable or size > len(self._form):
            return None
        form, basis, n = self._form, self._basis, len(self._form)
        left = basis.conj().T
        if size < n:
            distance = np.abs(np.diag(form) - centre)
            order = np.argsort(distance, kind="stable")
            if distance[order[size]] <= distance[order[size - 1]] * (1 + 1e-9):
                return None
            chosen = np.zeros(n, np.int32)
            chosen[order[:size]] = 1
            form, basis, _, inside, *_, failed = ztrsen(chosen, form, basis, job=b"N")
            if failed or inside != size:
                return None
            X, scale, failed = ztrsyl(form[:size, :size], form[size:, size:], form[:size, size:], isgn=-1)
            if failed < 0 or not np.abs(X).max() < _FARTHEST * scale:
                return None
            left = basis.conj().T
            left = left[:size] + (X / scale) @ left[size:]
        right = self._units[:, None] * basis[:, :size]
        return _cluster(form[:size, :size], left / self._units, right, self.dA, rate)


def power_sums(values: ComplexArray, rate: float) -> tuple[complex, ComplexArray]:
    """Return mean and power sums of eigenvalues, see `Cluster`; both hardly change by the rounding of each of them."""
    size = len(values)
    mean = complex(values.sum() / size)
    distances = (values - mean) / rate
    return mean, np.array([(distances**j).sum() / size for j in range(2, size + 1)])


def _cluster(M: ComplexArray, left: ComplexArray, right: ComplexArray, dA: FloatArray, rate: float) -> Cluster:
    """Return the cluster of all eigenvalues of an upper triangular matrix ``M = left A right``."""
    size, d = len(M), len(dA)
    mean = complex(np.trace(M) / size)
    N = (M - mean * np.eye(size)) / rate
    # trace of N^(j-1) left dA right as a product of right N^(j-1) left with dA, for all j at once
    weights, traces, turned = [right @ left], [complex(size)], right
    for _ in range(1, size):
        turned = turned @ N
        weights.append(turned @ left)
    powers = np.empty(size - 1, complex)
    power = N
    for j in range(2, size + 1):
        traces.append(complex(np.trace(power)))
        power = power @ N
        powers[j - 2] = np.trace(power) / size
    flat = np.array(weights).transpose(0, 2, 1).reshape(size, -1)
    products = np.vstack([flat.real, flat.imag]) @ dA.reshape(d, -1).T
    inner = products[:size] + 1j * products[size:]
    mean_slope = inner[0] / size
    factors = np.arange(2, size + 1)[:, None] / (size * rate)
    slopes = factors * (inner[1:] - np.array(traces[1:])[:, None] * mean_slope)
    return Cluster(size, np.diag(M).copy(), mean, mean_slope, powers, slopes)
