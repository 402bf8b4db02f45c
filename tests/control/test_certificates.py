"""Certificates of optimality, and the ascent by BFGS, on functions whose best point is known."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest
from gain_problems import damping_problem

import gbid
from gbid.control import GainStatus, MaxDamping
from gbid.control.tuning.certificate import certify
from gbid.control.tuning.loops import families_of
from gbid.control.tuning.problem import GainProblem, Limits
from tests.benchmarks.known_loops import two_masses_canonical


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
    assert certificate.coalescing == (6,)
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
        mean_block, other = (ca.blockcat([[re, im], [-im, re]]) for re, im in (mean, q))
        A = ca.Function("A", [g], [ca.blockcat([[mean_block, ca.SX.eye(2)], [other, mean_block]])])
        return GainProblem(families_of([A], 1), Limits("damping"), np.full(1, -1.0), np.full(1, 1.0), 1.0)

    near, rest = parted(0.03), np.zeros(1)
    rise = near.score(np.array([0.03**2])).value / near.score(rest).value - 1
    certificate, x = certify(near, rest, np.ones(1))
    assert certificate.holds
    assert certificate.coalescing == (2,)
    assert x == pytest.approx(rest)
    assert 1e-4 < rise < certificate.room
    far, x = certify(parted(0.3), rest, np.ones(1))
    assert not far.holds or x[0] > 0.08


@pytest.mark.parametrize("band", [{}, {"high_hz": 150.0}], ids=["all modes", "band"])
def test_modes_without_damping_that_nearly_meet_are_no_optimum(band: dict[str, float]) -> None:
    """Two equal axes without control: any damping gain is better, whatever the objective counts."""
    none, eye, w = np.zeros((2, 2)), np.eye(2), np.array([600.0, 601.0])
    A = np.block([[none, eye], [-np.diag(w**2), -0.02 * np.diag(w)]])
    plant = gbid.LinearModel(A, np.vstack([none, eye]), np.hstack([eye, none]), none, output_names=("x", "y"))
    law = gbid.controller_structure("PD", axes=("x", "y"), lower=-1e5, upper=1e5, kd_limit_ms=2e5, lowpass_hz=2000.0)
    result = gbid.tune(plant, law, goals=[MaxDamping(**band)], starts=0, evaluations=1)
    assert result.value == pytest.approx(0.01)
    assert result.status is GainStatus.ITERATION_LIMIT
