"""Scattered rotor and bearing from random numbers that are known."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from gbid.lpv.model import PUBLISHED_RMS
from gbid.rig import RotorBearingTruth, Scatter, scattered

TRUTH = RotorBearingTruth(
    np.array([[-5e5, 3e3], [-2e3, -8e5]]),
    np.array([[-250.0, 30.0], [-20.0, -280.0]]),
    np.array([[1.5e5, 3e3], [2e3, 2.5e5]]),
    np.array([0.8e-3, 0.6e-3]),
)
SCATTER = Scatter(
    share=0.5, delay_s=(1e-4, 2e-4), frequency_hz=(2.0, 4.0), damping=(0.01, 0.02), static_gain=(0.01, 0.02, 0.03, 0.04)
)


class Given:
    """Random numbers that are told beforehand, ten for each draw."""

    def __init__(self, *draws: Any) -> None:
        self._draws = iter(draws)

    def standard_normal(self, n: int) -> Any:
        assert n == 10
        return np.array(next(self._draws), float)


def modes(truth: RotorBearingTruth) -> tuple[Any, Any]:
    values = np.linalg.eigvals(np.block([[np.zeros((2, 2)), np.eye(2)], [truth.stiffness, truth.damping]]))
    upper = np.array(sorted(values[values.imag > 0], key=abs))
    return np.abs(upper) / (2 * np.pi), -upper.real / np.abs(upper)


def gain(truth: RotorBearingTruth) -> Any:
    return -np.linalg.solve(truth.stiffness, truth.input_gain)


def test_each_number_moves_its_own_quantity_by_half_its_deviation() -> None:
    z = [1.0, -0.5, 0.6, -0.8, 1.0, -2.0, 1.0, -1.0, 0.5, 2.0]
    found, rejected = scattered(TRUTH, SCATTER, Given(z))
    assert rejected == 0
    frequency, damping = modes(TRUTH)
    np.testing.assert_allclose(modes(found)[0], frequency + np.array([1.0, -1.0]), rtol=1e-9)
    np.testing.assert_allclose(modes(found)[1], damping + np.array([0.003, -0.008]), rtol=1e-9)
    np.testing.assert_allclose(found.delay, TRUTH.delay + np.array([0.5e-4, -2e-4]), rtol=1e-12)
    np.testing.assert_allclose(gain(found), gain(TRUTH) + np.array([[0.005, -0.01], [0.0075, 0.04]]), rtol=1e-9)


def test_the_scatter_is_that_of_the_papers_recordings() -> None:
    paper = Scatter()
    stated = (*paper.delay_s, *paper.frequency_hz, *paper.damping, *paper.static_gain)
    assert stated == tuple(PUBLISHED_RMS.values())


def test_mode_shapes_are_kept() -> None:
    found, _ = scattered(TRUTH, SCATTER, Given([1.0, -0.5, 0.6, -0.8, *[0.0] * 6]))

    def shapes(truth: RotorBearingTruth) -> Any:
        values, vectors = np.linalg.eig(np.block([[np.zeros((2, 2)), np.eye(2)], [truth.stiffness, truth.damping]]))
        upper = [i for i in np.argsort(np.abs(values), kind="stable") if values[i].imag > 0]
        return vectors[1, upper] / vectors[0, upper]

    np.testing.assert_allclose(shapes(found), shapes(TRUTH), rtol=1e-8)


@pytest.mark.parametrize(("place", "sign"), [(2, -1), (3, -1), (4, -1), (5, -1), (2, 1), (0, -1)])
def test_draws_beyond_the_limits_are_rejected_and_counted(place: int, sign: int) -> None:
    """Too little damping or a delay too short; a mode that no longer oscillates; a frequency below zero."""
    wild = np.zeros(10)
    wild[place] = sign * 1000.0
    found, rejected = scattered(TRUTH, SCATTER, Given(wild, wild, np.zeros(10)))
    assert rejected == 2
    np.testing.assert_allclose(found.stiffness, TRUTH.stiffness, rtol=1e-9, atol=1e-6)
    np.testing.assert_allclose(found.damping, TRUTH.damping, rtol=1e-9, atol=1e-8)


def test_half_of_a_small_damping_or_delay_is_allowed() -> None:
    """Limits far above the truth become half of it."""
    strict = Scatter(share=1.0, damping=(1.0, 1.0), delay_s=(1.0, 1.0), minimum_damping=0.9, minimum_delay_s=1.0)
    damping, delay = modes(TRUTH)[1], TRUTH.delay
    just = np.concatenate([[0, 0], -0.49 * damping, -0.49 * delay, np.zeros(4)])
    found, rejected = scattered(TRUTH, strict, Given(just))
    assert rejected == 0
    np.testing.assert_allclose(modes(found)[1], 0.51 * damping, rtol=1e-8)
    for place, size in ((2, damping[0]), (3, damping[1]), (4, delay[0]), (5, delay[1])):
        below = np.zeros(10)
        below[place] = -0.51 * size
        assert scattered(TRUTH, strict, Given(below, np.zeros(10)))[1] == 1
