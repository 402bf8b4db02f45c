"""Designs over a rectangle whose worst point is known."""

from __future__ import annotations

from dataclasses import replace
from importlib import import_module
from typing import Any

import casadi as ca
import numpy as np
import pytest
from gain_problems import DampedLoops

import gbid
from gbid.control.tuning.local import optimise_locally
from gbid.control.tuning.problem import ExtraLimit, GainProblem, Limits
from gbid.control.tuning.search import GainSolution, SearchTask
from gbid.control.tuning.solve import TOLERANCE, add_worst_points, measure
from gbid.lpv import Domain

MODEL = gbid.load_model("theisen2016")
DOMAIN = Domain((2.0, 7.0), (0.0, 8000.0))
CORNERS = np.array([(P, Omega) for P in DOMAIN.pressure_bar for Omega in DOMAIN.speed_rpm])
TOP = np.array([4.37, 2345.0])
"""Place of the bump; no node of a grid of 33 x 33."""


def bump(P: Any, Omega: Any, exp: Any = ca.exp) -> Any:
    """1 at `TOP`, nothing at the corners."""
    return exp(-(((P - TOP[0]) / 0.5) ** 2) - ((Omega - TOP[1]) / 600) ** 2)


def at_corners(loops: DampedLoops, limits: Limits) -> GainSolution:
    problem = GainProblem((loops.family(CORNERS),), limits, np.array([-3.0]), np.array([3.0]), 1.0)
    return GainSolution(problem, optimise_locally(problem, np.zeros(1)))


def asks_for_more(g: Any, s: Any) -> Any:
    """Damping ``0.9 - 0.5 (g - h)^2 - 0.15 h`` of a bump h.

    It is worst where h is 0 or 1. Both are equal for ``0.5 g^2 = 0.15 + 0.5 (1 - g)^2``, g = 0.65: 0.68875.
    """
    h = bump(s[0], s[1])
    return 0.9 - 0.5 * (g - h) ** 2 - 0.15 * h


def test_the_worst_point_inside_is_added_and_the_search_ends() -> None:
    loops = DampedLoops(asks_for_more)
    known = at_corners(loops, Limits())
    assert (known.best.x[0], known.best.score.value) == pytest.approx((0.0, 0.9), abs=1e-6)
    told: list[Any] = []
    solution, verified = add_worst_points(known, loops, DOMAIN, SearchTask(np.zeros(1), progress=told.append))
    problem, best, history = solution.problem, solution.best, solution.history
    assert best.converged
    assert best.x == pytest.approx([0.65], abs=1e-4)
    assert best.score.value == pytest.approx(0.68875, abs=TOLERANCE)
    points = problem.families[0].points
    assert points is not None
    np.testing.assert_array_equal(points[:4], CORNERS)
    assert points[4] == pytest.approx(TOP, rel=5e-4)  # nearer than a twentieth of the grid's step
    assert len(points) == 5
    assert tuple(told) == history
    assert [step.stage for step in history] == ["points"]
    assert history[0].value == best.score.value
    assert verified.startswith("eigenvalues and exact H-infinity norms of 5 loops; no point of the rectangle worse")
    fine = np.stack(np.meshgrid(np.linspace(2, 7, 101), np.linspace(0, 8000, 101)), axis=-1).reshape(-1, 2)
    assert measure(problem, best.x, loops, fine)[0].max() < -best.score.value + 2 * TOLERANCE


def test_a_limit_that_a_point_inside_exceeds_holds_the_design_back() -> None:
    """The gain that damps best, 1, may not be had where the bump allows ``exp(g h) <= exp(0.5)``: g = 0.5."""

    def push(family: Any, gains: Any) -> Any:
        return np.exp(gains[0] * bump(*family.points.T, exp=np.exp))

    loops = DampedLoops(lambda g, _s: 0.4 - (g - 1) ** 2)
    known = at_corners(loops, Limits(extra=(ExtraLimit("push", push, float(np.exp(0.5))),)))
    assert (known.best.x[0], known.best.score.value) == pytest.approx((1.0, 0.4), abs=1e-5)
    table = measure(known.problem, known.best.x, loops, np.vstack([CORNERS[:1], TOP]))
    np.testing.assert_allclose(table, [[-0.4, -0.4], [-0.4, -0.4], [-0.5, 0.5]], atol=1e-4)  # aim, slowest pole, push
    solution, _ = add_worst_points(known, loops, DOMAIN, SearchTask(np.zeros(1)))
    problem, best = solution.problem, solution.best
    assert best.converged
    assert best.x == pytest.approx([0.5], abs=2 * TOLERANCE)
    assert best.score.value == pytest.approx(0.15, abs=2 * TOLERANCE)
    points = problem.families[0].points
    assert points is not None
    assert points[-1] == pytest.approx(TOP, rel=5e-4)


