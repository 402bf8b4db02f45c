"""Quadratic programmes of the tuner's steps against linear programmes by HiGHS."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import linprog

from gbid.control.tuning.local import quadratic_programme


@pytest.mark.parametrize("seed", range(4))
def test_a_step_without_curvature_keeps_rows_that_nearly_depend_on_each_other(seed: int) -> None:
    # such are the rows of power sums where eigenvalues meet
    rng = np.random.default_rng(seed)
    n, held, equal = 12, 8, 6
    thin = rng.standard_normal((equal, 3)) @ rng.standard_normal((3, n)) + 0.02 * rng.standard_normal((equal, n))
    rows = np.vstack([rng.standard_normal((held, n)), thin / np.linalg.norm(thin, axis=1)[:, None]])
    rows[:held, -1], rows[held:, -1] = -1.0, 0.0
    low = np.append(-rng.random(held), np.zeros(equal))
    high = np.append(np.full(held, np.inf), np.zeros(equal))
    lower, upper = np.append(np.full(n - 1, -0.5), -1e6), np.append(np.full(n - 1, 0.5), 1e6)
    linear = np.append(np.zeros(n - 1), -1.0)
    found = quadratic_programme(n, held + equal).solve(1e-9 * np.eye(n), linear, rows, low, high, lower, upper)
    exact = linprog(linear, -rows[:held], -low[:held], rows[held:], low[held:], np.column_stack([lower, upper]))
    assert found is not None
    assert np.abs(rows[held:] @ found[0]).max() < 1e-8
    assert (rows[:held] @ found[0] - low[:held]).min() > -1e-6
    assert linear @ found[0] == pytest.approx(exact.fun, abs=1e-6)
