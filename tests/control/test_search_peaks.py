"""Peaks of the search: responses of nearly defective loops, and refined heights, against direct solutions."""

from __future__ import annotations

import numpy as np
import pytest

from gbid.control.tuning.loops import Loops
from gbid.control.tuning.peaks import ModalResponse, find_peaks
from gbid.control.tuning.plane import Eigensystem

BOTH = slice(None)


def chain(gap: float, n: int = 5) -> Loops:
    """Cascade of lags whose poles are nearly equal, with a resonance beside it, in units of different size."""
    A = np.diag(-200.0 * (1 + gap * np.arange(n + 2))) + np.diag(np.full(n + 1, 150.0), -1)
    A[n:, n:] = [[0.0, 1.0], [-9e4, -30.0]]
    units = np.logspace(-0.5, 0.5, n + 2)
    B, C = np.zeros((n + 2, 1)), np.zeros((1, n + 2))
    B[0], B[n + 1], C[0, n - 1], C[0, n] = 100.0, 4e4, 1.0, 1.0
    return Loops((A * units[:, None] / units)[None], (B * units[:, None])[None], (C / units)[None], np.ones((1, 1, 1)))


def directly(loops: Loops, w: np.ndarray) -> np.ndarray:
    n = loops.A.shape[-1]
    return loops.C[0] @ np.linalg.solve(1j * w[:, None, None] * np.eye(n) - loops.A[0], loops.B[0]) + loops.D[0]


@pytest.mark.parametrize("gap", [0.1, 1e-2, 3e-3])
def test_response_of_nearly_equal_poles_is_that_of_a_direct_solution(gap: float) -> None:
    loops, w = chain(gap), np.geomspace(1.0, 1e5, 60)
    found = ModalResponse(loops, Eigensystem.of(loops.A), BOTH)(np.stack([w, 2 * w]), np.zeros(2, int))
    np.testing.assert_allclose(found[0], directly(loops, w), rtol=1e-6)
    np.testing.assert_allclose(found[1], directly(loops, 2 * w), rtol=1e-6)


@pytest.mark.parametrize("gap", [0.1, 3e-3])
def test_height_of_a_peak_is_that_of_a_very_fine_grid(gap: float) -> None:
    loops = chain(gap)
    peaks = find_peaks(loops, Eigensystem.of(loops.A), BOTH)
    fine = np.abs(directly(loops, np.linspace(150.0, 450.0, 200_001)))[:, 0, 0].max()
    assert peaks.value.max() == pytest.approx(fine, rel=1e-7)
    assert len(find_peaks(loops, Eigensystem.of(loops.A), BOTH, least=1.01 * fine).loop) == 1
    assert len(find_peaks(loops, Eigensystem.of(loops.A), BOTH, least=1.5 * fine).loop) == 0
