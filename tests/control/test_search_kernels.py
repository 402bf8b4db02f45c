"""Compiled kernels of the search against numpy and LAPACK; matrices in bad units or with triple eigenvalues."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from gbid.control.tuning.kernels import kernels
from gbid.control.tuning.loops import Derivatives
from gbid.control.tuning.peaks import find_peaks, peak_slopes
from gbid.control.tuning.plane import Eigensystem, InvariantSubspaces, eigenvalues, power_sums

_KERNELS = tuple(f"gbid.control.tuning.{name}" for name in ("plane.kernels", "peaks.kernels"))


@pytest.fixture
def without_kernels(monkeypatch: pytest.MonkeyPatch) -> Callable[[], None]:
    """Return a function after whose call numpy takes the place of the kernels."""

    def leave() -> None:
        for name in _KERNELS:
            monkeypatch.setattr(name, lambda: None)

    return leave


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
def test_peaks_and_their_gradients_are_those_of_numpy(
    parallel: float, rows: slice, without_kernels: Callable[[], None]
) -> None:
    assert kernels() is not None
    given = loops(parallel)
    modes = Eigensystem.of(given.A)
    extra = np.array([1, 4]), np.array([33.0, 71.0])
    fast = find_peaks(given, modes, rows, extra, least=0.1)
    fast_slopes, fast_values = peak_slopes(given, rows, fast)
    without_kernels()
    plain = find_peaks(given, modes, rows, extra, least=0.1)
    plain_slopes, plain_values = peak_slopes(given, rows, fast)
    assert len(plain.loop) > 5
    np.testing.assert_array_equal(fast.loop, plain.loop)
    np.testing.assert_allclose(fast.value, plain.value, rtol=1e-8)
    np.testing.assert_allclose(fast.frequency, plain.frequency, rtol=1e-3)
    np.testing.assert_allclose(fast_values, plain_values, rtol=1e-10)
    np.testing.assert_allclose(fast_slopes, plain_slopes, rtol=1e-8, atol=1e-10 * np.abs(plain_slopes).max())


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


@pytest.mark.parametrize("compiled", [True, False])
def test_eigensystems_have_small_residuals(compiled: bool, without_kernels: Callable[[], None]) -> None:
    if not compiled:
        without_kernels()
    for A in matrices():
        one = Eigensystem.of(A[None])
        assert (one.known_left is not None) == compiled
        size, longest = np.abs(A).max(), np.abs(one.left).max()
        assert np.abs(A @ one.right - one.right * one.values[:, None]).max() < 1e-13 * size
        assert np.abs(one.left @ A - one.values[:, :, None] * one.left).max() < 1e-11 * size * longest
        assert np.abs((one.left * one.right.transpose(0, 2, 1)).sum(axis=2) - 1).max() < 1e-13 * longest
        if longest < 1e6:
            for values in (one.values, eigenvalues(A[None])):
                np.testing.assert_allclose(np.sort_complex(values[0]), np.sort_complex(np.linalg.eigvals(A)), rtol=1e-9)


@pytest.mark.parametrize("unfit", [np.nan, np.inf, 1e70])
def test_only_the_eigenvalues_of_a_matrix_that_is_not_finite_are_unknown(unfit: float) -> None:
    A = np.stack([np.diag(-np.arange(1.0, 7.0)), np.full((6, 6), unfit)])
    for values in (eigenvalues(A), Eigensystem.of(A).values):
        np.testing.assert_allclose(np.sort(values[0].real), -np.arange(6.0, 0.0, -1))
        assert np.isnan(values[1]).all()


def test_clusters_are_those_of_lapack_and_hold_the_nearest_eigenvalues(without_kernels: Callable[[], None]) -> None:
    rng, given = np.random.default_rng(4), []
    for A in matrices():
        values = np.linalg.eigvals(A)
        place, size = values[rng.integers(len(A))], int(rng.integers(2, min(len(A), 5) + 1))
        given.append((A, rng.standard_normal((3, *A.shape)), place, size, max(abs(place), 1e-3)))
    fast = [InvariantSubspaces(A, dA).cluster(place, size, rate) for A, dA, place, size, rate in given]
    without_kernels()
    compared = 0
    for (A, dA, place, size, rate), one in zip(given, fast, strict=True):
        plain = InvariantSubspaces(A, dA).cluster(place, size, rate)
        assert (plain is None) == (one is None)
        if plain is None or one is None:
            continue
        compared += 1
        for name in ("mean", "powers", "mean_slope", "powers_slope"):
            exact = np.atleast_1d(getattr(plain, name))
            np.testing.assert_allclose(getattr(one, name), exact, rtol=1e-7, atol=1e-9 * max(np.abs(exact).max(), 1e-3))
        values = np.linalg.eigvals(A)
        mean, powers = power_sums(values[np.argsort(np.abs(values - place))[:size]], rate)
        np.testing.assert_allclose(one.mean, mean, rtol=1e-10)
        np.testing.assert_allclose(one.powers, powers, rtol=1e-8, atol=1e-11)
    assert compared > 40
