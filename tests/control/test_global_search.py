"""The search over gains on problems whose best design is known."""

from __future__ import annotations

from dataclasses import replace
from itertools import chain, pairwise, repeat
from typing import Any

import casadi as ca
import numpy as np
import pytest
from gain_problems import damping_problem

import gbid
from gbid.control import MaxDamping, PeakSensitivity, controller_model
from gbid.control.tuning import problem as budget
from gbid.control.tuning.local import optimise_locally
from gbid.control.tuning.problem import GainProblem, Score
from gbid.control.tuning.result import GainStatus
from gbid.control.tuning.search import GainSolution, SearchOptions, SearchTask, search


def loop_of(result: gbid.GainResult) -> gbid.LinearModel:
    return gbid.close_loop(MODEL.plant_at(6, 0), controller_model(result.controller, result.gains))


def searched(
    problem: GainProblem, neutral: np.ndarray, first: tuple[np.ndarray, ...] = (), **options: Any
) -> GainSolution:
    return search(problem, SearchTask(neutral, first, SearchOptions(**options)))


def two_basins(g: Any) -> Any:
    """0.32 at -0.537, where a climb from 0 ends, and 0.72 at 1.963; neither is a node of the search's grid."""
    return 0.02 + 0.3 * ca.exp(-(((g + 0.537) / 0.4) ** 2)) + 0.7 * ca.exp(-(((g - 1.963) / 0.4) ** 2))


def test_the_better_of_two_basins_is_found_from_a_start_in_the_other() -> None:
    problem, neutral = damping_problem(two_basins, [-3.0], [3.0]), np.zeros(1)
    near = optimise_locally(problem, neutral)
    assert near.converged
    assert near.x == pytest.approx([-0.537], abs=1e-3)
    assert near.score.value == pytest.approx(0.32, abs=1e-6)
    steps: list[Any] = []
    solution = search(problem, SearchTask(neutral, progress=steps.append))
    assert solution.best.converged
    assert solution.best.x == pytest.approx([1.963], abs=1e-3)
    assert solution.best.score == Score(pytest.approx(0.72, abs=1e-6), 0.0)
    assert tuple(steps) == solution.history
    assert steps[0].stage == "global"
    assert steps[-1].value == solution.best.score.value
    assert all(a.value <= b.value and a.count < b.count for a, b in pairwise(steps))


def test_basin_hopping_crosses_ripples_that_hold_a_climb() -> None:
    """A hill of four gains with ripples along the first, 0.06 of 2 apart: the top is 0.6, at zero."""

    def rippled(g: Any) -> Any:
        return 0.6 - 0.3 * ca.sumsqr(g) + 0.02 * (ca.cos(2 * np.pi * g[0] / 0.06) - 1)

    problem, neutral = damping_problem(rippled, [-1.0] * 4, [1.0] * 4), np.array([0.31, 0.4, -0.3, 0.2])
    problem = replace(problem, linear=(("never active", np.zeros(4), 1.0),))  # without any limit BFGS takes over
    held = searched(problem, neutral, starts=0, hops=0)
    assert held.best.score.value < 0.598  # the tops of the ripples beside the highest: 0.5989, 0.5957
    assert {step.stage for step in held.history} == {"global", "local"}
    solution = searched(problem, neutral, starts=0)
    assert solution.best.score.value == pytest.approx(0.6, abs=1e-6)
    assert solution.best.x == pytest.approx(np.zeros(4), abs=1e-3)
    assert {step.stage for step in solution.history} == {"global", "local", "basin hopping"}


# ---- Independent searches, and what a status says.

MODEL = gbid.load_model("theisen2016")


def test_independent_seeds_are_tried_and_the_words_say_how_many() -> None:
    options = {"operating_points": [(6, 0)], "peak_sensitivity": 2.2832}
    grid = gbid.tune(MODEL, **options)
    assert (grid.seed_values, grid.optimality) == (
        (),
        "optimum, certified; searched from a grid over all bounds",
    )
    one = gbid.tune(MODEL, starts=1, **options)
    assert one.optimality == "local optimum, certified; one search, other seeds were not tried"
    many = gbid.tune(MODEL, starts=1, seeds=4, **options)
    assert len(set(many.seed_values)) > 1
    assert many.value == pytest.approx(max(many.seed_values), rel=1e-6)
    assert many.optimality == "local optimum, certified; the best of 4 independent searches, 4 of them within 2 %"
    alike = gbid.tune(MODEL, starts=1, seeds=6, operating_points=[(6, 0)], peak_sensitivity=2.0)
    assert len(alike.seed_values) == 3  # with the same design, which ends the others


