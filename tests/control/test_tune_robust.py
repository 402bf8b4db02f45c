"""Robust designs: the promise against plants built one by one, fresh draws, and the price."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import gbid
from gbid.control import (
    MaxDamping,
    PeakSensitivity,
    Uncertainty,
    controller_model,
    price_of_robustness,
    sensitivities,
    smallest_damping,
    tune_robust,
)
from gbid.control.tuning.plants import root_of
from gbid.control.tuning.robust import PlantDraws, lower_bound
from gbid.core.errors import UsageError
from gbid.lpv.model import TERMS
from gbid.structure import KEY_PARAMETERS

MODEL = gbid.load_model("theisen2016")
ONE = [(6.0, 0.0)]
GOALS = [MaxDamping(), PeakSensitivity(2.0)]


def uncertainty(share: float = 0.02) -> Uncertainty:
    """Independent deviations of the constant terms, and of recordings, as a share of each key parameter."""
    size = np.array([abs(v) for v in MODEL.key_parameters(6.0, 0.0).values()])
    covariance = np.zeros((len(KEY_PARAMETERS) * len(TERMS),) * 2)
    for i, value in enumerate(size):
        covariance[i * len(TERMS), i * len(TERMS)] = (share * value) ** 2
    return Uncertainty(covariance, scatter=np.diag((share * size) ** 2))


OPTIONS = {"uncertainty": uncertainty(), "operating_points": ONE, "starts": 1}


def test_two_gains_are_optimal_for_added_plants_too() -> None:
    options = {**OPTIONS, "starts": None, "draws": 20, "fresh": 10}
    robust = tune_robust(MODEL, "P", goals=GOALS, **options)
    assert robust.plants  # drawn plants were added
    assert robust.result.status == gbid.tune(MODEL, "P", goals=GOALS, operating_points=ONE).status == "optimal"


def test_promise_holds_on_plants_that_nobody_has_seen() -> None:
    robust = tune_robust(MODEL, "P", goals=GOALS, probability=0.9, **OPTIONS, draws=60, fresh=100)
    assert robust.result.success
    assert robust.plants
    rng = np.random.default_rng(5)
    nominal, held, kept = MODEL.key_parameters(6.0, 0.0), 0, 0
    K = controller_model(robust.result.controller, robust.result.gains)
    n = 100
    for _ in range(n):
        changed = {
            key: (v + 0.02 * abs(v) * np.sqrt(2) * rng.standard_normal(), *5 * (0.0,)) for key, v in nominal.items()
        }
        plant = replace(MODEL, coefficients=changed).plant_at(6.0, 0.0)
        loop = sensitivities(plant, K)
        held += smallest_damping(loop.model("output")) >= robust.promised - 1e-9
        kept += loop.peak("output").value <= 2.0 * np.exp(1e-3)
    assert held / n > 0.9 - 2.5 * np.sqrt(0.09 / n)
    assert kept / n > robust.keeps_limits - 2.5 * np.sqrt(0.09 / n)
    assert robust.holds == (robust.keeps_limits >= 0.9)
    plain = gbid.tune(MODEL, "P", goals=GOALS, operating_points=ONE)
    assert robust.promised < plain.value


def test_price_falls_with_the_probability() -> None:
    options = {**OPTIONS, "starts": 0, "draws": 40, "fresh": 60}
    price = price_of_robustness(MODEL, "P", goals=GOALS, probabilities=(0.9, 0.6), **options)
    assert price.probabilities == (0.6, 0.9)
    assert price.promised[0] > price.promised[1]
    assert price.nominal > price.promised[0]
    assert price.designs[1].keeps_limits > price.limits_of_nominal


def test_sampled_designs_are_tried_as_sampled_loops() -> None:
    options = {**OPTIONS, "starts": 0, "draws": 10, "fresh": 10}
    robust = tune_robust(MODEL, "P", goals=GOALS, sample_time=2e-4, **options)
    assert robust.result.sample_time == 2e-4
    assert robust.fresh.value.min() > 0


def test_a_covariance_may_be_singular_but_not_negative() -> None:
    direction = np.array([[3.0], [-4.0], [0.0]])
    singular = direction @ direction.T
    root = root_of(singular)
    np.testing.assert_allclose(root @ root.T, singular, atol=1e-12)
    with pytest.raises(UsageError, match="negative eigenvalue"):
        root_of(np.array([[1.0, 2.0], [2.0, 1.0]]))
    with pytest.raises(UsageError, match="symmetric"):
        Uncertainty(np.triu(np.ones((84, 84))))
    with pytest.raises(UsageError, match="from the 10 draws"):
        Uncertainty(np.eye(84), chosen=(10,))


def test_order_statistic_and_bound_are_known_ones() -> None:
    draws = PlantDraws(np.arange(59.0), np.zeros(59))
    assert draws.promised(0.95, 0.95) == 0.0  # 59 trials: the smallest value has 95 % with 95 % confidence (Wilks 1941)
    assert PlantDraws(np.arange(58.0), np.zeros(58)).promised(0.95, 0.95) == -np.inf
    assert PlantDraws(np.arange(93.0), np.zeros(93)).promised(0.95, 0.95) == 1.0  # 93 trials: the second smallest
    assert lower_bound(1.0, 59, 0.95) == pytest.approx(0.05 ** (1 / 59))
    assert draws.share(29.0) == pytest.approx(30 / 59)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, "has no uncertainty"),
        ({"uncertainty": Uncertainty(samples=np.zeros((3, 14)))}, "cannot be drawn anew"),
        ({"uncertainty": uncertainty(), "probability": 1.0}, "give 0.5 to 1"),
        ({"uncertainty": uncertainty(), "draws": 2}, "at least 10"),
    ],
)
def test_requests_that_make_no_sense_are_refused(options: dict[str, object], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        tune_robust(MODEL, "P", goals=GOALS, operating_points=ONE, **options)


def test_linear_models_alone_have_no_promise() -> None:
    with pytest.raises(UsageError, match="linear models alone have no uncertainty; give the fits"):
        tune_robust([MODEL.plant_at(6, 0)], "P", goals=GOALS)
