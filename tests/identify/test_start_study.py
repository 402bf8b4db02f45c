"""Study of start values from the data: how often a fit reaches the best loss; run by `make test-slow`."""

import time
from dataclasses import replace

import numpy as np
import pytest
from start_cases import CASES

from gbid.identify import fit
from gbid.structure import LinearStructure

pytestmark = pytest.mark.slow
SEEDS = 20
ABSURD_SEEDS = 6  # fits from absurd starts take long
MOST_PARAMETERS = 10  # and with more parameters very long
DECADES = 3.0
SAME = 1e-5  # relative difference of losses at one minimum


def absurd_starts(case, seed):
    """Starts that are wrong by up to three decades to either side, with the right sign only where a bound gives it."""
    random = np.random.default_rng([seed, 77])
    results = {}
    for q in case.structure.parameters:
        value = case.truth.get(q.name, 0.0) or 1.0
        sign = 1.0 if q.lower >= 0 else random.choice([-1.0, 1.0])
        results[q.name] = float(np.clip(sign * abs(value) * 10 ** random.uniform(-DECADES, DECADES), q.lower, q.upper))
    return results


def as_users(case, starts):
    """The structure as a user's own with these starts, so that no built-in method finds others."""
    parameters = [replace(q, start=starts[q.name]) for q in case.structure.parameters]
    s = case.structure
    return LinearStructure(s.name, parameters, s.matrices, s.inputs, s.outputs, s.intersample)


@pytest.mark.parametrize("case", CASES, ids=[case.name for case in CASES])
def test_share_of_fits_that_reach_the_best_loss(case):
    reached, absurd, seconds, plain_seconds = [], [], [], []
    for seed in range(SEEDS):
        data = case.make(seed)
        structure = as_users(case, absurd_starts(case, seed))
        best = fit(structure, data, start=case.truth, **case.options).loss
        began = time.perf_counter()
        result = fit(structure, data, start="data", **case.options)
        seconds.append(time.perf_counter() - began)
        reached.append(result.success and result.loss <= best * (1 + SAME))
        if seed < ABSURD_SEEDS and len(case.truth) <= MOST_PARAMETERS:
            began = time.perf_counter()
            plain = fit(structure, data, max_iterations=60, **case.options)
            plain_seconds.append(time.perf_counter() - began)
            absurd.append(plain.success and plain.loss <= best * (1 + SAME))
    plain = f"{sum(absurd)} of {ABSURD_SEEDS} | {np.median(plain_seconds):.1f} s" if absurd else "not run | -"
    print(f"| {case.name} | {sum(reached)} of {SEEDS} | {np.median(seconds):.1f} s | {plain} |")
    assert np.mean(reached) >= 0.9
