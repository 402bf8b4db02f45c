"""Bootstrap of the standard deviations: its kind, seed and storage, and what it makes of short coloured records."""

import numpy as np
import pytest
from fit_cases import MODE, MODE_AT, levels, simulated
from scipy.signal import lfilter
from scipy.stats import t as student

from gbid.core.errors import UsageError
from gbid.identify import fit, load_fit, save_fit
from gbid.identify.uncertainty.coloured import (
    Bootstrap,
    ErrorModel,
    Estimator,
    RecordSensitivities,
    bootstrap_factors,
    transformed,
)


def coloured(n=300, seed=1):
    quiet = simulated(MODE, MODE_AT, levels(n, seed=seed), seed=seed)
    e = 0.2 * lfilter([1.0], [1.0, -0.8], np.random.default_rng(seed).normal(size=n + 200))[200:]
    return quiet.with_signals(y=quiet.signal("y") + e[:, None])


@pytest.fixture(scope="module")
def result():
    return fit(MODE, coloured(), focus="simulation", std="bootstrap", bootstrap_draws=50)


def test_it_is_a_kind_of_its_own(result):
    assert result.success
    assert result.trusted == "bootstrap"
    assert result.options.std == "bootstrap"
    assert (result.options.bootstrap_draws, result.options.bootstrap_seed) == (50, 0)
    assert result.std == result.std_with("bootstrap")
    np.testing.assert_array_equal(result.covariance, result.covariance_bootstrap)
    assert any("not white: standard deviations are those of the bootstrap" in note for note in result.notes)
    plain = fit(MODE, coloured(), focus="simulation")
    assert plain.std_with("robust") == pytest.approx(result.std_with("robust"), rel=1e-9, nan_ok=True)
    assert (plain.options.std, plain.trusted, plain.covariance_bootstrap) == ("auto", "robust", None)
    with pytest.raises(UsageError, match="no bootstrap"):
        plain.std_with("bootstrap")


def test_its_factors_leave_the_correlations_as_they_are(result):
    def correlations(covariance):
        sigma = np.sqrt(np.diag(covariance))
        return covariance / np.outer(sigma, sigma)

    np.testing.assert_allclose(
        correlations(result.covariance_bootstrap), correlations(result.covariance_robust), atol=1e-12
    )
    ratio = np.sqrt(np.diag(result.covariance_bootstrap) / np.diag(result.covariance_robust))
    assert (ratio > 0.7).all()
    assert (ratio < 1.8).all()
    assert (ratio != 1).all()


def test_the_seed_decides(result):
    again, other = (
        fit(MODE, coloured(), focus="simulation", std="bootstrap", bootstrap_draws=50, bootstrap_seed=seed)
        for seed in (0, 1)
    )
    np.testing.assert_array_equal(again.covariance, result.covariance)
    assert (np.diag(other.covariance) != np.diag(result.covariance)).all()


def test_it_is_stored(result, tmp_path):
    save_fit(result, tmp_path / "fit.h5")
    loaded = load_fit(tmp_path / "fit.h5")
    assert loaded.options == result.options
    assert loaded.trusted == "bootstrap"
    np.testing.assert_array_equal(loaded.covariance, result.covariance_bootstrap)
    np.testing.assert_array_equal(loaded.covariance_bootstrap, result.covariance_bootstrap)


def test_what_is_no_estimate_has_no_bootstrap():
    stopped = fit(MODE, coloured(), focus="simulation", std="bootstrap", max_iterations=1, start={"w": 8.0})
    assert not stopped.success
    assert stopped.covariance_bootstrap is None
    assert stopped.trusted == "robust"


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"std": "white"}, "std = 'white'; choose"),
        ({"bootstrap_draws": 100}, "bootstrap_draws is for std"),
        ({"bootstrap_seed": 1}, "bootstrap_seed is for std"),
        ({"std": "bootstrap", "bootstrap_draws": 10}, "bootstrap_draws = 10; give a whole number of at least 50"),
        ({"std": "bootstrap", "bootstrap_seed": -1}, "bootstrap_seed = -1; give a whole number of at least 0"),
    ],
)
def test_wrong_options_are_named(options, says):
    with pytest.raises(UsageError, match=says):
        fit(MODE, coloured(), **options)


def test_for_a_mean_of_few_white_errors_it_is_students_quantile():
    """Eighteen errors about a constant: the ratio of estimate to standard deviation has a t distribution."""
    n = 18
    record = RecordSensitivities(np.array([0]), np.ones((1, 1, n)), np.zeros((n, 1)), np.ones(n, bool))
    white = ErrorModel(np.zeros((0, 1, 1)), np.eye(1))
    root = np.array([[1 / np.sqrt(n)]])
    estimator = Estimator(np.eye(1), root, root, np.zeros((1, 1)), np.zeros(1, bool))
    (factor,) = bootstrap_factors([transformed(record, np.array([0]))], [white], estimator, Bootstrap(1000, 1))
    # Residuals lack a degree of freedom, of which the expected part is given back.
    assert factor == pytest.approx(student.ppf(0.975, n - 1) / 1.96, rel=0.03)


def test_directions_that_rounding_has_blurred_are_left_as_they_are():
    n = 200
    psi = np.random.default_rng(4).normal(size=(1, 2, n))
    record = RecordSensitivities(np.arange(2), psi, np.zeros((n, 1)), np.ones(n, bool))
    white = ErrorModel(np.zeros((0, 1, 1)), np.eye(1))
    root = np.diag(1 / np.sqrt((psi[0] ** 2).sum(axis=1)))
    estimator = Estimator(np.eye(1), root, root, np.zeros((2, 2)), np.array([False, True]))
    factors = bootstrap_factors([transformed(record, np.arange(2))], [white], estimator, Bootstrap(200, 1))
    assert factors[0] == pytest.approx(1.0, abs=0.15)
    assert factors[1] == 1.0
