"""Random starts, stable and unstable: a fit never calls a result a success that is far from the best one in silence."""

import numpy as np
import pytest
from start_problems import START_PROBLEMS, random_start, start_problem

from gbid import fit


@pytest.mark.parametrize("name", START_PROBLEMS)
def test_a_random_start_of_each_structure(name):
    problem, rng = start_problem(name), np.random.default_rng(1)
    reference = fit(problem.structure, problem.recording, start=problem.true, **problem.options)
    assert reference.success
    result = fit(problem.structure, problem.recording, start=random_start(problem, rng), **problem.options)
    assert result.success, result.status
    assert result.loss <= 1.01 * reference.loss
    assert result.optimality < 0.1
