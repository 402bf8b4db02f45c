"""A success is an estimate: finite, at rest, determined, and better than a constant."""

import warnings
from dataclasses import replace
from importlib import import_module

import numpy as np
import pytest
from fit_cases import MODE, MODE_AT, levels, simulated
from scipy.linalg import expm
from scipy.signal import lfilter
from start_problems import start_problem

from gbid import LinearStructure, Parameter, Recording, fit
from gbid.identify import FitStatus
from gbid.identify.options import FitArguments
from gbid.identify.pose import pose
from gbid.identify.predictor import Predictor
from gbid.identify.problem.solve import Watch, distance_from_rest, solve
from gbid.structure import evaluate

WILD = {"k": -1000.0, "d": -1.0}


def of_spring(**options):
    problem = start_problem("spring")
    return fit(problem.structure, problem.recording, focus="simulation", **options)


@pytest.fixture(scope="module")
def best():
    return of_spring()


@pytest.mark.parametrize("start", [WILD, {"d": -10.0}, {"k": -1e5, "d": -50.0}], ids=["k and d", "d", "far"])
def test_an_unstable_start_is_moved_to_a_stable_one_and_said(start, best):
    result = of_spring(start=start)
    assert result.success
    assert result.loss == pytest.approx(best.loss, rel=1e-6)
    assert result.notes[0] == (
        "the start values are unstable: the fit began at values of a fit with a steady observer (Kalman filter) [GB112]"
    )
    assert {result.start_origin[name] for name in start} == {"data"}
    assert np.linalg.eigvals(evaluate(start_problem("spring").structure, result.start).A).real.max() < 0


def test_an_unstable_start_in_windows_of_the_caller():
    result = of_spring(start=WILD, window=100)
    assert result.success
    assert result.options.window == 100


@pytest.mark.parametrize("start", [WILD, {"d": -10.0}, {"k": -1e4, "d": -50.0}], ids=["k and d", "d", "far"])
@pytest.mark.parametrize("window", [None, 100, "auto"])
def test_a_fit_that_stays_at_an_unstable_model_is_no_success_and_not_white(start, window, monkeypatch):
    """Where no observer can be found, what stays is a status; whiteness is not believed."""
    monkeypatch.setattr(import_module("gbid.identify.restarts"), "observer_start", lambda _: None)
    result = of_spring(start=start, window=window)
    variance = float(np.var(start_problem("spring").recording.signal("y")))
    assert result.success == (result.loss < variance and np.isfinite(list(result.std.values())).all())
    if result.loss > variance:
        assert not result.success
        assert result.trusted == "robust"
        assert "not converged" in result.status


def test_errors_larger_than_about_the_mean_are_no_success():
    rng = np.random.default_rng(0)
    y = 5.0 + rng.standard_normal((500, 1))
    recording = Recording({"u": rng.standard_normal((500, 1)), "y": y}, 0.1)
    problem = start_problem("lag")
    result = fit(problem.structure, recording, focus="simulation", fixed={"a": 3.0})
    assert result.status is FitStatus.WORSE_THAN_CONSTANT
    assert result.trusted == "robust"
    assert fit(problem.structure, recording, focus="simulation", fixed={"a": 3.0}, trend="offset").success


def test_an_undetermined_parameter_is_no_success_and_named():
    """Only the product of two gains acts."""
    lag = LinearStructure(
        "lag",
        [Parameter("a", 3.0), Parameter("g", 2.0), Parameter("h", 1.0)],
        lambda p: {"A": [[-p.a]], "B": [[p.g * p.h]], "C": [[1]]},
    )
    recording = start_problem("lag").recording
    result = fit(lag, recording, focus="simulation")
    assert result.status is FitStatus.NOT_DETERMINED
    assert any("do not determine g, h separately" in note for note in result.notes)
    assert fit(lag, recording, focus="simulation", fixed={"h": 1.0}).success


def test_a_parameter_on_a_bound_is_a_success_without_a_standard_deviation():
    result = of_spring(start={"d": 0.5}, bounds={"d": (0.0, 1.0)})
    assert result.success
    assert np.isnan(result.std["d"])


@pytest.mark.parametrize("name", ["spring", "spring_with_gain", "cross_coupled", "maglev", "free_decay"])
def test_optimality_is_zero_at_the_minimum_and_counts_standard_deviations(name):
    """Away from the minimum it is the distance to it, which is also found from the covariance."""
    problem = start_problem(name)
    result = fit(problem.structure, problem.recording, start=problem.true, **problem.options)
    task = pose(problem.structure, problem.recording, FitArguments(start=problem.true, **problem.options))
    problem_at_truth = task.problem(problem.true, result.options.window)
    shooting = problem_at_truth.shooting
    theta = np.array([result.parameters[name] for name in result.free])
    shift = 0.01 * np.sqrt(np.diag(result.covariance_white))
    first, _ = shooting.unpack(shooting.pack(theta, np.zeros((shooting.n_windows, shooting.n_states))))
    assert first == pytest.approx(theta)
    expected = np.sqrt(shift @ np.linalg.solve(result.covariance_white, shift))
    assert result.optimality < 0.01
    distance = _distance_when_moved(shooting, theta + shift)
    assert distance == pytest.approx(expected, rel=0.2)  # of the exact Hessian; the step is that of Gauss-Newton


