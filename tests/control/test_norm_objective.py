"""An H-infinity norm as the objective: exact values, gradients and curvature, and optima of the literature."""

from __future__ import annotations

import numpy as np
import pytest

from gbid.control import GainStatus, peak_gain
from gbid.control.tuning import solve
from gbid.control.tuning.loops import Loops
from gbid.control.tuning.peaks import exact_peaks
from gbid.control.tuning.plane import Eigensystem
from gbid.control.tuning.problem import GainProblem
from gbid.control.tuning.search import GainSolution, SearchTask, search
from gbid.core.arrays import FloatArray
from tests.benchmarks.static_feedback import StaticLoop

NN17 = StaticLoop(
    A=np.array([[0.0, -1, 2], [1, -2, 3], [0, 1, 0]]),
    B1=np.array([[1.0], [-1], [0]]),
    B=np.array([[1.0, 0], [0, 0], [0, -1]]),
    C1=np.array([[1.0, 0, 1], [1, 0, 1]]),
    C=np.array([[1.0, 0, 0]]),
    D11=np.zeros((2, 1)),
    D12=np.array([[0.0, 1], [0, 0]]),
    D21=np.zeros((1, 1)),
)
"""Plant NN17 of COMPleib."""


def random_loop(seed: int, n: int, n_z: int, n_w: int) -> tuple[FloatArray, ...]:
    random = np.random.default_rng(seed)
    A = random.normal(size=(n, n))
    A -= (np.linalg.eigvals(A).real.max() + 10.0 ** random.uniform(-4, 0)) * np.eye(n)
    D = random.normal(size=(n_z, n_w)) * (seed % 3 == 0) * 3
    return A, random.normal(size=(n, n_w)), random.normal(size=(n_z, n)), D


@pytest.mark.parametrize("seed", range(9))
def test_peaks_are_those_of_a_dense_grid(seed: int) -> None:
    A, B, C, D = random_loop(seed, 2 + seed % 7, 1 + seed % 4, 1 + seed % 3)
    peaks = exact_peaks(Loops(*(M[None] for M in (A, B, C, D))), Eigensystem.of(A[None]))
    poles = np.linalg.eigvals(A)
    widths = np.abs(poles.real)[:, None] * np.linspace(-5, 5, 401)
    w = np.concatenate([[0.0, 1e9], np.geomspace(1e-4, 1e4, 1000), np.abs(poles.imag[:, None] + widths).ravel()])
    responses = C @ np.linalg.solve(1j * w[:, None, None] * np.eye(len(A)) - A, B[None]) + D
    grid = np.linalg.svd(responses, compute_uv=False).max()
    assert grid * (1 - 1e-9) <= peaks.value.max() <= grid * (1 + 1e-3)


def test_gradient_and_curvature_are_those_of_differences(monkeypatch: pytest.MonkeyPatch) -> None:
    problems: list[GainProblem] = []

    def kept(problem: GainProblem, task: SearchTask) -> GainSolution:
        problems.append(problem)
        return search(problem, task)

    monkeypatch.setattr(solve, "search", kept)
    NN17.tuned(evaluations=2)
    x, h = np.array([-0.3, 9.0]), 1e-4
    (problem,) = problems
    here = problem.functions(x)
    worst = min(here.aim, key=lambda piece: piece.value)
    differences = np.array([problem.functions(x + step).score.value for step in (*np.diag([h, h]), *-np.diag([h, h]))])
    np.testing.assert_allclose(worst.slope, (differences[:2] - differences[2:]) / (2 * h), rtol=1e-5)
    slopes = [min(problem.functions(x + step).aim, key=lambda p: p.value).slope for step in np.diag([h, h])]
    second = (np.array(slopes) - worst.slope) / h
    np.testing.assert_allclose(-problem.curvature(x, here.states, [(worst, 1.0)]), second, rtol=1e-2)


def test_an_unstable_loop_is_worse_than_any_norm() -> None:
    result = NN17.tuned()
    norm = peak_gain(NN17.closed(np.array(list(result.gains.values())))).value
    assert result.status is GainStatus.OPTIMAL
    assert norm == pytest.approx(11.2182, rel=1e-4)  # of HIFOO, in the literature
    assert np.exp(-result.value) == pytest.approx(norm, rel=1e-6)
