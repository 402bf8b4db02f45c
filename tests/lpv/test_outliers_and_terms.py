"""Outlier rule and terms of the surfaces, number by number."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import norm

from gbid.lpv.model import deviations, regressors
from gbid.lpv.regression import _VARIANCE, CLIPPING_SLOPE, HUBER, huber_estimate, threshold


def test_the_threshold_rises_with_the_number_of_entries() -> None:
    assert threshold(1) == 3.5
    assert threshold(100) == 3.5
    for count in (1000, 100_000):  # one false alarm in twenty tables of normal values
        assert 2 * count * norm.sf(threshold(count)) == pytest.approx(0.05, rel=1e-6)


def test_the_constants_of_the_clipping_function() -> None:
    assert pytest.approx(norm.cdf(HUBER) - norm.cdf(-HUBER), rel=1e-12) == CLIPPING_SLOPE
    variance = quad(lambda x: np.clip(x, -HUBER, HUBER) ** 2 * norm.pdf(x), -12, 12, points=[-HUBER, HUBER])[0]
    assert pytest.approx(variance, rel=1e-8) == _VARIANCE
    assert CLIPPING_SLOPE**2 / variance == pytest.approx(0.95, abs=1e-3)  # Huber's choice: 95 % efficient


def test_hubers_location_solves_its_equation() -> None:
    """Of one column and a constant: the clipped deviations sum to nothing, so one wild value weighs as 1.345 do."""
    y = np.array([[-0.8], [0.2], [0.5], [-0.4], [0.9], [50.0]])
    coefficients, _, clipped = huber_estimate(y, np.ones((6, 1, 1)), None)
    rest = y[:, 0] - coefficients[0]
    size = HUBER * 1.4826 * np.median(np.abs(rest))
    assert np.clip(rest, -size, size).sum() == pytest.approx(0.0, abs=0.05 * size)
    assert clipped[:5] == pytest.approx(y[:5])
    assert clipped[5, 0] == pytest.approx(coefficients[0] + size, abs=0.05 * size)


def test_data_of_large_and_small_errors_are_clipped_alike() -> None:
    """Each row by its own standard deviation: an exact row far off is clipped, as far a coarse one is not."""
    e = np.random.default_rng(2).standard_normal(60)
    std = np.where(np.arange(60) < 30, 0.01, 1.0)
    y = (std * e)[:, None]
    y[0], y[30] = 0.5, 0.5
    _, _, clipped = huber_estimate(y, np.ones((60, 1, 1)), std[:, None, None] ** 2)
    assert clipped[0, 0] < 0.2
    assert clipped[30, 0] == pytest.approx(0.5)


def test_regressors_keep_the_shape_of_the_points() -> None:
    """The six terms of Eq. 16 in the order of Table B.6, last axis."""
    P, W = np.array([[3.0, 4.0, 5.0], [6.0, 7.0, 3.5]]), np.array([[0.0, 10.0, 20.0], [30.0, 40.0, 50.0]])
    expected = np.stack([np.ones((2, 3)), P, W, W * P, P**2, W**2], axis=-1)
    np.testing.assert_allclose(regressors(P, W), expected)


def test_deviations_are_rms_about_zero_and_largest_values():
    """A common offset counts: a standard deviation would not see it."""
    surface = np.ones((4, 10))
    away = np.outer([1.0, 1.0, -1.0, 3.0], np.arange(1.0, 11.0))
    rows = deviations(surface + away, surface, ("a", "b", "c", "d"))
    np.testing.assert_allclose([row.rms for row in rows], np.sqrt(3) * np.arange(1, 11))  # sqrt((1 + 1 + 1 + 9)/4)
    np.testing.assert_allclose([row.largest for row in rows], 3.0 * np.arange(1, 11))
    assert {row.recording for row in rows} == {"d"}
