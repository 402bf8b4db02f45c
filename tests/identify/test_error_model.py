"""Model of coloured residuals, and the covariance of the gradient that follows from it, against brute force."""

import numpy as np
import pytest
from scipy.linalg import toeplitz
from scipy.signal import lfilter

from gbid.identify.uncertainty.coloured import (
    RecordSensitivities,
    _joined,
    error_model,
    lag_products,
    longest_order,
    score_covariance,
    transformed,
)

COUPLED = np.array([[[0.6, 0.3], [-0.2, 0.5]], [[-0.3, 0.0], [0.1, -0.2]]])

TINY = 1e-9  # root of the covariance of estimates that take nothing from the errors


def coupled(n, seed=0):
    """Two outputs of a vector autoregression of second order, and the covariance of what drives it."""
    root = np.array([[1.0, 0.0], [0.5, 0.3]])
    w = np.random.default_rng(seed).normal(size=(n + 200, 2)) @ root.T
    e = np.zeros_like(w)
    for k in range(2, len(w)):
        e[k] = COUPLED[0] @ e[k - 1] + COUPLED[1] @ e[k - 2] + w[k]
    return e[200:], root @ root.T


def test_white_residuals_have_a_model_without_lags():
    noise = [np.random.default_rng(seed).normal(size=(1500, 2)) for seed in range(20)]
    orders = [error_model(*lag_products([e], 12)).order for e in noise]
    assert np.median(orders) == 0  # Akaike's criterion takes a lag too many now and then
    assert max(orders) <= 3
    assert longest_order(30, 2) == 0
    assert longest_order(10**6, 2) > 100


def records(n, seed=1, left_out=slice(0, 0)):
    """Sensitivities that nobody chose, and the errors of `coupled`."""
    e, _ = coupled(n, seed)
    psi = lfilter([1.0], [1.0, -1.9, 0.95], np.random.default_rng(seed).normal(size=(2, 3, n)), axis=2)
    counted = np.ones(n, bool)
    counted[left_out] = False
    return RecordSensitivities(np.array([0, 2, 5]), psi * counted, e * counted[:, None], counted)


def covariance_of_errors(model, n):
    """Covariance of n samples, sample by sample, (n, 2, n, 2): sums of products of the response to a unit step."""
    response = np.zeros((600, 2, 2))
    response[0] = np.eye(2)
    for k in range(1, len(response)):
        for lag, a in enumerate(model.coefficients[:k], 1):
            response[k] += a @ response[k - lag]
    root = response @ np.linalg.cholesky(model.innovation)
    lags = [np.einsum("kab,kcb->ac", root[lag:], root[: len(root) - lag]) for lag in range(400)]
    lags += [np.zeros((2, 2))] * max(0, n - 400)
    i, j = np.indices((n, n))
    ahead = np.array(lags)[abs(i - j)]
    return np.where((i >= j)[..., None, None], ahead, ahead.transpose(0, 1, 3, 2)).transpose(0, 2, 1, 3)


@pytest.mark.parametrize("left_out", [slice(0, 0), slice(200, 260)])
def test_the_covariance_of_the_gradient_is_the_sum_over_all_pairs_of_samples(left_out):
    record = records(700, left_out=left_out)
    weight, kept = np.array([[2.0, 0.3], [0.3, 1.0]]), np.array([0, 1, 2, 5])
    total, (model,) = score_covariance(
        [transformed(record, kept)], weight, TINY * np.eye(4)
    )  # as if nothing was fitted
    total /= TINY**2
    assert model.order >= 2
    weighted = np.einsum("ab,bmk->kam", weight, record.psi)
    expected = np.einsum("kam,kalb,lbn->mn", weighted, covariance_of_errors(model, 700), weighted, optimize=True)
    np.testing.assert_allclose(total[np.ix_([0, 2, 3], [0, 2, 3])], expected, rtol=1e-7)
    assert (total[1] == 0).all()  # an unknown of another record


def test_feedback_of_errors_leaves_a_tenth_at_least():
    linear, change = np.diag([2.0, 4.0]), np.diag([-1.0, -8.0])
    np.testing.assert_allclose(_joined(np.array([linear, change]), np.eye(2)), np.diag([1.0, 0.4]), rtol=1e-9)
    np.testing.assert_array_equal(_joined(np.array([linear, 0 * change]), np.eye(2)), linear)
    with pytest.raises(np.linalg.LinAlgError, match="overflows"):
        _joined(np.array([[[np.inf]], [[-1.0]]]), np.eye(1))


def test_what_the_fit_takes_from_narrow_band_errors_is_given_back():
    """A slow oscillation fitted to noise of its own frequency: the residuals have a notch just there."""
    n, radius, at = 800, 0.97, 0.3
    t = np.arange(n)
    slopes = np.exp(-t / 400) * np.array(
        [np.cos(at * t), np.sin(at * t), t / n * np.cos(at * t), t / n * np.sin(at * t)]
    )
    a = np.poly([radius * np.exp(1j * at), radius * np.exp(-1j * at)]).real
    inverse = np.linalg.inv(slopes @ slopes.T)
    # Response of an autoregression to one unit, and from it the covariance of its samples.
    h = lfilter([1.0], a, np.eye(1, 4000)[0])
    true = slopes @ toeplitz([h[lag:] @ h[: len(h) - lag] for lag in range(n)]) @ slopes.T
    stated, plain, root = [], [], np.linalg.cholesky(inverse)
    back = np.linalg.inv(root)
    for seed in range(60):
        drive = np.random.default_rng(seed).normal(size=n + 2000)
        e = lfilter([1.0], a, drive)[2000:]
        e = e - slopes.T @ (inverse @ (slopes @ e))
        record = RecordSensitivities(np.arange(4), slopes[None], e[:, None], np.ones(n, bool))
        covariance, _ = score_covariance([transformed(record, np.arange(4))], np.eye(1), root)
        stated.append(np.diag(back.T @ covariance @ back))
        covariance, _ = score_covariance([transformed(record, np.arange(4))], np.eye(1), TINY * np.eye(4))
        plain.append(np.diag(covariance) / TINY**2)
    given_back, without = (np.mean(np.mean(covariance, axis=0) / np.diag(true)) for covariance in (stated, plain))
    assert without < 0.8
    assert 0.85 < given_back < 1.2
