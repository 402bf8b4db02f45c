"""Sampled loops in the plane of the search: rates of modes, frequencies, and the damping that fades out."""

from __future__ import annotations

import numpy as np
import pytest

from gbid.control.tuning.plane import (
    damping_factors,
    damping_slopes,
    rate_slopes,
    searched_frequencies,
    true_frequencies,
    true_rates,
)

T = 2e-4


def transformed(z: np.ndarray) -> np.ndarray:
    return 2 / T * (z - 1) / (z + 1)


def test_rates_are_those_of_the_logarithm() -> None:
    rng = np.random.default_rng(0)
    z = rng.uniform(0.05, 1.2, 40) * np.exp(1j * rng.uniform(-3, 3, 40))
    np.testing.assert_allclose(true_rates(transformed(z), T), np.log(z) / T, rtol=1e-10)
    assert true_rates(transformed(np.array([0j])), T).real[0] == pytest.approx(-40 / T)  # dead beat
    assert (true_rates(z, None) == z).all()


def test_frequencies_go_both_ways() -> None:
    w = np.linspace(1, 0.95 * np.pi / T, 30)
    np.testing.assert_allclose(
        np.exp(1j * w * T), (1 + 1j * (s := searched_frequencies(w, T)) * T / 2) / (1 - 1j * s * T / 2)
    )
    np.testing.assert_allclose(true_frequencies(searched_frequencies(w, T), T), w)


def test_damping_of_short_modes_fades_continuously_with_right_slopes() -> None:
    z = np.array([0.9, 0.45, 0.36, 0.33, 0.30, 0.2]) * np.exp(1.2j)
    factors = damping_factors(np.log(z) / T, T)
    plain = damping_factors(np.log(z) / T)
    np.testing.assert_allclose(factors[:2], plain[:2])  # |z| > 1/e: they last longer than a sample
    assert (factors[2:] > plain[2:]).all()
    assert factors[-1] == 1
    w, step = transformed(z), 1e-3 * (1 + 2j)
    slopes = rate_slopes(w, T)[:, None] * step
    found = damping_slopes(true_rates(w, T), slopes, T)[:, 0]
    ahead, behind = (damping_factors(true_rates(w + s * step, T), T) for s in (1, -1))
    np.testing.assert_allclose(found, (ahead - behind) / 2, rtol=1e-5, atol=1e-12)
