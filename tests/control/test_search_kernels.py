"""Peaks in C against numpy; eigensystems and clusters of matrices in bad units or with triple eigenvalues."""

from __future__ import annotations

import numpy as np
import pytest

from gbid.control.tuning import peaks
from gbid.control.tuning.loops import Derivatives
from gbid.control.tuning.plane import Eigensystem, InvariantSubspaces, power_sums


def loops(parallel: float) -> Derivatives:
    """Six loops of nine states with two inputs and four outputs; two lags of each have nearly parallel eigenvectors."""
    rng, m, n, d = np.random.default_rng(1), 6, 9, 3
    A = 40.0 * rng.standard_normal((m, n, n))
    A -= (np.linalg.eigvals(A).real.max(axis=1) + 5.0)[:, None, None] * np.eye(n)
    A[:, :2], A[:, 0, 0], A[:, 1, 1], A[:, 0, 1] = 0.0, -30.0, -30.0 * (1 + parallel), 20.0
    B, C, D = rng.standard_normal((m, n, 2)), rng.standard_normal((m, 4, n)), 0.1 * rng.standard_normal((m, 4, 2))
    slopes = [rng.standard_normal((m, d, *M.shape[1:])) for M in (A, B, C, D)]
    return Derivatives(A, B, C, D, *slopes)


@pytest.mark.parametrize("parallel", [0.3, 1e-9])
@pytest.mark.parametrize("rows", [slice(0, 2), slice(2, None)])
def test_compiled_peaks_are_those_of_numpy(parallel: float, rows: slice, monkeypatch: pytest.MonkeyPatch) -> None:
    assert peaks.kernel() is not None
    given = loops(parallel)
    modes = Eigensystem.of(given.A)
    extra = np.array([1, 4]), np.array([33.0, 71.0])
    fast = peaks.find_peaks(given, modes, rows, extra, least=0.1)
    monkeypatch.setattr(peaks, "kernel", lambda: None)
    plain = peaks.find_peaks(given, modes, rows, extra, least=0.1)
    assert len(plain.loop) > 5
    np.testing.assert_array_equal(fast.loop, plain.loop)
    np.testing.assert_allclose(fast.value, plain.value, rtol=1e-8)
    np.testing.assert_allclose(fast.frequency, plain.frequency, rtol=1e-3)
    np.testing.assert_allclose(peaks.peak_slopes(given, rows, plain)[1], plain.value, rtol=1e-7)


def matrices() -> list[np.ndarray]:
    """Matrices of 2 to 24 states: random ones, triangular ones, ones in bad units, and ones with triple eigenvalues."""
    rng, found = np.random.default_rng(3), []
    for n in range(2, 25):
        A = 30.0 * rng.standard_normal((n, n))
        units = 2.0 ** rng.integers(-15, 15, n)
        Q = np.linalg.qr(A)[0]
        triple = np.diag(-np.arange(1.0, n + 1)) + np.diag([1.0, 1.0, *[0.0] * n][: n - 1], 1)
        triple[[0, 1, 2][:n], [0, 1, 2][:n]] = -0.5
        found += [A, np.triu(A), A * units / units[:, None], Q @ triple @ Q.T]
    return found


def test_eigensystems_have_small_residuals() -> None:
    for A in matrices():
        one = Eigensystem.of(A[None])
        size, longest = np.abs(A).max(), np.abs(one.left).max()
        assert np.abs(A @ one.right - one.right * one.values[:, None]).max() < 1e-13 * size
        assert np.abs(one.left @ A - one.values[:, :, None] * one.left).max() < 1e-11 * size * longest
        assert np.abs((one.left * one.right.transpose(0, 2, 1)).sum(axis=2) - 1).max() < 1e-13 * longest


def test_clusters_hold_the_nearest_eigenvalues() -> None:
    rng, compared = np.random.default_rng(4), 0
    for A in matrices():
        values = np.linalg.eigvals(A)
        place, size = values[rng.integers(len(A))], int(rng.integers(2, min(len(A), 5) + 1))
        rate = max(abs(place), 1e-3)
        cluster = InvariantSubspaces(A, rng.standard_normal((3, *A.shape))).cluster(place, size, rate)
        if cluster is None:
            continue
        compared += 1
        mean, powers = power_sums(values[np.argsort(np.abs(values - place))[:size]], rate)
        np.testing.assert_allclose(cluster.mean, mean, rtol=1e-10)
        np.testing.assert_allclose(cluster.powers, powers, rtol=1e-8, atol=1e-11)
    assert compared > 40
