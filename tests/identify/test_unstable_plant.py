"""Unstable plants: shooting windows bounded by growth, standard deviations by windows, gains that stabilise."""

import numpy as np
import pytest
from start_problems import MAGLEV, START_PROBLEMS, start_problem

from gbid import fit
from gbid.identify.uncertainty import covariance as module
from gbid.structure import evaluate


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
