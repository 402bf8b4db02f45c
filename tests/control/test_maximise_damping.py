"""The general tuner on problems with known answers, and its derivatives against differences."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest
from scipy.optimize import minimize

import gbid
from gbid.control.tuning.peaks import Peaks, peak_slopes
from gbid.control.tuning.plants import TuneOptions, plants_of
from gbid.control.tuning.problem import GainProblem, Limits, rows_of
from gbid.structure import LinearModel
from tests.benchmarks.known_loops import two_masses_canonical


def delayed_loop(a: float, tau: float) -> ca.Function:
    """``x' = -a x + u(t - tau)``, ``u = -g x``, first-order Pade: ``(s + a)(1 + tau s/2) + g (1 - tau s/2) = 0``."""
    g = ca.SX.sym("g")
    c1 = 1 + a * tau / 2 - g * tau / 2
    return ca.Function("A", [g], [ca.blockcat([[0, 1], [-2 / tau * (a + g), -2 / tau * c1]])])


@pytest.mark.parametrize(("a", "tau"), [(1.0, 0.5), (0.2, 2.0), (30.0, 0.01)])
def test_delayed_first_order_loop_has_its_best_decay_at_the_double_pole(a: float, tau: float) -> None:
    # The quadratic's discriminant vanishes for q = g tau/2 = 3 + a tau/2 - sqrt(8 + 4 a tau), where the double pole
    # lies at -(sqrt(8 + 4 a tau) - 2)/tau: below that gain the slow real pole is slower, above it the pair is.
    root = np.sqrt(8 + 4 * a * tau)
    result = gbid.maximise_damping(delayed_loop(a, tau), ["g"], 0.0, 4.0 / tau, "decay")
    assert result.success
    assert result.gains["g"] == pytest.approx((3 + a * tau / 2 - root) * 2 / tau, rel=1e-6)
    assert result.value == pytest.approx((root - 2) / tau, rel=1e-5)


def test_two_masses_and_a_spring_come_near_the_published_decay() -> None:
    # D. Henrion, M. L. Overton, "Maximizing the closed loop asymptotic decay rate for the two-mass-spring control
    # problem", 2006: the plant 1/(s^2 (s^2 + 2)) with a controller of order two. The closed loop is
    # s^6 + x1 s^5 + (2 + x0) s^4 + 2 x1 s^3 + ...: its coefficients are free but for c3 = 2 c5. No decay r is larger
    # than sqrt(15)/5: in p(s) = sum q_k (s + r)^k the q are not negative when all roots lie left of -r, so that
    # c3 - 2 c5 = q3 + 4 r q4 + (10 r^2 - 2) q5 + 20 r^3 - 12 r is positive for r^2 > 3/5, and zero for (s + r)^6 with
    # r^2 = 3/5. Six eigenvalues meet there.
    loop = two_masses_canonical()
    function, best = loop.function, np.sqrt(15) / 5
    known = [6 * best, 15 * best**2 - 2, 15 * best**4 - 2 * (15 * best**2 - 2), 6 * best**5, best**6]
    assert np.poly(np.array(function(known))) == pytest.approx(np.poly([-best] * 6), rel=1e-9)
    result = loop.tune(starts=0)
    # rounding moves a root of multiplicity six by its sixth root, some thousandths
    assert 0.99 * best < result.value <= best + 1e-6
    assert list(result.gains.values()) == pytest.approx(known, rel=2e-2)
    assert np.linalg.eigvals(np.array(function(list(result.gains.values())))).real.max() < -0.99 * best


