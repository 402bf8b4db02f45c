"""Start of nonlinear fits: none leaves the truth, is worse than its start, or ends elsewhere with success."""

import numpy as np
import pytest

import gbid
from gbid import NonlinearStructure, Parameter, Recording
from gbid.identify.options import FitArguments
from gbid.identify.pose import pose
from gbid.identify.problem.hessian import simulated
from gbid.identify.result import FitStatus

NAMES = ("k", "d", "c", "g")
STRUCTURE = NonlinearStructure(
    "duffing",
    [Parameter(name, 1.0, lower=0.0 if name in "kd" else -np.inf) for name in NAMES],
    ["x", "v"],
    lambda x, u, p: [x[1], p.g * u[0] - p.d * x[1] - p.k * x[0] - p.c * x[0] ** 3],
    lambda x, _u, _p: x[0],
)
STIFFENING = (100.0, 1.0, 500.0, 50.0)


def motion(truth, u, sample_time, start=(0.0, 0.0), substeps=20):
    """Response of a mass on a stiffening spring by many Runge-Kutta steps in a sample."""
    k, d, c, g = truth
    x, h, y = np.array(start), sample_time / substeps, []

    def slope(x, force):
        return np.array([x[1], g * force - d * x[1] - k * x[0] - c * x[0] ** 3])

    for force in u:
        y.append(x[0])
        for _ in range(substeps):
            k1 = slope(x, force)
            k2 = slope(x + h / 2 * k1, force)
            k3 = slope(x + h / 2 * k2, force)
            x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + slope(x + h * k3, force))
    return np.array(y)


def measured(seed, truth=STIFFENING, n=1000):
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.normal(size=n // 10 + 1), 10)[:n]
    y = motion(truth, u, 0.02) + 0.01 * rng.normal(size=n)
    return Recording({"u": u[:, None], "y": y[:, None]}, 0.02, name="duffing")


def far_start(seed):
    rng = np.random.default_rng(1000 + seed)
    off = rng.uniform(0.2, 0.65, 4) * rng.choice([-1, 1], 4)
    return dict(zip(NAMES, np.array(STIFFENING) * (1 + off), strict=True))


def right(result, truth=STIFFENING):
    off = [(result.parameters[name] - v) / result.std[name] for name, v in zip(NAMES, truth, strict=True)]
    return result.success and np.abs(off).max() < 5


@pytest.mark.parametrize("seed", range(4))
def test_a_fit_stays_at_the_truth_and_comes_there_from_far(seed):
    recording = measured(seed)
    assert right(gbid.fit(STRUCTURE, recording, start=dict(zip(NAMES, STIFFENING, strict=True))))
    assert right(gbid.fit(STRUCTURE, recording, start=far_start(seed)))


def test_a_long_record_of_a_sensitive_motion_is_found():
    truth, rng = (3000.0, 6.0, 4e6, 400.0), np.random.default_rng(0)
    u = np.repeat(rng.choice([-1.0, 1.0], 400), 25)
    y = motion(truth, u, 1e-3, substeps=10) + 1e-5 * rng.normal(size=len(u))
    recording = Recording({"u": u[:, None], "y": y[:, None]}, 1e-3, name="long")
    start = {"k": 2000.0, "d": 3.0, "c": 1e6, "g": 300.0}
    result = gbid.fit(STRUCTURE, recording, start=start, focus="simulation")
    assert right(result, truth), result.status


@pytest.mark.parametrize("most", [3, 100])
@pytest.mark.parametrize("window", ["auto", None, 64])
def test_no_result_is_worse_than_its_start_simulated(window, most):
    recording, begin = measured(0), far_start(0)
    result = gbid.fit(STRUCTURE, recording, start=begin, window=window, max_iterations=most)
    problem = pose(STRUCTURE, recording, FitArguments(start=begin)).problem(begin, 64)
    _, cost = simulated(problem.shooting, problem.unknowns)
    assert 0.5 * np.log(result.loss / np.mean(recording.signal("y") ** 2)) <= cost + 0.1
    if result.success:
        assert result.loss < 1.3e-4


def test_statuses_of_what_is_no_minimum_are_no_success():
    assert not FitStatus.WORSE_THAN_START.success
    assert not FitStatus.WINDOWS_DISAGREE.success
    assert FitStatus.CONVERGED_IN_WINDOWS.success


@pytest.mark.parametrize("trend", ["offset", "linear"])
def test_a_free_decay_has_trends(trend):
    truth = (40.0, 0.8, 60.0, 30.0)
    y = motion(truth, np.zeros(600), 0.02, (1.0, 0.0)) + 0.2 + 0.01 * np.random.default_rng(0).normal(size=600)
    decay = Recording({"y": y[:, None]}, 0.02, name="decay")
    fixed = {"g": 0.0}
    result = gbid.fit(STRUCTURE, decay, inputs=(), trend=trend, fixed=fixed, start={"k": 35.0, "c": 50.0})
    assert result.success
    assert abs(result.parameters["offset_y"] - 0.2) < 4 * result.std["offset_y"]
    for name, value in zip("kdc", truth[:3], strict=True):
        assert abs(result.parameters[name] - value) < 4 * result.std[name]
