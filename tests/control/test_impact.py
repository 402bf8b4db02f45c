"""Impact responses: closed form, an independent integrator, and the travel of the piezos."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import gbid
from gbid.control import HalfSine, close_loop, exact_plant, impact_response, p_controller
from gbid.control.impact.measured import force_response
from gbid.control.loop.close import force_entry
from gbid.core.errors import UsageError
from gbid.structure import LinearModel, PiezoPair, evaluate

MACHINE = gbid.load_model("theisen2016")
PLANT = MACHINE.plant_at(6, 0)
HIT = HalfSine(mass_kg=2.18)
PAPER = p_controller(1.125, 0.99)
ACTUATORS = evaluate(PiezoPair(), MACHINE.actuators)


def oscillator(w: float, zeta: float) -> LinearModel:
    return LinearModel([[0, 1], [-(w**2), -2 * zeta * w]], [[0], [1]], [[1, 0]], [[0]])


def test_undamped_oscillator_in_closed_form() -> None:
    """After a half-sine of length T: amplitude (F/m) 2 a cos(w T/2)/(w (a^2 - w^2)), a = pi/T."""
    w, T, m = 2 * np.pi * 130.0, 3e-3, 2.5
    response = impact_response(oscillator(w, 1e-6), impact=HalfSine(8.0, T, m), duration_s=0.1)
    a = np.pi / T
    expected = abs(8.0 / m * 2 * a * np.cos(w * T / 2) / (w * (a**2 - w**2)))
    assert response.peak_p_m == pytest.approx(expected, rel=1e-4)
    delayed = response.time_s > 0.05
    assert response.p[delayed].max() == pytest.approx(expected, rel=1e-3)
    assert response.decay_time_s == np.inf


def test_decay_time_of_a_short_impact() -> None:
    """The envelope e^(-zeta w t) of a lightly damped oscillator falls below 5 % of the first peak."""
    w, zeta = 2 * np.pi * 100.0, 0.02
    response = impact_response(oscillator(w, zeta), impact=HalfSine(1.0, 1e-4, 1.0))
    exact = (np.log(1 / 0.05)) / (zeta * w) + 0.25 / 100  # from the peak, a quarter of a period after the impact
    assert response.decay_time_s == pytest.approx(exact, abs=0.5 / 100)


def test_published_loop_against_an_adaptive_integrator() -> None:
    impact = HalfSine(15.0, 1.5e-3, 3.0, direction_deg=30.0)
    response = impact_response(PLANT, PAPER, impact, actuators=ACTUATORS, duration_s=0.02)
    A = close_loop(PLANT, PAPER).A
    E = np.zeros(len(A))
    E[6], E[7] = np.cos(np.pi / 6), np.sin(np.pi / 6)  # states: four of the actuators, p_x, p_y, their velocities

    def slope(t: float, x: np.ndarray) -> np.ndarray:
        force = 15.0 * np.sin(np.pi * t / 1.5e-3) if t <= 1.5e-3 else 0.0
        return A @ x + E * force / 3.0

    first = solve_ivp(slope, (0, 1.5e-3), np.zeros(len(A)), "DOP853", rtol=1e-11, atol=1e-18, dense_output=True)
    second = solve_ivp(slope, (1.5e-3, 0.02), first.y[:, -1], "DOP853", rtol=1e-11, atol=1e-18, dense_output=True)
    x = np.where(response.time_s <= 1.5e-3, first.sol(response.time_s), second.sol(response.time_s)).T
    scale = np.abs(x[:, 4:6]).max()
    np.testing.assert_allclose(response.p, x[:, 4:6], rtol=0, atol=1e-8 * scale)
    np.testing.assert_allclose(response.r, x[:, 10:12] * [1.125, 0.99], rtol=0, atol=1e-8 * scale)
    np.testing.assert_allclose(response.u, x[:, [1, 3]], rtol=0, atol=1e-8 * scale)
    assert response.peak_r_m == pytest.approx(np.abs(response.r).max(), rel=1e-5)
    assert response.stack_travel_m == max(response.peak_r_m, response.peak_u_m / 2)


def test_feedback_shortens_the_ring_down() -> None:
    """Figs. 22 and 23: the impact does much the same, and rings down far faster."""
    for direction in (0.0, 90.0):
        impact = HalfSine(mass_kg=2.18, direction_deg=direction)
        opened, closed = impact_response(PLANT, impact=impact), impact_response(PLANT, PAPER, impact)
        assert closed.peak_p_m == pytest.approx(opened.peak_p_m, rel=0.2)
        assert closed.decay_time_s < opened.decay_time_s / 5
        bearing = impact_response(MACHINE.at(6, 0), impact=impact)
        np.testing.assert_allclose(bearing.p, opened.p, rtol=0, atol=1e-9 * opened.peak_p_m)


def test_travel_is_flagged_where_it_ends() -> None:
    small = impact_response(PLANT, PAPER, HalfSine(10.0, mass_kg=2.18), piezo_travel_m=45e-6)
    assert not small.exceeds_travel
    force = 10.0 * small.travel_limit_m / small.stack_travel_m
    assert small.travel_limit_m == 22.5e-6
    assert not impact_response(PLANT, PAPER, HalfSine(0.999 * force, mass_kg=2.18), piezo_travel_m=45e-6).exceeds_travel
    assert impact_response(PLANT, PAPER, HalfSine(1.001 * force, mass_kg=2.18), piezo_travel_m=45e-6).exceeds_travel


def test_unstable_loop_ends_in_infinity() -> None:
    response = impact_response(PLANT, p_controller(2, 2), HalfSine(mass_kg=2.18), piezo_travel_m=45e-6)
    assert response.peak_p_m == response.decay_time_s == np.inf
    assert response.exceeds_travel


def test_force_entry_finds_the_velocities() -> None:
    for model, rows in (
        (PLANT, (6, 7)),
        (MACHINE.at(5, 0, pade_order=3), (2, 3)),
        (exact_plant(MACHINE, 6, 0), (6, 7)),
    ):
        E = force_entry(model)
        assert [tuple(i) for i in np.argwhere(E)] == [(rows[0], 0), (rows[1], 1)]
        assert set(E.ravel()) == {0.0, 1.0}


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: HalfSine(peak_n=0.0), "peak_n = 0.0; give a number above 0"),
        (lambda: HalfSine(mass_kg=np.nan), "mass_kg = nan; give a number above 0"),
        (lambda: HalfSine(direction_deg=np.inf), "direction_deg = inf"),
        (lambda: impact_response(exact_plant(MACHINE, 6, 0), PAPER), "has exact delays; replace them first"),
        (lambda: impact_response(PLANT, PAPER), "the moving mass is not known; give mass_kg"),
        (
            lambda: impact_response(PLANT, PAPER, HalfSine(mass_kg=2.18), piezo_travel_m=0.0),
            "piezo_travel_m = 0.0; give a positive",
        ),
        (
            lambda: impact_response(PLANT, PAPER, HalfSine(mass_kg=2.18), entry=np.zeros((3, 2))),
            "entry has 3 rows for the 10 states",
        ),
        (lambda: force_entry(ACTUATORS), "is not a position whose velocity is a state"),
        (lambda: force_entry(PLANT.discretise(1e-4)), "it is sampled; give the continuous model"),
    ],
)
def test_bad_input(make: object, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        make()  # type: ignore[operator]


def test_a_loop_on_its_limit_has_no_response_to_compare_with() -> None:
    """A free mass, p'' = f: its eigenvalues are one exactly."""
    free = LinearModel(
        np.block([[np.zeros((2, 2)), np.eye(2)], [np.zeros((2, 4))]]), np.zeros((4, 2)), np.eye(2, 4), np.zeros((2, 2))
    )
    with pytest.raises(UsageError, match="unstable"):
        force_response(free, None, (), 10, 2e-4, entry=np.eye(4)[:, 2:])