def _distance_when_moved(shooting, theta):
    """Distance from rest with the window starts that are best at these parameters."""
    unknowns = shooting.pack(theta, np.zeros((shooting.n_windows, shooting.n_states)))
    lower, upper = (edge.copy() for edge in shooting.box)
    lower[: shooting.n_theta] = upper[: shooting.n_theta] = unknowns[: shooting.n_theta]
    return distance_from_rest(shooting, solve(replace(shooting, box=(lower, upper)), unknowns).unknowns)


def test_a_solution_that_has_not_come_to_rest_is_solved_on(best, monkeypatch):
    """A solver that takes the first step for rest is not believed."""
    calls, look = [], Watch.look

    def resting(self, *iterate):
        calls.append(1)
        ended = look(self, *iterate)
        self.status = FitStatus.CONVERGED if len(calls) == 2 else self.status
        return ended or len(calls) == 2

    monkeypatch.setattr(Watch, "look", resting)
    result = of_spring(start={"k": 1500.0})
    assert result.success
    assert result.optimality < 0.1
    assert result.loss == pytest.approx(best.loss)


# ---- callbacks ----


@pytest.mark.parametrize("start", [{"k": 1e12, "d": -3.0}, WILD])
def test_nothing_is_printed_and_overflows_are_one_note(start, capfd):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        result = of_spring(start=start, max_iterations=2)
    assert capfd.readouterr() == ("", "")
    assert sum("overflows at" in note for note in result.notes) <= 1


def test_points_without_a_value_are_counted(monkeypatch):
    original, calls = Predictor.at, []

    def at(self, theta):
        calls.append(1)
        if len(calls) in (8, 9):
            raise OverflowError("cannot convert float infinity to integer")
        return original(self, theta)

    monkeypatch.setattr(Predictor, "at", at)
    result = of_spring(start={"k": 1100.0})
    assert result.success
    assert any("overflows at" in note and "of the points that the solver tried" in note for note in result.notes)


def test_a_defect_in_a_callback_is_raised(monkeypatch):
    original, calls = Predictor.at, []

    def at(self, theta):
        calls.append(1)
        if len(calls) == 8:
            raise TypeError("a defect")
        return original(self, theta)

    monkeypatch.setattr(Predictor, "at", at)
    with pytest.raises(TypeError, match="a defect"):
        of_spring(start={"k": 1100.0})


def with_runout(size, seed=0, n=5000, h=2e-4):
    """A mode of 130 Hz, seen by a sensor with run-out at 6000 rpm: exact steps, without gbid."""
    random = np.random.default_rng(seed)
    u, w = np.repeat(random.choice([-1.0, 1.0], n // 10), 10), 2 * np.pi * 130
    step = expm(h * np.array([[0, 1, 0], [-w * w, -60, w * w], [0, 0, 0]]))
    x, y = np.zeros(2), np.zeros(n)
    for i in range(n):
        y[i] = x[0]
        x = step[:2, :2] @ x + step[:2, 2] * u[i]
    seen = y + size * np.sin(2 * np.pi * 100 * h * np.arange(n) + 0.3) + 0.02 * random.normal(size=n)
    return Recording({"u": u, "y": seen}, h, name="run", conditions={"speed_rpm": 6000.0})


@pytest.mark.parametrize(("size", "success", "told"), [(0.0, True, False), (1.0, True, True), (20.0, False, True)])
def test_rotation_of_the_shaft_is_no_mode(size, success, told):
    """With run-out of 20 the fit converges to a mode of 100 Hz; of 1, from one of two starts."""
    mode = LinearStructure(
        "mode",
        [Parameter("k", 4e5), Parameter("d", 30.0), Parameter("b", 6e5)],
        lambda p: {"A": [[0, 1], [-p.k, -p.d]], "B": [[0], [p.b]], "C": [[1, 0]]},
        "u",
        "y",
    )
    result = fit(mode, with_runout(size), focus="simulation")
    frequency = result.model.modes()[0][0]
    assert result.success == success
    assert any("GB132" in note for note in result.notes) == told
    assert (abs(frequency - 130) < 1) == success
    if not success:
        assert result.status is FitStatus.SHAFT_AS_MODE
        assert abs(frequency - 100) < 0.1


# ---- Strongly coloured errors: whether there is a lower minimum is settled by a second start.


@pytest.mark.parametrize("seeds", [range(3), pytest.param(range(3, 100), marks=pytest.mark.slow)], ids=["few", "many"])
def test_coloured_errors_at_the_lowest_minimum_leave_no_doubt(seeds):
    fixed = {"l1": 0.0, "l2": 0.0}
    for seed in seeds:
        clean = simulated(MODE, MODE_AT, levels(600, seed=seed))
        errors = lfilter([1], [1, -0.9], np.random.default_rng(seed).normal(size=(600, 1)), axis=0)
        y = clean.signal("y")
        result = fit(MODE, clean.with_signals(y=y + 0.1 * y.std() * errors), focus="simulation", fixed=fixed)
        assert result.success
        assert result.parameters["w"] == pytest.approx(MODE_AT["w"], rel=0.05)
        assert "GB106" in " ".join(result.notes)
        assert "GB111" not in " ".join(result.notes)
