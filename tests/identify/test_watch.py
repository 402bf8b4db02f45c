"""What the solver is watched for: steps in standard deviations, when to stop, when to change the method."""

import numpy as np
import pytest
from small_problem import small_problem

from gbid.identify import FitStatus
from gbid.identify.options import FitArguments
from gbid.identify.problem.solve import TOLERANCES, Interrupt, Watch


@pytest.fixture(scope="module")
def small():
    """A problem, its minimum, and the deviation of the gain with a known initial state: ``rms(e) / |psi|``."""
    problem, _, _, (psi,), (errors,) = small_problem()
    best = np.array([2.0, 0.0]) + np.linalg.lstsq(psi, errors, rcond=None)[0]
    best = problem.pack(best[:1], best[1:, None])
    squares = float(sum(s.error_products for s in problem.at(best).sweeps)[0, 0])
    std = np.sqrt(squares / problem.n_samples) / np.linalg.norm(psi[:, 0]) / problem.theta_scale[0]
    return problem, best, std


def off(best, std, sigmas):
    """Points of the gain that lie so many standard deviations off the best one."""
    return [best + np.array([sigma * std, 0.0]) for sigma in sigmas]


def watched(problem, points, *, interrupt=None, earlier=(), changes_over=False, **options):
    """A watch, and whether it ends the solver at each of the points, shown as IPOPT does."""
    free = np.full(problem.n_unknowns, np.inf)
    options = FitArguments(**options)
    interrupt = interrupt or Interrupt()
    watch = Watch(problem, options, interrupt, (-free, free), earlier=earlier, changes_over=changes_over)
    return watch, [watch.look(problem.at(x).cost, x, problem.at(x).gaps) for x in points]


def test_a_step_is_measured_in_standard_deviations(small):
    problem, best, std = small
    seen = []
    watched(problem, off(best, std, [-3.0, 0.0]), progress=seen.append)
    assert seen[0].sigma == np.inf  # there is no step yet
    assert seen[1].sigma == pytest.approx(3.0, rel=1e-6)
    assert seen[1].step == pytest.approx(3 * std / best[0], rel=1e-6)
    assert [p.iteration for p in seen] == [0, 1]
    assert seen[1].cost == problem.at(best).cost


def test_rest_is_two_small_steps_where_nothing_is_to_gain(small):
    problem, best, std = small
    watch, stops = watched(problem, off(best, std, [1e-1, 1e-3, 1e-5, 0.0]))
    assert stops == [False, False, False, True]  # steps of 0.1 and 1e-3: the last of these is still too long
    assert watch.status is FitStatus.CONVERGED
    watch, stops = watched(problem, off(best, std, [5.0, 1e-5, 0.0]))
    assert not any(stops)  # the last step is small, but the one before was of five
    assert watch.status is None


def test_standing_still_off_the_minimum_is_stuck_not_at_rest(small):
    """A solver with a wrong Hessian takes small steps where Gauss-Newton would take a long one."""
    problem, best, std = small
    points = off(best, std, [4 + 1e-5 * k for k in range(TOLERANCES.patience + 2)])
    watch, stops = watched(problem, points)
    assert watch.status is FitStatus.STEPS_TOO_SMALL
    assert stops.index(True) == TOLERANCES.patience + 1  # the first step has none before it to go by


def test_the_papers_rule_is_the_relative_change(small):
    problem, best, _ = small
    points = [best * np.array([1 + d, 1.0]) for d in (3e-3, 1.5e-4, 0.6e-4)]
    watch, stops = watched(problem, points, stop="paper")
    assert stops == [False, False, True]  # 2.85e-3, then 0.9e-4
    assert watch.status is FitStatus.CONVERGED_BY_PAPER_RULE


@pytest.mark.parametrize("changes", [True, False])
def test_creeping_calls_for_the_other_method_only_where_there_is_one(small, changes):
    problem, best, std = small
    watch, stops = watched(problem, off(best, std, [10.0, 1.0, -6.0]), changes_over=changes)
    assert stops == [False, False, changes]  # steps of 9 and 7: dozens of such lie ahead
    assert watch.creeping is changes


def test_ctrl_c_stops_and_earlier_iterations_are_counted_on(small):
    problem, best, _ = small
    first, _ = watched(problem, [best * 1.1, best])
    interrupt, seen = Interrupt(), []
    points = [best, best * 1.001]  # where the first ended: not told twice
    second, stops = watched(problem, points, earlier=first.history, interrupt=interrupt, progress=seen.append)
    assert not any(stops)
    assert [p.iteration for p in seen] == [2]
    interrupt.error = KeyboardInterrupt()
    assert second.look(problem.at(best).cost, best, problem.at(best).gaps)