def test_a_design_without_a_certificate_is_no_success_but_keeps_its_limits() -> None:
    design = gbid.tune(MODEL, operating_points=[(6, 0)], peak_sensitivity=2.2832)
    verdicts = {status: replace(design, status=status) for status in GainStatus}
    assert [str(s) for s, r in verdicts.items() if r.success] == ["optimal", "local optimum"]
    kept = ["optimal", "local optimum", "stalled", "iteration limit"]
    assert [str(s) for s, r in verdicts.items() if r.keeps_limits] == kept
    assert not replace(verdicts[GainStatus.ITERATION_LIMIT], violation=2e-6).keeps_limits
    assert verdicts[GainStatus.STALLED].optimality.startswith("no certified optimum")


def test_a_budget_in_seconds_ends_all_searches(monkeypatch: pytest.MonkeyPatch) -> None:
    """The clock of the test jumps beyond the budget, so that no check can certify the first design either."""
    times = chain([0.0], repeat(11.0))
    monkeypatch.setattr(budget, "monotonic", lambda: next(times))
    result = gbid.tune(MODEL, "biquad", operating_points=[(6, 0)], seeds=50, seconds=10.0)
    assert result.status is GainStatus.ITERATION_LIMIT
    assert len(result.seed_values) == 1
    assert len(result.history) < 5


def test_the_checks_of_a_design_end_with_the_time_and_say_so(monkeypatch: pytest.MonkeyPatch) -> None:
    """The clock of the test jumps after the budget was set: to the time of the checks, or beyond."""
    options = {"operating_points": [(6, 0)], "seconds": 10.0}
    for jump, checked in ((9.0, True), (11.0, False)):
        times = chain([0.0], repeat(jump))
        monkeypatch.setattr(budget, "monotonic", lambda times=times: next(times))
        result = gbid.tune(MODEL, "PD", **options)
        assert checked or result.status is GainStatus.ITERATION_LIMIT
        assert (result.peak_sensitivity is not None) == checked
        assert (result.certificate_gain is not None) == checked
        assert result.verified_on.endswith("eigenvalues alone at the end: the time was over") != checked
        poles = np.linalg.eigvals(loop_of(result).A)
        assert (poles.real < 0).all()
        assert min(-poles.real / np.abs(poles)) == pytest.approx(result.worst.damping, rel=1e-6)


@pytest.mark.parametrize(("law", "cap", "evaluations", "kept"), [("biquad", 2.5, 130, True), ("PID", 1.7, 80, False)])
def test_a_budget_ends_with_limits_that_hold_or_an_honest_status(law, cap, evaluations, kept) -> None:
    """Without feedback this plant is unstable, so that the search begins outside of its limits.

    A search of 2000 designs ends with a biquad that keeps its limit, and with no PID that does.
    """
    A, B, C, D = np.array([[0.0, 300.0], [300.0, 0.0]]), np.array([[0.0], [300.0]]), np.eye(1, 2), np.zeros((1, 1))
    options = {"kd_limit_ms": 3.0} if law == "PID" else {}
    structure = gbid.controller_structure(law, axes=("",), **options)
    goals = [MaxDamping(), PeakSensitivity(cap)]
    result = gbid.tune(gbid.LinearModel(A, B, C, D), structure, goals=goals, evaluations=evaluations)
    assert (result.status, result.keeps_limits) == (GainStatus.ITERATION_LIMIT, kept)
    assert (result.violation <= 1e-6) == kept
    K = gbid.control.controller_at(structure, dict(result.gains), 0.0, 0.0)
    loop = np.block([[A + B @ K.D @ C, B @ K.C], [K.B @ C, K.A]])
    assert np.linalg.eigvals(loop).real.max() < 0
    s = 1j * np.geomspace(1.0, 1e6, 20_000)
    G = np.array([(C @ np.linalg.solve(p * np.eye(2) - A, B))[0, 0] for p in s])
    H = np.array([(K.C @ np.linalg.solve(p * np.eye(len(K.A)) - K.A, K.B) + K.D)[0, 0] for p in s])
    peak = np.abs(1 / (1 - G * H)).max()
    assert peak <= cap * (1 + 2e-6) if kept else peak == pytest.approx(cap * np.exp(result.violation), rel=1e-3)


def test_a_larger_budget_gives_no_worse_gains_and_an_early_end_stable_ones() -> None:
    """A quarter of the box stabilises this free mass; near the start, without feedback, its poles are at zero."""
    matrices = ([[0.0, 1.0], [0.0, 0.0]], [[0.0], [9e4]], [[1.0, 0.0]], [[0.0]])
    mass = gbid.LinearModel(*map(np.array, matrices))
    law = gbid.controller_structure("notch", axes=("",))
    results = [gbid.tune(mass, law, goals=[MaxDamping()], evaluations=n) for n in (30, 50, 100, 200, 400)]
    assert results[0].status is GainStatus.ITERATION_LIMIT
    values = [result.value for result in results]
    assert values == sorted(values)
    assert values[-1] > 0.74  # of an unlimited search
    for result in results:
        K = gbid.control.controller_at(law, dict(result.gains), 0.0, 0.0)
        A = np.block([[mass.A + mass.B @ K.D @ mass.C, mass.B @ K.C], [K.B @ mass.C, K.A]])
        assert np.linalg.eigvals(A).real.max() < 0
