"""Margins of a loop: closed forms, python-control, and changes that do make the loop unstable."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from loop_cases import MACHINE, PAPER, static
from scipy.optimize import minimize

import gbid
from gbid.control import (
    close_loop,
    disk_margin,
    disk_margins_by_loop,
    exact_plant,
    loop_margins,
    p_controller,
    slow_poles,
    static_amplification,
)
from gbid.control.loop.close import static_force_gain
from gbid.control.loop.sensitivity import static_stiffness_ratio
from gbid.core.errors import UsageError
from gbid.structure import LinearModel

PLANT = MACHINE.plant_at(6, 0)
TRIPLE = LinearModel([[-1, 0, 0], [1, -1, 0], [0, 1, -1]], [[1], [0], [0]], [[0, 0, 1]], [[0]])  # 1/(s + 1)^3


def test_margins_of_a_triple_lag() -> None:
    k = 2.0
    (margins,) = loop_margins(gbid.sensitivities(TRIPLE, static(-k)))
    w = np.sqrt(k ** (2 / 3) - 1)
    phase = np.pi - 3 * np.arctan(w)
    assert margins.gain == pytest.approx((0.0, 8 / k), rel=1e-9)
    assert margins.phase_deg == pytest.approx(np.degrees(phase), rel=1e-9)
    assert margins.delay_s == pytest.approx(phase / w, rel=1e-9)


def test_lower_gain_margin() -> None:
    """An unstable plant 2/(s - 1) under -1: stable from half the gain on."""
    plant = LinearModel([[1.0]], [[2.0]], [[1.0]], [[0.0]])
    (margins,) = loop_margins(gbid.sensitivities(plant, static(-1.0)))
    assert margins.gain == pytest.approx((0.5, np.inf))


def test_classical_margins_are_where_the_published_loop_becomes_unstable() -> None:
    for i, margin in enumerate(loop_margins(gbid.sensitivities(PLANT, PAPER))):
        for factor, stable in ((0.999 * margin.gain[1], True), (1.001 * margin.gain[1], False)):
            gains = np.array([1.125, 0.99])
            gains[i] *= factor
            assert close_loop(PLANT, p_controller(*gains)).is_stable() is stable


def test_delay_margin_of_the_published_loop() -> None:
    """The extra delay in one axis, as an exact delay, tips stability judged by high Pade orders."""
    plant = exact_plant(MACHINE, 6, 0)
    margins = loop_margins(gbid.sensitivities(plant, PAPER), "input")
    assert plant.delay is not None
    for i, margin in enumerate(margins):
        for factor, stable in ((0.995, True), (1.005, False)):
            delay = np.array(plant.delay)
            delay[i] += factor * margin.delay_s
            delayed = replace(plant, delay=delay)
            assert close_loop(gbid.structure.with_pade(delayed, 12), p_controller(1.125, 0.99)).is_stable() is stable


def test_disk_margin_of_a_lag_by_python_control() -> None:
    control = pytest.importorskip("control")
    loop = gbid.sensitivities(TRIPLE, static(-2.0))
    L = control.ss(TRIPLE.A, TRIPLE.B, 2.0 * TRIPLE.C, TRIPLE.D)
    alpha, gain, phase = control.disk_margins(L, np.linspace(0.5, 2.5, 4001))
    margin = disk_margin(loop)
    assert margin.alpha == pytest.approx(float(alpha), rel=1e-7)
    assert margin.phase_deg == pytest.approx(float(phase), rel=1e-7)
    assert 20 * np.log10(margin.gain[1]) == pytest.approx(float(gain), rel=1e-7)
    assert disk_margins_by_loop(loop)[0].alpha == pytest.approx(margin.alpha)


@pytest.mark.parametrize("at", ["output", "input"])
def test_no_change_inside_the_disk_breaks_the_loop_and_one_on_its_border_does(at: str) -> None:
    loop = gbid.sensitivities(PLANT, PAPER)
    margin = disk_margin(loop, at)  # type: ignore[arg-type]
    L = PLANT.frequency_response(margin.frequency_hz)[0], PAPER.frequency_response(margin.frequency_hz)[0]
    L = L[0] @ L[1] if at == "output" else L[1] @ L[0]
    theta = np.linspace(0, 2 * np.pi, 181)
    grid = np.stack(np.meshgrid(theta, theta, indexing="ij"), axis=-1).reshape(-1, 2)

    def distance(size: float) -> float:
        def determinant(angles: np.ndarray) -> np.ndarray:
            delta = size * np.exp(1j * angles)
            change = (1 + delta / 2) / (1 - delta / 2)
            return np.abs(np.linalg.det(np.eye(2) - L * change[..., None, :]))

        start = grid[determinant(grid).argmin()]
        return float(minimize(determinant, start, method="Nelder-Mead", options={"xatol": 1e-10, "fatol": 1e-14}).fun)

    assert distance(margin.alpha) < 1e-7
    assert distance(0.99 * margin.alpha) > 1e-4
    low, high = margin.gain
    for x in (low, 1.0, high):
        for y in (low, 1.0, high):
            inside = 1 + 0.999 * (np.array([x, y]) - 1)
            assert close_loop(PLANT, p_controller(*(inside * [1.125, 0.99]))).is_stable()


def test_each_loop_alone_stands_more_than_both() -> None:
    loop = gbid.sensitivities(PLANT, PAPER)
    assert min(m.alpha for m in disk_margins_by_loop(loop)) >= disk_margin(loop).alpha


def test_at_rest() -> None:
    loop = gbid.sensitivities(PLANT, PAPER)
    S0 = np.linalg.inv(np.eye(2) - PLANT.static_gain() @ np.diag([1.125, 0.99]))
    assert static_amplification(loop) == pytest.approx(np.linalg.norm(S0, 2), rel=1e-12)
    k = MACHINE.key_parameters(6.0, 0.0)
    K = np.array([[k["k_xx"], k["k_xy"]], [k["k_yx"], k["k_yy"]]])
    compliance = -np.linalg.inv(K)
    np.testing.assert_allclose(static_force_gain(PLANT), compliance, rtol=1e-10)
    B = np.array([[k["b_xx"], k["b_xy"]], [k["b_yx"], k["b_yy"]]])
    piezo = np.diag([MACHINE.actuators["kappa_x"], MACHINE.actuators["kappa_y"]])
    softer = -np.linalg.inv(K + B @ piezo @ np.diag([1.125, 0.99]))  # K p + B u + f = 0, u = kappa r, r = K_pl p
    np.testing.assert_allclose(static_stiffness_ratio(loop), np.diag(compliance) / np.diag(softer), rtol=1e-9)


@pytest.mark.parametrize(("gains", "pairs"), [((2.1, 1.5), 0), ((1.9, 1.7), 1), ((2.0, 2.0), 0)])
def test_slow_poles_are_seen_as_real_ones_and_as_a_pair(gains: tuple[float, float], pairs: int) -> None:
    """Near static instability: a slow real pole, two that have met and left the axis, and one that grows."""
    slow = slow_poles(gbid.sensitivities(PLANT, p_controller(*gains)), 20.0)
    poles = close_loop(PLANT, p_controller(*gains)).poles()
    expected = [-p.real for p in poles if p.real > -2 * np.pi * 20 and p.imag >= 0]
    assert sum(p.real > -2 * np.pi * 20 and p.imag > 0 for p in poles) == pairs
    np.testing.assert_allclose(slow, np.sort(expected), rtol=1e-9)
    assert len(slow) > 0
    assert len(slow_poles(gbid.sensitivities(PLANT, PAPER))) == 0


def test_unstable_loop_has_no_margins() -> None:
    loop = gbid.sensitivities(PLANT, p_controller(2, 2))
    assert disk_margin(loop).alpha == 0.0
    assert loop_margins(loop)[0].gain == (1.0, 1.0)


def test_bad_input() -> None:
    loop = gbid.sensitivities(PLANT, PAPER)
    with pytest.raises(UsageError, match="choose 'output' or 'input'"):
        disk_margins_by_loop(loop, "middle")  # type: ignore[arg-type]
    with pytest.raises(UsageError, match="is not a position whose velocity is a state"):
        static_stiffness_ratio(gbid.sensitivities(TRIPLE, static(-2.0)))


def chain(poles, integrators, sample_time=None):
    """Gain over real poles and integrators, with a random zero where it has two poles or more."""
    n = len(poles) + integrators
    A = np.diag([*poles, *(integrators * [0.0 if sample_time is None else 1.0])]) + np.diag(np.ones(n - 1), -1)
    return LinearModel(A, np.eye(n)[:, :1], np.eye(n)[-1:], [[0.0]], dt=sample_time)


def random_loop(rng):
    """Return a stable loop of one channel with up to three integrators, continuous or sampled, from random draws."""
    while True:
        sample_time = None if rng.random() < 0.5 else 0.1
        rates = rng.uniform(0.2, 20, rng.integers(1, 4))
        poles = -rates if sample_time is None else np.exp(-rates * 0.1)
        plant = chain(poles, int(rng.integers(0, 4)), sample_time)
        C = plant.C + rng.normal(size=plant.C.shape) * rng.uniform(0, 30)
        plant = replace(plant, C=C, D=[[rng.choice([0.0, 0.0, rng.normal()])]])
        controller = static(rng.normal() * 10.0 ** rng.uniform(-2, 2))
        controller = replace(controller, dt=sample_time) if sample_time else controller
        try:
            if close_loop(plant, controller).is_stable():
                return plant, controller
        except UsageError:  # no loop: 1 = D K
            continue


def is_stable(plant, controller, factor):
    return close_loop(plant, replace(controller, D=factor * controller.D)).is_stable()


@pytest.mark.parametrize("seed", range(200))
def test_gain_limits_are_those_of_the_eigenvalues(seed) -> None:
    plant, controller = random_loop(np.random.default_rng(seed))
    ((low, high),) = (margins.gain for margins in loop_margins(gbid.sensitivities(plant, controller)))
    assert 0 <= low < 1 <= high
    inside = np.geomspace(max(1.0001 * low, 1e-3), min(0.9999 * high, 1e3), 25)
    assert all(is_stable(plant, controller, factor) for factor in inside)
    assert low == 0 or not is_stable(plant, controller, 0.9999 * low)
    assert high == np.inf or not is_stable(plant, controller, 1.0001 * high)


def test_an_integrator_puts_no_lower_limit() -> None:
    """2/(s (s + 1)(s + 2)) is stable up to three times its gain, 10/(s (s + 5)) at any."""
    for model, limit in ((chain([-1.0, -2.0], 1), 3.0), (chain([-5.0], 1), np.inf)):
        (margins,) = loop_margins(gbid.sensitivities(model, static(-2.0 if limit == 3.0 else -10.0)))
        assert margins.gain == pytest.approx((0.0, limit), rel=1e-9)
