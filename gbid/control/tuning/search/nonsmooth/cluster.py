"""Clusters of eigenvalues that are about to meet, by functions of the gains that are smooth where they meet."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import accumulate

import numpy as np
from scipy.linalg.lapack import ztrsen, ztrsyl

from gbid.arrays import ComplexArray, FloatArray
from gbid.control.tuning.search.kernels.compiled import compiled_cluster, compiled_near_sums, kernels
from gbid.control.tuning.search.kernels.schur_form import SchurForm
from gbid.control.tuning.search.spectrum import LARGEST, eigenvalues

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
        usable = np.isfinite(dA).all() and np.abs(A).max() < LARGEST  # which NaN is not, either
        self._schur = SchurForm.of(A) if usable else None

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
        if self._schur is None or size > self._schur.n:
            return None
        if (library := kernels()) is not None:
            found = compiled_cluster(library, self._schur.packed, self.dA, size, centre, rate, _FARTHEST)
            if found is None:
                return None
            values, mean, powers, mean_slope, powers_slope = found
            return Cluster(size, values, complex(mean[0]), mean_slope, powers, powers_slope)
        form, basis, n = self._schur.form, self._schur.basis, self._schur.n
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
        right = self._schur.unit[:, None] * basis[:, :size]
        return _cluster(form[:size, :size], left / self._schur.unit, right, self.dA, rate)


def near_sums(A: FloatArray, places: FloatArray) -> tuple[ComplexArray, list[tuple[complex, ComplexArray]]]:
    """Return the eigenvalues of a matrix, and mean and power sums of those nearest to each of some places.

    Parameters
    ----------
    A : (n, n) array
        Matrix of a loop.
    places : (c, 4) array
        Real and imaginary part of each place, unit of distances [rad/s], and number of eigenvalues.
    """
    sizes = [int(k) for k in places[:, 3]]
    if (library := kernels()) is not None:
        values, sums = compiled_near_sums(library, A, places, sum(sizes))
        ends = list(accumulate(sizes))
        return values, [(complex(sums[end - k]), sums[end - k + 1 : end]) for k, end in zip(sizes, ends, strict=True)]
    values = eigenvalues(A[None])[0]
    orders = [np.argsort(np.abs(values - complex(x, y)), kind="stable") for x, y in places[:, :2]]
    return values, [power_sums(values[order[:k]], row[2]) for order, k, row in zip(orders, sizes, places, strict=True)]


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
