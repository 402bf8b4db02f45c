"""Searches without compiled kernels; eigensystems of matrices in bad units or with triple eigenvalues."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

import gbid
from gbid.control.tuning.local import quadratic_programme
from gbid.control.tuning.plane import Eigensystem, eigenvalues
from tests.benchmarks.known_loops import integrators

_KERNELS = tuple(f"gbid.control.tuning.{name}" for name in ("plane.kernels", "peaks.kernels"))


@pytest.fixture
def without_kernels(monkeypatch: pytest.MonkeyPatch) -> Callable[[], None]:
    """Return a function after whose call numpy takes the place of the kernels."""

    def leave() -> None:
        for name in _KERNELS:
            monkeypatch.setattr(name, lambda: None)

    return leave


def matrices() -> list[np.ndarray]:
    """Matrices of 2 to 24 states: random ones, triangular ones, ones in bad units, and ones with triple eigenvalues."""
    rng, computed = np.random.default_rng(3), []
    for n in range(2, 25):
        A = 30.0 * rng.standard_normal((n, n))
        units = 2.0 ** rng.integers(-15, 15, n)
        Q = np.linalg.qr(A)[0]
        triple = np.diag(-np.arange(1.0, n + 1)) + np.diag([1.0, 1.0, *[0.0] * n][: n - 1], 1)
        triple[[0, 1, 2][:n], [0, 1, 2][:n]] = -0.5
        computed += [A, np.triu(A), A * units / units[:, None], Q @ triple @ Q.T]
    return computed


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


def test_a_design_without_kernels_is_the_same(without_kernels: Callable[[], None]) -> None:
    """Peaks, their gradients and clusters by numpy: a limit on a peak holds, and integrators meet at their mean."""

    def design() -> gbid.GainResult:
        return gbid.tune(gbid.load_model("theisen2016"), operating_points=[(6.0, 0.0)], starts=0)

    fast = design()
    without_kernels()
    plain = design()
    assert plain.status == fast.status
    assert plain.value == pytest.approx(fast.value, rel=1e-6)
    assert integrators(3).tune(starts=1).value == pytest.approx(1.0, rel=2e-3)


def test_threads_design_as_one_does() -> None:
    """Each thread has quadratic programmes of its own; with common arrays they crashed, or gave other gains."""
    model = gbid.load_model("theisen2016")

    def gains(bar: int) -> dict[str, float]:
        return dict(gbid.tune(model, operating_points=[(bar, 0)], peak_sensitivity=2.2).gains)

    bars = [3, 6]
    with ThreadPoolExecutor(len(bars)) as threads:
        assert list(threads.map(gains, bars)) == [gains(bar) for bar in bars]
    with ThreadPoolExecutor(1) as other:
        assert other.submit(quadratic_programme, 3, 2).result() is not quadratic_programme(3, 2)
