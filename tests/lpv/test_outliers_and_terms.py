"""Outlier rule and terms of the surfaces, number by number."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import norm

from gbid.lpv import TERMS
from gbid.lpv.estimates import chosen_exponents, orthonormal
from gbid.lpv.regression import _VARIANCE, CLIPPING_SLOPE, HUBER, huber_estimate, outliers, standardised, threshold
from gbid.structure.scheduling import exponents_of, monomials, term_name


def test_the_threshold_rises_with_the_number_of_entries() -> None:
    assert threshold(1) == 3.5
    assert threshold(100) == 3.5
    for count in (1000, 100_000):  # one false alarm in twenty tables of normal values
        assert 2 * count * norm.sf(threshold(count)) == pytest.approx(0.05, rel=1e-6)


def test_standardised_residuals_of_a_small_table() -> None:
    residuals = np.array([[1.0, -40.0], [-2.0, 10.0], [30.0, 10.0]])
    V = np.array([np.diag([1.0, 100.0]), np.diag([4.0, 100.0]), np.diag([1.0, 25.0])])
    # over their own deviations 1, -1, 30 and -4, 1, 2; the medians of their sizes are 1 and 2
    expected = np.array([[1.0, -4.0], [-1.0, 1.0], [30.0, 2.0]]) / (1.4826 * np.array([1.0, 2.0]))
    np.testing.assert_allclose(standardised(residuals, V), expected, rtol=1e-12)


def test_outliers_of_either_sign_the_largest_first() -> None:
    z = np.zeros((3, 14))
    z[0, 2], z[2, 0], z[1, 13], z[1, 1] = 4.0, -9.0, 5.0, 3.4
    residuals = np.arange(42.0).reshape(3, 14)
    found = outliers(("a", "b", "c"), residuals, z)
    told = [(o.recording, o.parameter, o.deviation, o.standardised) for o in found]
    assert told == [("c", "k_xx", 28.0, -9.0), ("b", "tau_y", 27.0, 5.0), ("a", "k_yx", 2.0, 4.0)]


def test_the_constants_of_the_clipping_function() -> None:
    assert pytest.approx(norm.cdf(HUBER) - norm.cdf(-HUBER), rel=1e-12) == CLIPPING_SLOPE
    variance = quad(lambda x: np.clip(x, -HUBER, HUBER) ** 2 * norm.pdf(x), -12, 12, points=[-HUBER, HUBER])[0]
    assert pytest.approx(variance, rel=1e-8) == _VARIANCE
    assert CLIPPING_SLOPE**2 / variance == pytest.approx(0.95, abs=1e-3)  # Huber's choice: 95 % efficient


def test_hubers_location_solves_its_equation() -> None:
    """Of one column and a constant: the clipped deviations sum to nothing, so one wild value weighs as 1.345 do."""
    y = np.array([[-0.8], [0.2], [0.5], [-0.4], [0.9], [50.0]])
    found = huber_estimate(y, np.ones((6, 1, 1)), None)
    rest = y[:, 0] - found.coefficients[0]
    size = HUBER * 1.4826 * np.median(np.abs(rest))
    assert np.clip(rest, -size, size).sum() == pytest.approx(0.0, abs=0.05 * size)
    assert found.clipped[:5] == pytest.approx(y[:5])
    assert found.clipped[5, 0] == pytest.approx(found.coefficients[0] + size, abs=0.05 * size)


def test_data_of_large_and_small_errors_are_clipped_alike() -> None:
    """Each row by its own standard deviation: an exact row far off is clipped, as far a coarse one is not."""
    e = np.random.default_rng(2).standard_normal(60)
    std = np.where(np.arange(60) < 30, 0.01, 1.0)
    y = (std * e)[:, None]
    y[0], y[30] = 0.5, 0.5
    found = huber_estimate(y, np.ones((60, 1, 1)), std[:, None, None] ** 2)
    assert found.clipped[0, 0] < 0.2
    assert found.clipped[30, 0] == pytest.approx(0.5)
    assert found.cost == pytest.approx(_VARIANCE / CLIPPING_SLOPE**2)
    assert found.cost == pytest.approx(1 / 0.95, abs=2e-3)


def test_terms_have_their_order_and_names() -> None:
    assert exponents_of(0) == ((0, 0),)
    assert exponents_of(1) == ((0, 0), (1, 0), (0, 1))
    assert tuple(term_name(e) for e in exponents_of(2)) == TERMS
    assert exponents_of(3)[6:] == ((3, 0), (2, 1), (1, 2), (0, 3))
    assert [term_name(e) for e in exponents_of(3)[6:]] == ["P^3", "P^2 Omega", "P Omega^2", "Omega^3"]
    assert chosen_exponents(("Omega^2", "1", "Omega P")) == ((0, 0), (1, 1), (0, 2))
    assert chosen_exponents("P") == ((1, 0),)
    assert monomials(np.array([[2.0, 3.0]]), exponents_of(3)).tolist() == [[1, 2, 3, 6, 4, 9, 8, 12, 18, 27]]


def test_orthogonal_terms_keep_the_sign_of_the_terms() -> None:
    points = np.array([[P, Omega] for P in (3.0, 5.0, 7.0) for Omega in (0.0, 4000.0)])
    found = orthonormal(points, exponents_of(1))
    np.testing.assert_allclose(found.columns.T @ found.columns, 6 * np.eye(3), atol=1e-12)
    np.testing.assert_allclose(found.columns[:, 0], 1.0, rtol=1e-12)
    np.testing.assert_allclose(found.columns[:, 1], (points[:, 0] - 5) / np.sqrt(8 / 3), atol=1e-12)
    np.testing.assert_allclose(found.columns[:, 2], (points[:, 1] - 2000) / 2000, atol=1e-12)
    np.testing.assert_allclose(monomials(points, exponents_of(1)) @ found.back, found.columns, atol=1e-12)
