"""Directions in which the information is nearly singular: rounding of the exact Hessian does not make them certain."""

from types import SimpleNamespace

import numpy as np
import pytest

from gbid.identify.uncertainty import covariance as module
from gbid.identify.uncertainty.coloured import RecordSensitivities
from gbid.identify.uncertainty.covariance import Information

N = 400
ALONG = np.array([1.0, -1.0]) / np.sqrt(2)  # the direction that the data hardly determine


def stated(monkeypatch, apart, rounding):
    """Covariances of two parameters whose sensitivities differ by a part, with a rounded exact Hessian."""
    random = np.random.default_rng(5)
    common, other = random.normal(size=(2, N))
    psi = np.array([common + apart * other, common - apart * other])
    errors = random.normal(size=(N, 1))
    gauss_newton = psi @ psi.T
    exact = gauss_newton + rounding * N * np.outer(ALONG, ALONG)
    record = RecordSensitivities(np.arange(2), psi[None], errors, np.ones(N, bool))
    monkeypatch.setattr(module, "grows", lambda *_: False)
    monkeypatch.setattr(
        module,
        "information_over_records",
        lambda *_, **__: Information(*(np.pad(h, (0, 1)) for h in (gauss_newton, gauss_newton, exact)), [record]),
    )
    problem = SimpleNamespace(
        n_theta=2,
        n_states=1,
        n_samples=N,
        weight=lambda products: np.eye(1),
        known=lambda _: SimpleNamespace(hessian=np.zeros((2, 2))),
        likelihood_size=N,
        extra=None,
        parts=(SimpleNamespace(predictor=SimpleNamespace(feeds_back=False), blocks=SimpleNamespace(segments=())),),
    )
    held = np.zeros(2, bool)
    products = errors.T @ errors
    at = module.Estimate(problem, np.ones(2), np.zeros((1, 1)), np.array([0]), np.ones((1, 1), bool))
    return module.covariance(at, products, held, coloured=True)


@pytest.mark.parametrize("rounding", [1e-9, 1e-7, -3e-11])
def test_rounding_does_not_shrink_a_standard_deviation(monkeypatch, rounding):
    """Errors are white, so that both covariances agree; the Hessian's rounding is up to 5e4 times the curvature."""
    std = stated(monkeypatch, 1e-6, rounding)
    white, robust = (ALONG @ c @ ALONG for c in (std.white, std.robust))
    assert white == pytest.approx(1 / (2e-12 * N), rel=0.5)
    assert robust == pytest.approx(white, rel=1e-3)


def test_curvature_that_is_more_than_rounding_counts(monkeypatch):
    """The same where the direction is seen well: twice the curvature is half the standard deviation."""
    std = stated(monkeypatch, 0.1, 0.0)
    steeper = stated(monkeypatch, 0.1, float(ALONG @ (np.linalg.inv(std.white)) @ ALONG) / N)
    ratio = (ALONG @ steeper.robust @ ALONG) / (ALONG @ std.robust @ ALONG)
    assert ratio == pytest.approx(0.25, rel=0.1)
