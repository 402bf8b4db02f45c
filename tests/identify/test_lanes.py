"""The compiled pass of a nonlinear structure against CasADi's own forward derivatives through all steps."""

from contextlib import nullcontext
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from compilers import NEEDS_COMPILER, forget_libraries, no_compiler

from gbid import NonlinearStructure, Parameter
from gbid.identify.disturbances import Disturbances, Trend
from gbid.identify.kernel.blocks import Segment, cut
from gbid.identify.kernel.sample import build_nonlinear_predictor
from gbid.identify.kernel.sums import Lagrangian
from gbid.identify.problem.assemble import choose_kernel

AT = {"k": 90.0, "c": 4.0, "tau": 0.03, "g": 2.0, "start": 0.2, "lag": 0.053}
STEPS, LENGTH, WINDOWS = 3, 7, 10
STRUCTURE = NonlinearStructure(
    "all_kinds_of_terms",
    [Parameter(name, value) for name, value in AT.items()],
    ["x", "v", "late"],
    lambda x, u, p: [x[1], -p.k * x[0] - p.c * x[0] ** 3 * ca.cos(x[2]) + x[2], (u[0] - x[2]) / p.tau + u[1]],
    lambda x, u, p: [x[0] + 0.1 * x[1] * u[0], p.k * x[2]],
    ["u", "later"],
    ["a", "b"],
    intersample="foh",
    disturbance_gain=lambda p: [[p.g, 0], [0, 1], [0, p.g]],
    delay=lambda p: [0, p.lag],
    steps=STEPS,
    x0=lambda p: [p.start, 0, 0],
)


@pytest.fixture(scope="module")
def case():
    rng = np.random.default_rng(0)
    disturbances = Disturbances(("a", "b"), (Trend(1), Trend(0)), ())
    predictor = build_nonlinear_predictor(
        STRUCTURE, {}, AT, 0.02, "foh", "prediction", disturbances=disturbances, released=(True, False, False)
    )
    n = LENGTH * WINDOWS
    segment = Segment(0.1 * rng.normal(size=(n, 2)), 0.1 * rng.normal(size=(n, 2)))
    blocks = cut([segment], predictor, LENGTH)
    values = predictor.at(np.array([AT.get(q.name, 0.01) for q in predictor.free]))
    return predictor, values, blocks, 0.1 * rng.normal(size=(WINDOWS, 3))


def through_all_steps(predictor, values, blocks, start, window):
    """Outputs and last state of a window with their derivatives by [theta, start], by CasADi through every step."""
    functions, (group, lane) = predictor.functions, divmod(window, blocks.lanes)
    theta, x = ca.SX.sym("theta", len(values.theta)), ca.SX.sym("x", 3)
    at, computed = x, []
    for z in blocks.z(values.shift)[group, :, :, lane]:
        at, yhat, e = functions.output(at, z, theta, values.known)
        for s in range(STEPS):
            at = functions.step(at, z, e, theta, values.known, s / STEPS, 1 / STEPS)
        computed.append(yhat)
    every, by = ca.vertcat(*computed, at), ca.vertcat(theta, x)
    result = ca.Function("every", [theta, x], [every, ca.jacobian(every, by)])(values.theta, start)
    return (np.array(each, float) for each in result)


@pytest.mark.parametrize("engine", [*(pytest.param(n, marks=NEEDS_COMPILER) for n in (2, 4, 8)), "numpy"])
def test_pass_is_that_of_casadi_through_all_steps(case, engine, monkeypatch):
    predictor, values, blocks, starts = case
    monkeypatch.setenv("GBID_CFLAGS", f"-O1 -DWIDTH={engine}")
    forget_libraries()
    with no_compiler() if engine == "numpy" else nullcontext():
        kernel, _ = choose_kernel(predictor, AT)
    forget_libraries()
    weight = np.array([[2.0, 0.3], [0.3, 1.0]])
    sweep = kernel.sweep(values, blocks, starts, weight)
    n_p = len(values.theta)
    hessian, gradient = np.zeros((n_p + 3, n_p + 3)), np.zeros(n_p + 3)
    for w, start in enumerate(starts):
        every, slopes = through_all_steps(predictor, values, blocks, start, w)
        psi, n_y = slopes[:-3].reshape(LENGTH, 2, -1), 2 * LENGTH
        group, lane = divmod(w, blocks.lanes)
        error = blocks.y[group, :, :, lane] - every[:n_y].reshape(LENGTH, 2)
        gauss_newton = np.einsum("kyi,yz,kzj->ij", psi, weight, psi)
        for computed, wanted in (
            (sweep.end[w], every[n_y:, 0]),
            (sweep.end_theta[w], slopes[-3:, :n_p]),
            (sweep.end_start[w], slopes[-3:, n_p:]),
            (sweep.hessian_mixed[w], gauss_newton[:n_p, n_p:]),
            (sweep.hessian_start[w], gauss_newton[n_p:, n_p:]),
        ):
            np.testing.assert_allclose(computed, wanted, rtol=1e-12, atol=1e-13 * np.abs(wanted).max())
        hessian += gauss_newton
        gradient -= np.einsum("kyi,yz,kz->i", psi, weight, error)
    np.testing.assert_allclose(sweep.hessian, hessian[:n_p, :n_p], rtol=1e-12, atol=1e-13 * np.abs(hessian).max())
    np.testing.assert_allclose(sweep.gradient, gradient[:n_p], rtol=1e-11, atol=1e-13 * np.abs(gradient).max())


@NEEDS_COMPILER
def test_points_run_side_by_side_and_the_gradient_of_a_single_window_is_chained_from_its_blocks(case):
    predictor, values, blocks, starts = case
    kernel, _ = choose_kernel(predictor, AT)
    (segment,) = blocks.segments
    complete = cut([segment], predictor, None, longest_block=LENGTH)
    assert (complete.n_windows, complete.n_blocks) == (1, WINDOWS)
    points = [values._replace(theta=values.theta * (1 + 1e-3 * i)) for i in range(11)]  # more than lanes
    begins = kernel.begins(points, complete, starts[:1])
    for point, begin in zip(points, begins, strict=True):
        np.testing.assert_array_equal(begin, kernel.begin(point, complete, starts[:1]))
    # Ten windows chained backwards, one at a time, as an adjoint would, make up the single one.
    ends, weight = np.array([[1.0, -2.0, 0.5]]), np.array([[2.0, 0.3], [0.3, 1.0]])
    alone = kernel.gradient(values, complete, Lagrangian(starts[:1], ends, weight))
    chained, by_start = np.zeros_like(alone[0]), ends
    along = begins[0].T[:WINDOWS]
    for w in reversed(range(WINDOWS)):  # by the ends of windows, from the last to the first
        every_end = np.zeros((WINDOWS, 3))
        every_end[w] = by_start[0]
        in_lane = np.arange(blocks.used.size // LENGTH).reshape(-1, 1, blocks.lanes) == w
        masked = replace(blocks, used=np.where(in_lane, blocks.used, 0.0))
        by_theta, start_of = kernel.gradient(values, masked, Lagrangian(along, every_end, weight))
        chained, by_start = chained + by_theta, start_of[w : w + 1]
    np.testing.assert_allclose(alone[0], chained, rtol=1e-10, atol=1e-12 * np.abs(chained).max())
    np.testing.assert_allclose(alone[1], by_start, rtol=1e-10)
