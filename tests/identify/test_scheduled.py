"""Scheduled structures: against fits with constant parameters, an integration of its own, and polynomials by hand."""

from functools import cache, partial

import numpy as np
import pytest
from scipy.linalg import expm

import gbid
from gbid.core.errors import DataError, UsageError
from gbid.identify.pose import Search
from gbid.identify.start.scheduled_start import Courses
from gbid.structure.scheduling import Schedule

DT = 1e-3


def spring(p):
    return {"A": [[0, 1], [-p.k, -p.d]], "B": [[0], [p.b]], "C": [[1, 0]]}


BASE = gbid.LinearStructure(
    "spring", [gbid.Parameter("k", 5e3), gbid.Parameter("d", 8.0), gbid.Parameter("b", 5e3)], spring, "u", "y"
)


@cache
def ramp(noise: float = 1e-3, n: int = 1500) -> gbid.Recording:
    """A spring whose stiffness follows a gap that opens, by Runge-Kutta steps of a fifth of a sample."""
    random = np.random.default_rng(4)
    u = np.repeat(random.choice([-1.0, 1.0], n // 20), 20)
    gap = np.linspace(1.0, 3.0, n)
    y, x, v, h, per_s = np.zeros(n), 0.0, 0.0, DT / 5, float(gap[1] - gap[0]) / DT

    def force(held, t, x, v):
        return -(6000.0 - 800.0 * (1.0 + per_s * t)) * x - 8.0 * v + 5000.0 * held

    for i, held in enumerate(u.tolist()):
        y[i] = x
        for j in range(5):
            t = (i + j / 5) * DT
            a1, v1 = force(held, t, x, v), v
            a2, v2 = force(held, t + h / 2, x + h / 2 * v1, v + h / 2 * a1), v + h / 2 * a1
            a3, v3 = force(held, t + h / 2, x + h / 2 * v2, v + h / 2 * a2), v + h / 2 * a2
            a4, v4 = force(held, t + h, x + h * v3, v + h * a3), v + h * a3
            x, v = x + h / 6 * (v1 + 2 * v2 + 2 * v3 + v4), v + h / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
    signals = {"u": u, "y": y + noise * random.normal(size=n), "gap": gap}
    return gbid.Recording(signals, DT, name="ramp", units={"u": "N", "y": "m", "gap": "mm"})


def test_constant_surfaces_are_the_fit_with_constant_parameters():
    """Of order 0 the pieces share their parameters: nothing but the cuts differs from a usual fit."""
    plain = gbid.fit(BASE, ramp())
    result = gbid.fit(gbid.scheduled(BASE, "gap", order=0, piece_s=0.3), ramp())
    assert result.success
    assert result.schedule.pieces == 5
    for name in ("k", "d", "b"):
        assert result.parameters[f"{name}_0"] == pytest.approx(plain.parameters[name], abs=1e-4 * plain.std[name])
        assert result.std[f"{name}_0"] == pytest.approx(plain.std[name], rel=1e-4)
    np.testing.assert_allclose(result.model.modes(), plain.model.modes(), rtol=1e-5)
    np.testing.assert_allclose(result.modes_std, plain.modes_std, rtol=1e-3)


@cache
def run_up(seed: int) -> gbid.Recording:
    """A run-up of 2000 rpm/s in samples of 2 ms: the exponential of the time-varying equations in 16 parts of each."""
    n, dt, parts = 800, 2e-3, 16
    random = np.random.default_rng(seed)
    u = np.repeat(random.choice([-1.0, 1.0], n // 5), 5)
    speed, h = 2000.0 * dt * np.arange(n), dt / parts
    time = (np.arange((n - 1) * parts) + 0.5) * h
    stiffness = 4000.0 - 1200.0 * (2 * 2000.0 * time / speed[-1] - 1.0)
    generators = np.zeros((len(time), 3, 3))
    generators[:, 0, 1], generators[:, 1, 1], generators[:, 1, 2] = 1.0, -8.0, 4000.0 * np.repeat(u[:-1], parts)
    generators[:, 1, 0] = -stiffness
    state, y = np.array([0.0, 0.0, 1.0]), np.zeros(n)
    for i, steps in enumerate(expm(generators * h).reshape(n - 1, parts, 3, 3)):
        for step in steps:
            state = step @ state
        y[i + 1] = state[0]
    signals = {"u": u, "y": y + 0.01 * random.normal(size=n), "speed_rpm": speed}
    return gbid.Recording(signals, dt, name="run-up", units={"u": "N", "y": "m", "speed_rpm": "rpm"})


RUN_UP = {"k_0": 4000.0, "k_1": -1200.0, "d": 8.0, "b": 4000.0}


def run_up_fit(seed: int, piece_s: float) -> gbid.FitResult:
    structure = gbid.scheduled(BASE, "speed_rpm", surfaces=["k"], order=1, piece_s=piece_s)
    return gbid.fit(structure, run_up(seed), focus="simulation")


fine_fit = cache(partial(run_up_fit, piece_s=0.02))


@pytest.mark.parametrize("seeds", [1, pytest.param(3, marks=pytest.mark.slow)])
def test_course_is_seen_when_it_happens(seeds):
    """The mean of the samples of a piece alone is half a sample early: k_0 was some standard deviations off."""
    away = []
    for seed in range(seeds):
        result = fine_fit(seed)
        assert result.success
        away.append([(result.parameters[name] - true) / result.std[name] for name, true in RUN_UP.items()])
    assert np.abs(np.mean(away, axis=0)).max() < 3 / np.sqrt(len(away))
    assert np.sqrt(np.mean(np.square(away))) < 1.4


def test_pieces_are_cut_as_finely_as_the_estimates_need(monkeypatch):
    long, short = run_up_fit(0, 0.1), fine_fit(0)
    assert long.schedule.pieces > 100
    assert np.abs(long.integration_shift).max() < 0.1
    for name, true in RUN_UP.items():
        assert abs(long.parameters[name] - short.parameters[name]) < 0.2 * short.std[name]
        assert abs(long.parameters[name] - true) < 3 * long.std[name]
    monkeypatch.setattr("gbid.identify.pose.SEARCH", Search(most_slopes=48))
    coarse = run_up_fit(0, 0.1)
    assert coarse.schedule.pieces == 16
    assert np.abs(coarse.integration_shift).max() > 0.1
    assert any("GB131" in note for note in coarse.notes)


def test_pieces_are_cut_where_the_course_changes():
    values = np.concatenate([np.zeros(500), np.linspace(0.0, 1.0, 101), np.ones(500)])[:, None]
    schedule = Schedule(("gap",), (0.0,), (1.0,), ("k",), ((0,), (1,)), 11)
    courses = Courses(schedule, (values,), (tuple(range(100, 1100, 100)),))
    finer = courses.cut(max(courses.changes[0]) / 8)
    assert set(courses.edges[0]) < set(finer.edges[0])
    assert all(500 <= edge <= 601 for edge in set(finer.edges[0]) - set(courses.edges[0]))
    assert finer.schedule.pieces == len(finer.edges[0]) + 1 == 18
    np.testing.assert_allclose(np.array(courses.terms[0])[[0, 5, 10], 1], [-1.0, 0.0, 1.0], atol=1e-12)


def test_surface_of_a_ramp_is_found_whatever_the_length_of_a_piece():
    results = [
        gbid.fit(gbid.scheduled(BASE, "gap", surfaces=["k"], order=1, piece_s=piece), ramp()) for piece in (0.2, 0.05)
    ]
    for name, true in (("k_0", 4400.0), ("k_1", -800.0), ("d", 8.0), ("b", 5000.0)):
        for result in results:
            assert abs(result.parameters[name] - true) < 4 * result.std[name]


def test_coefficients_in_own_units_give_the_same_polynomial():
    exponents = gbid.scheduled(gbid.RotorBearing()).exponents
    schedule = Schedule(("pressure_bar", "speed_rpm"), (3.0, 500.0), (7.0, 6000.0), ("k",), exponents, 1)
    random = np.random.default_rng(1)
    coefficients, points = random.normal(size=6), random.uniform((3, 500), (7, 6000), (20, 2))
    P, W = points.T
    scaled = schedule.to_own_units @ coefficients
    by_hand = scaled[0] + scaled[1] * P + scaled[2] * W + scaled[3] * W * P + scaled[4] * P**2 + scaled[5] * W**2
    np.testing.assert_allclose(by_hand, schedule.terms(points) @ coefficients, rtol=1e-9, atol=1e-9)


def test_a_film_that_stiffens_is_refused():
    with pytest.raises(UsageError, match="stiffening"):
        gbid.scheduled(gbid.RotorBearing(film="stiffening"))


def test_what_courses_do_not_determine_is_named():
    with pytest.raises(DataError, match="neither a signal nor a condition 'speed'"):
        gbid.fit(gbid.scheduled(BASE, "speed"), ramp())
    still = gbid.Recording({**ramp().signals, "gap": np.ones(1500)}, DT, name="still")
    with pytest.raises(DataError, match="do not determine the 2 terms"):
        gbid.fit(gbid.scheduled(BASE, "gap", order=1), still)
    with pytest.raises(UsageError, match="surfaces: stiffness"):
        gbid.scheduled(BASE, "gap", surfaces=["stiffness"])


def test_result_of_a_schedule_is_no_model_of_a_recording():
    result = gbid.fit(gbid.scheduled(BASE, "gap", order=0, piece_s=0.3), ramp(), max_iterations=1)
    with pytest.raises(UsageError, match="middle of their range"):
        gbid.cross_validate(result, ramp())
    with pytest.raises(UsageError, match="fourteen key parameters"):
        gbid.lpv.lpv_of(result)
