"""Unstable plants: shooting windows bounded by growth, standard deviations by windows, gains that stabilise."""

import numpy as np
import pytest
from scipy.linalg import expm, solve_discrete_are
from start_problems import MAGLEV, START_PROBLEMS, start_problem

from gbid import Recording, fit
from gbid.identify.uncertainty import covariance as module
from gbid.structure import LinearStructure, Parameter, evaluate


def test_magnetic_levitation_from_its_truth_has_windows_that_contain_a_tenfold_growth():
    problem = start_problem("maglev")
    result = fit(problem.structure, problem.recording, start=MAGLEV, **problem.options)
    assert result.success
    pole = np.linalg.eigvals(result.model.A).real.max()
    assert pole == pytest.approx(40.0, rel=0.01)
    assert np.exp(pole * problem.recording.sample_time * result.options.window) <= 10.1
    away = [(result.parameters[name] - v) / result.std[name] for name, v in MAGLEV.items()]
    assert np.isfinite(list(result.std.values())).all()
    assert np.abs(away).max() < 4
    assert result.trusted == "white"


def test_a_disturbance_gain_that_does_not_stabilise_is_replaced_by_that_of_an_observer():
    problem = start_problem("pendulum")
    none = {"g1": 0.0, "g2": 0.0}
    result = fit(problem.structure, problem.recording, start=none)
    assert result.success
    for name, value in problem.true.items():
        assert abs(result.parameters[name] - value) < 4 * result.std[name]
    begin = evaluate(problem.structure, result.start)
    assert np.linalg.eigvals(begin.A - begin.K @ begin.C).real.max() < 0
    assert any("steady observer" in note for note in result.notes)


@pytest.mark.parametrize(
    ("name", "more"),
    [
        ("spring", {}),
        ("two_masses", {"initial_state": "zero"}),
        ("cross_coupled", {"trend": "offset"}),
        ("delayed_mode", {}),
    ],
)
def test_covariance_by_windows_is_that_of_whole_records(name, more, monkeypatch):
    """For a stable model both exist, and are equal."""
    problem = start_problem(name)
    h = problem.recording.sample_time
    two = [problem.recording, problem.recording.slice(0, 900)]
    two[1] = type(two[1])(two[1].signals, h, name="short")
    options = {"start": problem.true, **problem.options, **more}
    complete = fit(problem.structure, two, **options)
    monkeypatch.setattr(module, "grows", lambda *_: True)
    by_windows = fit(problem.structure, two, **options)
    assert by_windows.covariance_white == pytest.approx(complete.covariance_white, rel=1e-6)
    assert [by_windows.std[n] for n in complete.free] == pytest.approx(
        [complete.std[n] for n in complete.free], rel=1e-6
    )


@pytest.mark.parametrize("count", [4, pytest.param(12, marks=pytest.mark.slow)])
def test_scatter_of_an_unstable_plant_is_that_of_its_standard_deviations(count):
    """Several recordings: the squares of deviations over standard deviations have a mean of one."""
    squares = []
    for seed in range(count):
        problem = START_PROBLEMS["maglev"](np.random.default_rng(seed), n=1500)
        result = fit(problem.structure, problem.recording, start=MAGLEV, max_iterations=40, **problem.options)
        assert result.success
        away = np.array([result.parameters[name] - MAGLEV[name] for name in result.free])
        squares.append(away @ np.linalg.solve(result.covariance_white, away))
    mean, n = np.mean(squares), len(MAGLEV)
    assert abs(mean - n) < 4 * np.sqrt(2 * n / len(squares))


def held(seed, n=1500, h=0.02):
    """An unstable plant of third order, held by a state feedback of its Kalman filter: innovations form, by scipy."""
    random = np.random.default_rng(seed)
    w, z = random.uniform(2, 6), random.uniform(0.02, 0.3)
    unstable = [random.uniform(0.5, 3), -random.uniform(1, 5)], [complex(z * w, w), complex(z * w, -w)]
    a = np.real(np.poly([*unstable[seed % 2], -random.uniform(3, 8)]))[1:]
    at = {"a0": a[0], "a1": a[1], "a2": a[2], "b": random.uniform(2, 10)}
    A, B = np.array([[0, 1, 0], [0, 0, 1], -a[::-1]]), np.array([[0], [0], [at["b"]]])
    step = expm(h * np.block([[A, B], [np.zeros((1, 4))]]))
    F, G, C = step[:3, :3], step[:3, 3:], np.eye(1, 3)
    P, S = (solve_discrete_are(*each) for each in ((F, G, np.diag([1, 0.1, 0.01]), 0.1), (F.T, C.T, KNOWN, 1e-3)))
    law, gain = np.linalg.solve(0.1 + G.T @ P @ G, G.T @ P @ F), F @ S @ C.T / (C @ S @ C.T + 1e-3)
    w, x, rows = np.repeat(random.choice([-1.0, 1.0], n // 15), 15), np.zeros((3, 1)), []
    for k in range(n):
        e = 0.03 * random.normal()
        u = w[k] - (law @ x).item()
        rows.append((u, x[0, 0] + e))
        x = F @ x + G * u + gain * e
    u, y = np.array(rows).T
    return Recording({"u": u, "y": y}, h, name=f"held {seed}"), at


KNOWN = np.diag([1e-4, 1e-3, 1e-2])


@pytest.mark.parametrize(
    "seeds", [(0, 10, 17, 29), pytest.param(range(30), marks=pytest.mark.slow)], ids=["few", "many"]
)
def test_a_gain_of_an_observer_at_the_start_values_starts_plants_of_third_order(seeds):
    failed = []
    for seed in seeds:
        recording, at = held(seed)
        random = np.random.default_rng(1000 + seed)
        plant = LinearStructure(
            "third order",
            [
                *(Parameter(name, value * np.exp(random.uniform(-0.5, 0.5))) for name, value in at.items()),
                *(Parameter(f"k{i}", 0.0) for i in range(3)),
            ],
            lambda p: {
                "A": [[0, 1, 0], [0, 0, 1], [-p.a2, -p.a1, -p.a0]],
                "B": [[0], [0], [p.b]],
                "C": [[1, 0, 0]],
                "K": [[p.k0], [p.k1], [p.k2]],
            },
        )
        result = fit(plant, recording)
        away = [abs(result.parameters[name] - value) / result.std[name] for name, value in at.items()]
        if not (result.success and max(away) < 4.5):
            failed.append((seed, str(result.status), away))
    assert not failed
