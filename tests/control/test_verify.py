"""Checks of a design against peaks, norms and edges that are known."""

from __future__ import annotations

from importlib import import_module
from typing import Any

import casadi as ca
import numpy as np
import pytest
from gain_problems import damping_problem, responding
from scipy.optimize import brentq

import gbid
from gbid.control.loop.norm import peak_gain
from gbid.control.tuning.peaks import ModalResponse, Peaks
from gbid.control.tuning.problem import GainProblem, Limits
from gbid.control.tuning.result import Edge, distance_to_edge, exact_norms
from gbid.control.tuning.search import SearchTask
from gbid.control.tuning.solve import solve, summarise

NOTHING = np.zeros(1)


def peak(damping: float) -> float:
    return 1 / (2 * damping * np.sqrt(1 - damping**2))


# ---- peaks that the grid missed ----


def on_two_frequencies(loops: Any, modes: Any, rows: slice, extra: Any = None, least: float = 0.0) -> Peaks:
    """Peaks as a grid of two frequencies beside the resonance knows them, and at the places it is told of."""
    m = len(loops.A)
    which, places = np.repeat(np.arange(m), 2), np.tile([0.5, 2.0], m)
    if extra is not None:
        which, places = np.concatenate([which, extra[0]]), np.concatenate([places, extra[1]])
    response = ModalResponse(loops, modes, rows)(places[:, None], which)
    return Peaks(which, places, np.linalg.svd(response, compute_uv=False)[:, 0, 0])


def test_a_design_keeps_its_limit_between_the_grids_frequencies(monkeypatch: pytest.MonkeyPatch) -> None:
    """More gain damps more and responds more; the peak is 20 at one gain, the best that the limit allows."""
    monkeypatch.setattr(import_module("gbid.control.tuning.problem"), "find_peaks", on_two_frequencies)

    def height(g: float) -> float:
        return (1 + 9 * g) * peak(0.05 + 0.1 * g)

    g = ca.SX.sym("g")
    family = responding(0.05 + 0.1 * g, g, size=1 + 9 * g)
    problem = GainProblem((family,), Limits(peak_sensitivity=20.0), np.zeros(1), np.ones(1), 1.0)
    solution = solve(problem, SearchTask(NOTHING))
    computed = solution.best
    known = brentq(lambda g: height(g) - 20.0, 0, 1)
    assert computed.x == pytest.approx([known], rel=1e-4)
    assert exact_norms(family, computed.x, "sensitivity")[0].value <= 20.0 * (1 + 1e-5)
    assert "cut" in {step.stage for step in solution.history}
    result = summarise(solution, ("g",), "loops")
    assert (result.status, result.success) == ("optimal", True)
    assert result.peak_sensitivity == pytest.approx(20.0, rel=1e-5)
    assert result.peak_control == pytest.approx(60.0, rel=1e-5)
    assert result.static_amplification == pytest.approx(1 + 9 * known, rel=1e-4)
    assert result.active == ("peak of S_o at loop of 1 rad/s",)


# ---- worst mode and edge ----


def test_the_nearest_edge_of_stability() -> None:
    """Damping ``0.3 + a - 2 b`` is nothing at a = -0.3 and at b = 0.15, which is nearer."""
    problem = damping_problem(lambda g: 0.3 + g[0] - 2 * g[1], [-1.0, -1.0], [1.0, 1.0])
    edge = distance_to_edge(problem, np.zeros(2), ("a", "b"))
    assert edge.gain == "b"
    assert 0.15 <= edge.change <= 0.15 * 1.011
    down = damping_problem(lambda g: 0.3 + 3 * g[0] - 2 * g[1], [-1.0, -1.0], [1.0, 1.0])
    edge = distance_to_edge(down, np.zeros(2), ("a", "b"))
    assert edge.gain == "a"
    assert -0.1 * 1.011 <= edge.change <= -0.1
    far = damping_problem(lambda g: 0.3 + g[0] - 2 * g[1], [-0.05, -0.05], [0.05, 0.05])
    assert distance_to_edge(far, np.zeros(2), ("a", "b")) == Edge("", np.inf)


def test_the_peak_of_a_response_that_its_input_does_not_reach_is_zero() -> None:
    # the output sees the second state, the input moves the first; levels near 1e-154 overflowed
    model = gbid.LinearModel([[-1.0, 0.0], [0.0, -3.0]], [[1e9], [0.0]], [[0.0, 1e9]], [[0.0]])
    assert peak_gain(model).value < 1e-10
