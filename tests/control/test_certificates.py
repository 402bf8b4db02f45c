"""Certificates of optimality, and the ascent by BFGS, on functions whose best point is known."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest
from gain_problems import damping_problem

from benchmarks.known_loops import two_masses_canonical
from gbid.control.tuning.certificate import certify
from gbid.control.tuning.local import ascend
from gbid.control.tuning.loops import families_of
from gbid.control.tuning.problem import GainProblem, Limits


def test_a_smooth_top_is_certified_and_a_slope_is_not() -> None:
    problem = damping_problem(lambda g: 0.5 - ca.sumsqr(g - 0.2), [-1.0] * 3, [1.0] * 3)
    top, x = certify(problem, np.full(3, 0.2), np.ones(3))
    assert top.holds
    assert x == pytest.approx(np.full(3, 0.2))
    low, y = certify(problem, np.full(3, 0.5), np.ones(3))
    assert problem.score(y).value > problem.score(np.full(3, 0.5)).value
    assert not low.holds or y == pytest.approx(np.full(3, 0.2), abs=0.01)


@pytest.mark.parametrize("bound", [1.0, 0.1])
def test_a_ridge_is_certified_from_gradients_around_it(bound: float) -> None:
    def ridge(g: Any) -> Any:
        return 0.5 - 0.3 * ca.fabs(g[0] - 0.3 * g[1]) - 0.1 * (g[1] - 0.5) ** 2

    problem = damping_problem(ridge, [-1.0, -1.0], [1.0, bound])
    best = np.array([0.15, 0.5]) if bound == 1.0 else np.array([0.03, 0.1])
    assert certify(problem, best + 1e-9, np.ones(2))[0].holds
    off = best - np.array([0.06, 0.2])  # on the ridge, below its top
    certificate, x = certify(problem, off, np.ones(2))
    assert not certificate.holds or problem.score(x).value > problem.score(off).value


def test_six_eigenvalues_that_meet_are_certified_by_their_mean() -> None:
    loop = two_masses_canonical()
    problem = GainProblem(families_of([loop.function], 5), Limits("decay"), np.full(5, -10.0), np.full(5, 10.0), 1.0)
    r = loop.best
    c5, c4 = 6 * r, 15 * r**2
    known = np.array([c5, c4 - 2, 15 * r**4 - 2 * (c4 - 2), 6 * r**5, r**6])
    certificate, _ = certify(problem, known, np.maximum(np.abs(known), 0.1))
    assert certificate.holds
    assert certificate.meeting == (6,)
    o = 0.9 * r  # six eigenvalues at another place are no solution of the two masses
    elsewhere = np.array([6 * o, 15 * o**2 - 2, 15 * o**4 - 2 * (15 * o**2 - 2), 6 * o**5, o**6])
    assert not certify(problem, elsewhere, np.maximum(np.abs(elsewhere), 0.1))[0].holds


def test_two_eigenvalues_that_have_not_met_leave_room() -> None:
    """Their mean has a damping of 0.5 + g/10; for g > d^2 they part from it across the ray of that damping."""

    def parted(distance: float) -> GainProblem:
        g, ray = ca.SX.sym("g"), np.exp(2j * np.pi / 3)
        damping = 0.5 + 0.1 * g
        mean, q = (
            (-damping, ca.sqrt(1 - damping**2)),
            [(distance**2 - g) * part for part in ((ray**2).real, (ray**2).imag)],
        )
        own, other = (ca.blockcat([[re, im], [-im, re]]) for re, im in (mean, q))
        A = ca.Function("A", [g], [ca.blockcat([[own, ca.SX.eye(2)], [other, own]])])
        return GainProblem(families_of([A], 1), Limits("damping"), np.full(1, -1.0), np.full(1, 1.0), 1.0)

    near, rest = parted(0.03), np.zeros(1)
    rise = near.score(np.array([0.03**2])).value / near.score(rest).value - 1
    certificate, x = certify(near, rest, np.ones(1))
    assert certificate.holds
    assert certificate.meeting == (2,)
    assert x == pytest.approx(rest)
    assert 1e-4 < rise < certificate.room
    far, x = certify(parted(0.3), rest, np.ones(1))
    assert not far.holds or x[0] > 0.08


def test_bfgs_climbs_a_curved_ridge_without_a_gradient() -> None:
    """Nonsmooth Rosenbrock function of the paper: top 0 at (1, 1)."""

    def evaluate(x: np.ndarray) -> tuple[float, np.ndarray]:
        off = x[1] - x[0] ** 2
        sign = np.sign(off)
        value = -8 * abs(off) - (1 - x[0]) ** 2
        return value, np.array([16 * sign * x[0] + 2 * (1 - x[0]), -8 * sign])

    found = ascend(evaluate, np.array([-1.0, 2.0]), np.full(2, -3.0), np.full(2, 3.0), np.ones(2), max_evaluations=2000)
    assert found.value > -1e-6
    assert found.x == pytest.approx([1, 1], abs=1e-2)
    bounded = ascend(
        evaluate, np.array([-1.0, 2.0]), np.full(2, -3.0), np.array([0.5, 3.0]), np.ones(2), max_evaluations=2000
    )
    assert bounded.x == pytest.approx([0.5, 0.25], abs=1e-3)
