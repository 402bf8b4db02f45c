"""Information of records against sums that are written down."""

import numpy as np
import pytest
from small_problem import small_problem

from gbid.identify.uncertainty.covariance import (
    Estimate,
    RecordInformation,
    information_over_records,
    profiled,
    record_information,
)

WEIGHT, SHAPED = np.array([[3.0]]), np.array([[0.25]])


@pytest.mark.parametrize("window", [None, 64])
def test_hessians_and_scores_of_two_records_are_the_sums_of_their_slopes(window):
    problem, unknowns, record_window, slopes, errors = small_problem(window=window, records=2)
    theta, starts = problem.unpack(unknowns)
    starts = starts * 0  # the errors are those of records that begin at rest
    if window:  # inner windows count for nothing: segments run from their first
        starts[1] = 7.0
    found = information_over_records(Estimate(problem, theta, starts, record_window), WEIGHT, block=50, shaped=SHAPED)
    expected = np.zeros((3, 3))  # gain, then the two initial states
    for i, own in enumerate(slopes):
        places = np.ix_([0, 1 + i], [0, 1 + i])
        expected[places] += own.T @ own
    np.testing.assert_allclose(found.hessian, 3.0 * expected, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(found.shaped, 0.25 * expected, rtol=1e-9, atol=1e-9)
    assert found.observed is None
    for i, (record, own, e) in enumerate(zip(found.sensitivities, slopes, errors, strict=True)):
        np.testing.assert_array_equal(record.columns, [0, 1 + i])
        np.testing.assert_allclose(record.psi[0].T, own, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(record.errors[:, 0], e, rtol=1e-9, atol=1e-9)
        assert record.counted.all()


def test_without_feedback_of_errors_a_linear_gain_leaves_nothing_out():
    problem, unknowns, record_window, *_ = small_problem()
    theta, starts = problem.unpack(unknowns)
    found = information_over_records(Estimate(problem, theta, starts, record_window), WEIGHT, block=50, observed=True)
    np.testing.assert_allclose(found.observed, found.hessian, rtol=1e-6)


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
