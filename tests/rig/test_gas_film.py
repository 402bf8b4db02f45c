"""Gas film of the rig: mass balance, known limits, linearisation against numeric differences, and time stepping."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.linalg import expm

import gbid
from gbid.core.errors import UsageError
from gbid.experiment.fields import ExperimentError
from gbid.experiment.load import load_experiment
from gbid.rig import (
    FilmPoint,
    GasFilm,
    Hammer,
    Impact,
    Machine,
    Prbs,
    RotorBearingTruth,
    SensorChain,
    Stationary,
    Unbalance,
    record,
)
from gbid.rig.film import AMBIENT_PA, GAS_CONSTANT, equilibrium, linearised

RPM = np.pi / 30
COARSE = GasFilm(around=24, along=4)
STILL, FREE = np.zeros(4), np.zeros(2)


def point(film: GasFilm = COARSE, pressure_bar: float = 6.0, speed: float = 6000 * RPM) -> FilmPoint:
    return FilmPoint(film, pressure_bar, speed, 25e-6, 2.18)


def quiet_machine(at: FilmPoint) -> Machine:
    none = np.zeros((2, 0))
    sensors = SensorChain(
        noise_p_m=(0.0, 0.0), noise_u_m=(0.0, 0.0), runout_amplitude_m=none, runout_phase_rad=none,
        offset_p_m=(0.0, 0.0), offset_u_m=(0.0, 0.0), resolution_p_m=0.0, resolution_u_m=0.0,
    )  # fmt: skip
    model = gbid.load_model("theisen2016")
    return Machine.from_parameters({}, model.actuators, Unbalance(0.0), sensors, film=at)


@cache
def gas(at: FilmPoint, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return a state far from rest and its rates."""
    state = equilibrium(at) * (
        1 + 0.1 * np.random.default_rng(seed).standard_normal(4 + at.film.around * at.film.along)
    )
    return state, at.rates(state, STILL, FREE)


def test_the_gas_that_stays_is_what_the_injectors_feed_less_what_leaves_at_the_ends():
    at = point()
    state, rates = gas(at, 1)
    film, (dx, dz) = at.film, at.steps
    theta = 2 * np.pi * np.arange(film.around) / film.around
    h = at.clearance - state[0] * np.cos(theta) - state[1] * np.sin(theta)
    p_end = state[4:].reshape(film.along, film.around)[-1] / h  # no injector reaches the last row
    leaves = np.sum(dx * h**3 / (24 * film.viscosity) * (p_end**2 - AMBIENT_PA**2) / dz)
    supply = AMBIENT_PA + 6e5
    area = np.pi * film.seat_diameter_m * film.opening_m * film.discharge
    rt = GAS_CONSTANT * film.temperature_k
    choked = np.sqrt(1.4 * (2 / 2.4) ** (2.4 / 0.4))  # the classical factor of a choked nozzle
    feeds = 4 * area * supply * choked / np.sqrt(rt) * rt / 2
    areas = np.repeat(np.r_[0.5, np.ones(film.along - 1)], film.around) * dx * dz
    mouths = state[4:].reshape(film.along, -1)[0, ::6]
    assert mouths.max() < 0.5 * supply * (h[::6] + 3e-3).max()  # all four injectors are choked
    assert areas @ rates[4:] == pytest.approx(feeds - leaves, rel=1e-9)


@pytest.mark.parametrize("kind", ["squeeze", "wedge"])
def test_a_film_without_feed_meets_the_analytic_limit_of_small_eccentricity(kind):
    """Incompressible, finite length, linear in the eccentricity: P'' - P/R^2 = const with P = 0 at the ends."""
    film = GasFilm(gravity=0.0, opening_m=1e-13, duct_length_m=0.0, around=48, along=8)
    speed = 5.0
    at = FilmPoint(film, 1e-3, speed, 25e-6, 2.18)
    stiffness, damping, _, _ = at.at_frequency(0.5)
    R, L, c = film.radius, film.length_m, at.clearance
    shape = np.pi * film.viscosity * R**2 / c**3 * (L - 2 * R * np.tanh(L / (2 * R))) / at.mass
    if kind == "squeeze":
        assert np.diag(damping) == pytest.approx([-12 * shape * R] * 2, rel=0.01)
    else:
        assert stiffness[1, 0] == pytest.approx(6 * shape * speed * R, rel=0.01)
        assert stiffness[0, 1] == pytest.approx(-6 * shape * speed * R, rel=0.01)


