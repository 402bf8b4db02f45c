"""What the solver is watched for: steps in standard deviations, and when to stop."""

import numpy as np
import pytest
from small_problem import small_problem

from gbid.identify import FitStatus
from gbid.identify.options import FitArguments
from gbid.identify.problem.solve import Interrupt, Watch


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


def watched(problem, points, **options):
    """A watch, and whether it ends the solver at each of the points, shown as IPOPT does."""
    free = np.full(problem.n_unknowns, np.inf)
    watch = Watch(problem, FitArguments(**options), Interrupt(), (-free, free), earlier=(), changes_over=False)
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


def test_the_papers_rule_is_the_relative_change(small):
    problem, best, _ = small
    points = [best * np.array([1 + d, 1.0]) for d in (3e-3, 1.5e-4, 0.6e-4)]
    watch, stops = watched(problem, points, stop="paper")
    assert stops == [False, False, True]  # 2.85e-3, then 0.9e-4
    assert watch.status is FitStatus.CONVERGED_BY_PAPER_RULE