def test_static_output_feedback_of_a_helicopter() -> None:
    # The plant of L. H. Keel, S. P. Bhattacharyya, J. W. Howze, "Robust control with structured perturbations", IEEE
    # Trans. Automatic Control 33, 1988 (HE1 in the collection COMPleib): two inputs, one output, so two gains.
    A = np.array(
        [
            [-0.0366, 0.0271, 0.0188, -0.4555],
            [0.0482, -1.01, 0.0024, -4.0208],
            [0.1002, 0.3681, -0.707, 1.42],
            [0.0, 0.0, 1.0, 0.0],
        ]
    )
    B = np.array([[0.4422, 0.1761], [3.5446, -7.5922], [-5.52, 4.49], [0.0, 0.0]])
    C = np.array([[0.0, 1.0, 0.0, 0.0]])
    assert -np.linalg.eigvals(A).real.max() < 0
    g = ca.SX.sym("g", 2)
    result = gbid.maximise_damping(ca.Function("A", [g], [A + B @ g @ C]), ["a", "b"], -10, 10, "decay")

    def decay(gains: np.ndarray) -> np.ndarray:
        loops = A + (np.clip(gains, -10, 10) @ B.T)[..., :, None] * C[0]
        return -np.linalg.eigvals(loops).real.max(axis=-1)

    axis = np.linspace(-10, 10, 101)
    grid = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 2)
    brute = max(
        -minimize(lambda k: -decay(k), start, method="Nelder-Mead", options={"xatol": 1e-10, "fatol": 1e-12}).fun
        for start in grid[np.argsort(-decay(grid))[:8]]
    )
    assert result.success
    assert result.value == pytest.approx(brute, abs=1e-8)
    assert result.active == ("b at its upper bound",)
    # Gains without bounds: three eigenvalues tend to the zeros of (s I - A, B k, C), one to minus infinity.
    limit = max(
        -np.roots(np.polysub(np.poly(A - (B @ [np.cos(t), np.sin(t)])[:, None] * C), np.poly(A))[1:]).real.max()
        for t in np.linspace(0, np.pi, 401)
    )
    assert result.value < limit < 1.05 * result.value


def test_functions_of_several_sizes_are_tuned_together() -> None:
    g = ca.SX.sym("g", 2)
    # two oscillators with damping g0/2 and 1 - g0/2, and a third that wants g1 = 1 (damping 1 - (g1 - 1)^2)
    first = ca.Function("first", [g], [ca.blockcat([[0, 1], [-1, -g[0]]])])
    second = ca.Function("second", [g], [ca.blockcat([[0, 1], [-1, -(2 - g[0])]])])
    third = ca.diagcat(ca.blockcat([[0, 1], [-4, -4 * (0.9 - (g[1] - 1) ** 2)]]), -7)
    result = gbid.maximise_damping([first, second, ca.Function("third", [g], [third])], ["a", "b"], 0, 2)
    assert result.success
    assert result.gains["a"] == pytest.approx(1.0, abs=1e-7)
    assert result.value == pytest.approx(0.5, abs=1e-7)
    assert 0.9 - (result.gains["b"] - 1) ** 2 >= 0.5 - 1e-7


def test_real_poles_that_grow_are_no_solution() -> None:
    # s^2 + 2 s + (1 - g): without oscillation for g > 0, but unstable for g > 1
    g = ca.SX.sym("g")
    A = ca.Function("A", [g], [ca.blockcat([[0, 1], [g - 1, -2]])])
    result = gbid.maximise_damping(A, ["g"], -3, 3)
    assert result.success
    assert result.value == pytest.approx(1.0)
    assert -1e-6 <= result.gains["g"] < 1.0
    slow = gbid.maximise_damping(A, ["g"], -3, 3, slowest_pole=0.5)
    assert np.linalg.eigvals(np.array(A(slow.gains["g"]))).real.max() <= -0.5 + 1e-6


def test_bounds_without_a_stabilising_gain_name_the_worst_mode() -> None:
    g = ca.SX.sym("g")
    A = ca.Function("A", [g], [ca.blockcat([[0, 1], [-4, 1 - g]])])
    result = gbid.maximise_damping(A, ["g"], -2, 0.2)
    assert (result.status, result.success) == ("no stabilising gains", False)
    assert result.gains["g"] == pytest.approx(0.2, abs=1e-6)  # the least unstable
    assert result.worst.where == "A[0]"
    assert result.worst.damping == pytest.approx(-0.2)
    assert result.worst.frequency_hz == pytest.approx(1 / np.pi)
    assert "A[0]" in result.notes[0]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (([], ["g"], 0, 1), "at least one function"),
        ((delayed_loop(1, 1), ["g", "h"], 0, 1), "one vector of 2 gains"),
        ((delayed_loop(1, 1), ["g"], 1, 0), "lower first"),
        ((delayed_loop(1, 1), ["g"], 0, np.inf), "finite"),
        ((delayed_loop(1, 1), ["g"], [0, 0], 1), "bounds .*one for each of 1 gains"),
        ((delayed_loop(1, 1), ["g", "g"], 0, 1), "a different name"),
        ((delayed_loop(1, 1), ["g"], 0, 1, "speed"), "objective"),
        ((["A"], ["g"], 0, 1), "give Function"),
        ((lambda g: g, ["g"], 0, 1), "give Function"),
        ((delayed_loop(1, 1), [], 0, 1), "at least one function and one gain"),
    ],
)
def test_wrong_arguments(arguments: tuple[object, ...], message: str) -> None:
    with pytest.raises(gbid.core.errors.UsageError, match=message):
        gbid.maximise_damping(*arguments)


