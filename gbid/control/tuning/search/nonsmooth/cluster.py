"""Clusters of eigenvalues that are about to meet, by functions of the gains that are smooth where they meet."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import schur, solve_sylvester

from gbid.arrays import ComplexArray, FloatArray


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


def cluster_of(A: FloatArray, dA: FloatArray, centre: complex, size: int, rate: float) -> Cluster | None:
    """Return the cluster of the eigenvalues nearest to a place in the complex plane.

    They span the invariant subspace ``A Q = Q M``, taken from an ordered Schur form, which is accurate where
    eigenvectors are not. With the left basis ``L Q = I`` the derivative is ``dM = L dA Q``, and with ``N = M - mean I``
    those of the power sums are ``d tr N^j = j tr(N^(j-1) dN)``.

    Parameters
    ----------
    A : (n, n) array
        Matrix of the loop.
    dA : (d, n, n) array
        Its derivatives by the gains.
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
    n = len(A)
    form, basis = schur(A.astype(complex), output="complex")
    distance = np.sort(np.abs(np.diag(form) - centre))
    edge = np.inf if size == n else (distance[size - 1] + distance[size]) / 2
    if size < n:
        if distance[size] <= distance[size - 1] * (1 + 1e-9):
            return None
        form, basis, inside = schur(
            A.astype(complex), output="complex", sort=lambda value: bool(abs(value - centre) < edge)
        )
        if inside != size:
            return None
    M, left = form[:size, :size], basis.conj().T[:size]
    if size < n:
        try:
            X = solve_sylvester(M, -form[size:, size:], form[:size, size:])
        except np.linalg.LinAlgError:
            return None
        if not np.abs(X).max() < 1e8:
            return None
        left = left + X @ basis.conj().T[size:]
    dM = left @ dA @ basis[:, :size]
    mean = complex(np.trace(M) / size)
    mean_slope = np.trace(dM, axis1=1, axis2=2) / size
    N = (M - mean * np.eye(size)) / rate
    dN = (dM - mean_slope[:, None, None] * np.eye(size)) / rate
    powers, slopes, power = [], [], np.eye(size, dtype=complex)
    for j in range(2, size + 1):
        power = power @ N
        powers.append(np.trace(power @ N) / size)
        slopes.append(j * np.einsum("ab,dba->d", power, dN) / size)
    return Cluster(size, np.diag(M).copy(), mean, mean_slope, np.array(powers), np.array(slopes))