def test_quasi_static_stiffness_is_that_of_two_loads():
    at = point()
    loads = [equilibrium(replace(at, film=replace(COARSE, gravity=9.81 + more)))[:2] for more in (-0.05, 0.05)]
    shifted = (loads[1] - loads[0]) / 0.1
    stiffness = at.at_frequency(1e-3)[0]
    assert stiffness @ shifted == pytest.approx([0.0, 1.0], abs=1e-4)


def test_gains_of_the_injectors_are_the_slope_of_the_rates():
    at = point()
    state, B = equilibrium(at), linearised(at)[1]
    for column, pair in zip(B.T, ([0.0, 1.0, 0.0, -1.0], [1.0, 0.0, -1.0, 0.0]), strict=True):
        u = 1e-7  # each piezo of a pair goes half of it, one up and one down
        slope = (at.rates(state, u / 2 * np.array(pair), FREE) - at.rates(state, STILL, FREE)) / u
        assert column == pytest.approx(slope, rel=0.01, abs=1e-6 * np.abs(slope).max())


def test_finer_cells_move_the_modes_by_less_than_half_a_percent():
    """One cell per mouth gave 124.0, 122.1 and 128.8 Hz with 48, 60 and 96 cells around."""
    coarse, fine = (point(GasFilm(around=n, along=n // 6)).modes() for n in (48, 60))
    assert coarse[:, 0] == pytest.approx(fine[:, 0], rel=5e-3)
    assert coarse[:, 1] == pytest.approx(fine[:, 1], rel=0.04)


def test_small_motions_in_time_are_those_of_the_linearisation():
    at = point()
    A, _ = linearised(at)
    hammer = Hammer((Impact(time=0.01, peak=0.01),), duration_s=0.1)
    made = record(
        quiet_machine(at),
        hammer,
        conditions={"pressure_bar": 6.0, "speed_rpm": 6000.0},
        seed=1,
        name="hit",
        settle_s=0.0,
    )
    grid = np.arange(2 * 5 * 500 + 1) * 2e-5
    force = hammer.force(grid) / at.mass
    step = expm(A * 2e-5)
    drive = np.linalg.solve(A, step - np.eye(len(A)))[:, 2:4]
    state, held = np.zeros(len(A)), []
    for k in range(len(grid) - 1):
        held.append(state[:2])
        state = step @ state + drive @ (force[k] + force[k + 1]) / 2
    expected, p = np.array(held)[::10], made.signal("p")
    assert np.abs(expected).max() > 1e-9
    assert np.abs(p - expected).max() < 2e-3 * np.abs(expected).max()


def test_steps_are_of_second_order_and_a_still_rotor_rests():
    machine = quiet_machine(point())
    run = {"conditions": {"pressure_bar": 6.0, "speed_rpm": 6000.0}, "seed": 1, "name": "a", "settle_s": 0.0}
    still = record(machine, Stationary(duration_s=0.02), **run)
    assert np.abs(still.signal("p")).max() < 1e-12
    prbs = {n: record(machine, Prbs(duration_s=0.04), oversampling=n, **run).signal("p") for n in (20, 40, 160)}
    errors = [np.abs(prbs[n] - prbs[160]).max() for n in (20, 40)]
    assert errors[0] < 1e-10  # a five-hundredth of the noise of the probes
    assert errors[0] / errors[1] > 3  # 4 for second order, 2 for first


def test_the_linear_bearing_of_a_film_has_its_modes_only_nearly_and_the_recording_tells_no_truth():
    at = point()
    reduced = RotorBearingTruth.of_film(at)
    reduced.check_stable()
    made = record(quiet_machine(at), Stationary(duration_s=0.01), conditions={"speed_rpm": 6000.0}, seed=1, name="a")
    assert "truth" not in made.provenance
    assert "gas film" in quiet_machine(at).beyond_closed_form()


def test_an_unstable_film_and_one_that_does_not_carry_are_refused():
    with pytest.raises(UsageError, match="unstable"):
        replace(point(), film=replace(COARSE, duct_length_m=20e-3)).check_stable()
    with pytest.raises(UsageError, match="no state of rest"):
        equilibrium(replace(point(), film=replace(COARSE, gravity=500.0)))


def test_what_needs_fourteen_parameters_is_refused_with_a_film(tmp_path):
    path = tmp_path / "rig.yaml"
    path.write_text(
        "format: 1\nname: a\nrig:\n  operating_points: [{pressure_bar: 6.0, speed_rpm: 0}]\n"
        "  film: {around: 24, along: 4}\n  scatter: {}\n  stiffening: {}\n",
        encoding="utf-8",
    )
    with pytest.raises(ExperimentError) as caught:
        load_experiment(path)
    problems = " ".join(str(problem) for problem in caught.value.problems)
    assert "stiffening with a gas film" in problems
    assert "rig has a gas film" in problems