def paper_problem(controller: str, **limits: float) -> tuple[GainProblem, np.ndarray]:
    model = gbid.load_model("theisen2016")
    structure = gbid.controller_structure(controller)
    plants = plants_of(model, structure, TuneOptions(operating_points=[(6.0, 0.0), (3.0, 6000.0)]))
    family = plants.family(plants.points)
    low, high = (np.array([getattr(p, side) for p in structure.parameters]) for side in ("lower", "upper"))
    x = np.array([0.9, 0.7, 0.3, -0.2, -0.6, -0.9, 0.3, 0.35, 0.6, 0.9])[: len(low)]
    return GainProblem((family,), Limits(peak_sensitivity=2.0, peak_control=1.8, **limits), low, high, 800.0), x


STATIC = {"static_amplification": 1.5, "slowest_pole": 100.0}


@pytest.mark.parametrize("controller", ["P", "biquad"])
def test_slopes_of_all_pieces_against_differences(controller: str) -> None:
    problem, x = paper_problem(controller, **STATIC)
    functions = problem.functions(x)
    assert {function.kind for function in functions.limits} >= {"sensitivity", "control", "static"}
    step = 1e-6
    for i in range(len(x)):
        sides = [problem.functions(x + sign * step * np.eye(len(x))[i]) for sign in (1, -1)]
        for group in ("aim", "limits"):
            for function in getattr(functions, group):
                alike = [
                    min(
                        (p for p in getattr(side, group) if (p.kind, p.loop) == (function.kind, function.loop)),
                        key=lambda p, place=function.place: abs(p.place - place),
                    )
                    for side in sides
                ]
                difference = (alike[0].value - alike[1].value) / (2 * step)
                assert function.slope[i] == pytest.approx(difference, rel=2e-4, abs=2e-5)


def through_problem() -> tuple[GainProblem, np.ndarray]:
    """A plant with feedthrough: the matrices of the loop are no linear functions of those of the controller."""
    plant = LinearModel(
        [[0, 1, 0, 0], [-900, -6, 50, 0], [0, 0, 0, 1], [-80, 0, -1600, -9]], [[0, 0], [900, 0], [0, 0], [300, 1600]],
        [[1, 0, 0, 0], [0.2, 0, 1, 0]], [[0.3, 0.1], [-0.1, 0.2]], input_names=["a", "b"], output_names=["c", "d"],
    )  # fmt: skip
    structure = gbid.controller_structure("lead-lag")
    low, high = (np.array([getattr(p, side) for p in structure.parameters]) for side in ("lower", "upper"))
    plants = plants_of(plant, structure, TuneOptions())
    family = plants.family(plants.points)
    return GainProblem((family,), Limits(peak_sensitivity=1.0), low, high, 30.0), low + 0.37 * (high - low)


@pytest.mark.parametrize("made", [lambda: paper_problem("biquad", **STATIC), through_problem])
def test_curvature_of_all_pieces_against_differences(made: Any) -> None:
    problem, x = made()
    here = problem.functions(x, window=0.1)
    assert {"aim", "sensitivity"} <= {function.kind for function in (*here.aim, *here.limits)}
    designs = [x + 1e-5 * e for e in np.vstack([np.eye(len(x)), -np.eye(len(x))])]
    for function in (*here.aim, *here.limits):
        slopes = []
        for design in designs:
            loops = problem.families[0].derivatives(design)
            if function.kind in ("aim", "pole"):
                side = problem.functions(design, window=0.2)
                alike = [p for p in (*side.aim, *side.limits) if (p.kind, p.loop) == (function.kind, function.loop)]
                slopes.append(min(alike, key=lambda p, place=function.place: abs(p.place - place)).slope)
            else:  # of a peak at a fixed frequency
                rows = rows_of(problem.families[0], function.kind)
                peak = Peaks(np.array([function.loop]), np.array([function.place.imag]), np.ones(1))
                slopes.append(np.divide(*peak_slopes(loops, rows, peak))[0])
        difference = (np.array(slopes[: len(x)]) - slopes[len(x) :]) / 2e-5
        curvature = problem.curvature(x, here.states, [(function, 1.0)])
        np.testing.assert_allclose(curvature, difference, rtol=1e-3, atol=1e-3 * np.abs(difference).max())
