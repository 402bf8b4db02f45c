"""What the solver is watched for: steps in standard deviations, when to stop, when to change the method."""

import numpy as np
import pytest
from small_problem import small_problem

from gbid.identify import FitStatus
from gbid.identify.options import FitArguments
from gbid.identify.problem.solve import TOLERANCES, Interrupt, Watch, _iterations_ahead


@pytest.fixture(scope="module")
def small():
    problem, unknowns, _, slopes, errors = small_problem()
    own, e = slopes[0], errors[0]
    best = np.array([2.0, 0.0]) + np.linalg.lstsq(own, e, rcond=None)[0]
    return problem, unknowns, problem.pack(best[:1], best[1:, None]), own, e


def watched(problem, *, stop="tolerance", interrupt=None, progress=None, **options):
    free = np.full(problem.n_unknowns, np.inf)
    return Watch(
        problem, FitArguments(stop=stop, progress=progress), interrupt or Interrupt(), (-free, free), **options
    )


def shown(watch, problem, x):
    """Show the watch an iterate, as IPOPT does; return whether it stops the solver."""
    at = problem.at(x)
    return watch.look(at.cost, x, at.gaps)


def test_a_step_is_measured_in_standard_deviations(small):
    """One of the gain, the initial state known: ``rms(e) / sqrt(sum psi^2)``."""
    problem, _, best, own, _ = small
    seen = []
    watch = watched(problem, progress=seen.append)
    at = problem.at(best)
    rms = np.sqrt(float(sum(s.error_products for s in at.sweeps)[0, 0]) / problem.n_samples)
    std = rms / np.linalg.norm(own[:, 0])
    before = best - np.array([3 * std / problem.theta_scale[0], 0.0])
    shown(watch, problem, before)
    shown(watch, problem, best)
    assert seen[0].sigma == np.inf  # there is no step yet
    assert seen[1].sigma == pytest.approx(3.0, rel=1e-6)
    assert seen[1].step == pytest.approx(3 * std / (best[0] * problem.theta_scale[0]), rel=1e-6)
    assert [p.iteration for p in seen] == [0, 1]
    assert seen[1].cost == at.cost


def test_iterations_ahead_are_those_of_a_geometric_series():
    assert _iterations_ahead(1e-2, 1e-1) == pytest.approx(2)  # 1e-3, 1e-4
    assert _iterations_ahead(1.0, 10.0) == pytest.approx(4)
    assert _iterations_ahead(1e-5, 1e-1) == 0
    assert _iterations_ahead(1.0, 1.0) == np.inf
    assert _iterations_ahead(2.0, 1.0) == np.inf


def moved(best, problem, own, sigmas):
    """Points of the gain that lie so many standard deviations off the best one."""
    at = problem.at(best)
    rms = np.sqrt(float(sum(s.error_products for s in at.sweeps)[0, 0]) / problem.n_samples)
    scale = rms / np.linalg.norm(own[:, 0]) / problem.theta_scale[0]
    return [best + np.array([s * scale, 0.0]) for s in sigmas]


def test_rest_is_two_small_steps_where_nothing_is_to_gain(small):
    problem, _, best, own, _ = small
    watch = watched(problem)
    points = moved(best, problem, own, [1e-1, 1e-3, 1e-5])
    assert [shown(watch, problem, x) for x in points] == [False, False, False]  # 0.1, 1e-3: the last is still too long
    assert shown(watch, problem, best)
    assert watch.status is FitStatus.CONVERGED


def test_one_small_step_by_chance_is_no_rest(small):
    problem, _, best, own, _ = small
    watch = watched(problem)
    points = moved(best, problem, own, [5.0, 1e-5, 0.0])
    assert not any(shown(watch, problem, x) for x in points[:2])
    assert not shown(watch, problem, points[2])  # small now, but the step before was of five
    assert watch.status is not FitStatus.CONVERGED


def test_standing_still_off_the_minimum_is_stuck_not_at_rest(small):
    """A solver with a wrong Hessian takes small steps where Gauss-Newton would take a long one."""
    problem, _, best, own, _ = small
    watch = watched(problem)
    points = moved(best, problem, own, [4 + 1e-5 * k for k in range(TOLERANCES.patience + 3)])
    stops = [shown(watch, problem, x) for x in points]
    assert watch.status is not FitStatus.CONVERGED
    assert watch.status is FitStatus.STEPS_TOO_SMALL
    assert stops.index(True) == TOLERANCES.patience + 1  # the first step has none before it to go by


def test_the_papers_rule_is_the_relative_change(small):
    problem, _, best, *_ = small
    watch = watched(problem, stop="paper")
    points = [best * np.array([1 + d, 1.0]) for d in (3e-3, 1.5e-4, 0.6e-4)]
    assert [shown(watch, problem, x) for x in points] == [False, False, True]  # 2.85e-3, then 0.9e-4
    assert watch.status is FitStatus.CONVERGED_BY_PAPER_RULE


def test_creeping_calls_for_the_other_method_only_where_there_is_one(small):
    problem, _, best, own, _ = small
    for changes in (True, False):
        watch = watched(problem, changes_over=changes)
        points = moved(best, problem, own, [10.0, 1.0, -6.0])  # steps of 9 and 7: dozens of such lie ahead
        assert [shown(watch, problem, x) for x in points] == [False, False, changes]
        assert watch.creeping is changes


def test_ctrl_c_stops_and_earlier_iterations_are_counted_on(small):
    problem, unknowns, best, *_ = small
    first = watched(problem)
    shown(first, problem, unknowns)
    shown(first, problem, best)
    interrupt, seen = Interrupt(), []
    second = watched(problem, earlier=first.history, interrupt=interrupt, progress=seen.append)
    assert not shown(second, problem, best)  # where the first ended: not told twice
    assert not shown(second, problem, best * 1.001)
    assert [p.iteration for p in seen] == [2]
    interrupt.error = KeyboardInterrupt()
    assert shown(second, problem, best)