def test_nothing_is_added_where_no_point_is_worse() -> None:
    loops = DampedLoops(lambda g, s: 0.4 - (g - 1) ** 2 - 0.01 * s[0])  # worst along the edge at 7 bar
    known = at_corners(loops, Limits())
    assert add_worst_points(known, loops, DOMAIN, SearchTask(np.zeros(1)))[0] is known


def test_ending_before_all_worst_points_are_in_is_no_optimum(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(import_module("gbid.control.tuning.solve"), "_ROUNDS", 0)
    loops = DampedLoops(asks_for_more)
    known = at_corners(loops, Limits())
    solution, _ = add_worst_points(known, loops, DOMAIN, SearchTask(np.zeros(1)))
    assert not solution.best.converged


def test_a_list_of_models_with_other_actuators_says_that_no_worst_points_are_searched() -> None:
    model = gbid.load_model("theisen2016")
    other = replace(model, actuators={name: 1.01 * value for name, value in model.actuators.items()})
    result = gbid.tune([model, other], operating_points="domain", starts=0, evaluations=20)
    assert any(note.endswith("[GB413]") for note in result.notes)
    alone = gbid.tune(model, operating_points=[(6, 0)], starts=0, evaluations=20)
    assert not any("GB413" in note for note in alone.notes)
    assert alone.history[-1].count < 200  # a search of the whole box takes thousands


def test_a_list_of_models_gets_its_worst_points_too() -> None:
    soft = {name: tuple(0.93 * np.array(terms)) for name, terms in MODEL.coefficients.items() if name.startswith("k_")}
    models = [MODEL, replace(MODEL, coefficients={**MODEL.coefficients, **soft})]
    design = gbid.tune(models, operating_points="domain")
    assert design.success
    assert "no point of the rectangle worse" in design.verified_on
    law = gbid.control.controller_model(design.controller, design.gains)
    grid = [(P, Omega) for P in np.linspace(3, 7, 5) for Omega in np.linspace(0, 6000, 4)]
    reached = [
        gbid.control.smallest_damping(gbid.close_loop(model.plant_at(*point), law))
        for model in models
        for point in grid
    ]
    assert min(reached) >= design.value - 1e-4
    peaks = [gbid.sensitivities(model.plant_at(*point), law).peak("output").value for model in models for point in grid]
    assert max(peaks) <= 2.6 * (1 + 1e-4)
    alone = gbid.tune(MODEL, operating_points="domain")
    assert design.value < alone.value - 1e-3
    assert len(gbid.assess(models, design, points=[(6.0, 0.0)]).points) == 2


def test_where_all_poles_are_real_the_design_decays_fast() -> None:
    # x'' + x' + 100 (1 - kappa - kd s) x: kd has the damping 1 from some gain on, and slows a pole down beyond it
    plant = gbid.LinearModel([[0, 1], [-100, -1]], [[0], [100]], [[1, 0]], [[0]])
    form = gbid.controller_structure("PD", axes=("",), lower=-2.0, upper=0.9, kd_limit_ms=1000.0)
    design = gbid.tune(plant, form, goals=[gbid.control.MaxDamping()])
    assert design.status == "optimal"
    assert design.value == pytest.approx(1.0, abs=1e-8)
    law = gbid.control.controller_model(form, design.gains)
    law = replace(law, input_names=plant.output_names, output_names=plant.input_names)
    slowest = -gbid.close_loop(plant, law).poles().real.max()
    assert slowest == pytest.approx(np.sqrt(300), rel=0.01)  # both poles of s^2 + ... + 300 meet there, kappa = -2
