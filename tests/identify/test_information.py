"""Information of records against sums that are written down."""

import numpy as np
from small_problem import small_problem

from gbid.identify.uncertainty.covariance import (
    Estimate,
    RecordInformation,
    profiled,
    record_information,
)

WEIGHT = np.array([[3.0]])


def test_a_record_by_itself_has_the_same_with_the_sign_of_a_step():
    problem, unknowns, record_window, slopes, errors = small_problem(n=640, records=2)
    theta, starts = problem.unpack(unknowns)
    found = record_information(Estimate(problem, theta, starts, record_window), WEIGHT)
    for own, e, (hessian, scores) in zip(slopes, errors, found, strict=True):
        np.testing.assert_allclose(hessian, 3.0 * own.T @ own, rtol=1e-9, atol=1e-9)
        assert scores.shape == (64, 2)  # blocks of ten samples
        np.testing.assert_allclose(scores.sum(axis=0), 3.0 * own.T @ e, rtol=1e-9, atol=1e-9)
        step = np.linalg.solve(hessian, scores.sum(axis=0))
        np.testing.assert_allclose(step, np.linalg.lstsq(own, e, rcond=None)[0], rtol=1e-6)


def test_what_is_estimated_along_takes_its_share():
    whole = RecordInformation(np.array([[4.0, 2.0], [2.0, 2.0]]), np.array([[1.0, 3.0], [5.0, 1.0]]))
    hessian, scores = profiled(whole, np.array([0]))
    np.testing.assert_allclose(hessian, [[2.0]])  # 4 - 2 * 2 / 2
    np.testing.assert_allclose(scores, [[-2.0], [4.0]])  # 1 - 3 and 5 - 1
    blind = RecordInformation(np.array([[4.0, 0.0], [0.0, 0.0]]), np.array([[1.0, 0.0]]))
    np.testing.assert_allclose(profiled(blind, np.array([0])).hessian, [[4.0]])
