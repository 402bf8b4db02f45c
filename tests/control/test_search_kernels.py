"""Compiled kernels of the search against numpy, and a search without a compiler."""

from __future__ import annotations

import numpy as np
import pytest

from gbid.control.tuning.search.kernels.compiled import kernels
from gbid.control.tuning.search.kernels.nearby_eigenvalues import NearbyEigenvalues
from gbid.control.tuning.search.loop_family import Derivatives
from gbid.control.tuning.search.peaks import find_peaks, peak_slopes
from gbid.control.tuning.search.spectrum import Eigensystem

_WITH_KERNELS = (
    "gbid.control.tuning.search.peaks.kernels",
    "gbid.control.tuning.search.kernels.nearby_eigenvalues.kernels",
)


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
    parallel: float, rows: slice, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert kernels() is not None
    given = loops(parallel)
    modes = Eigensystem.of(given.A)
    extra = np.array([1, 4]), np.array([33.0, 71.0])
    fast = find_peaks(given, modes, rows, extra, least=0.1)
    fast_slopes, fast_values = peak_slopes(given, rows, fast)
    for name in _WITH_KERNELS:
        monkeypatch.setattr(name, lambda: None)
    plain = find_peaks(given, modes, rows, extra, least=0.1)
    plain_slopes, plain_values = peak_slopes(given, rows, fast)
    assert len(plain.loop) > 5
    np.testing.assert_array_equal(fast.loop, plain.loop)
    np.testing.assert_allclose(fast.value, plain.value, rtol=1e-8)
    np.testing.assert_allclose(fast.frequency, plain.frequency, rtol=1e-3)
    np.testing.assert_allclose(fast_values, plain_values, rtol=1e-10)
    np.testing.assert_allclose(fast_slopes, plain_slopes, rtol=1e-8, atol=1e-10 * np.abs(plain_slopes).max())


def test_eigenvalues_of_nearby_loops_are_followed(monkeypatch: pytest.MonkeyPatch) -> None:
    there = loops(0.3)
    move = 1e-3 * there.dA[:, 0]
    both = Derivatives.joined([there, Derivatives(there.A + move, *list(vars(there).values())[1:])])
    system = Eigensystem.of(both.A)
    places = np.array([system.values[i, 3] for i in range(6)])
    which = np.arange(6)[:, None] + np.array([0, 6])
    values, slopes = NearbyEigenvalues(both, 6).slopes(which, places)
    monkeypatch.setattr(_WITH_KERNELS[1], lambda: None)
    plain_values, plain_slopes = NearbyEigenvalues(both, 6).slopes(which, places)
    np.testing.assert_allclose(values, plain_values, rtol=1e-10)
    np.testing.assert_allclose(slopes, plain_slopes, rtol=1e-8, atol=1e-9)
