"""Start values of any linear structure from the data alone: black-box model, match, and the fits from there."""

import numpy as np
import pytest
from fit_cases import EVERY, EVERY_AT, MODE, MODE_AT, H, fit_data, innovations, levels, simulated
from start_cases import (
    CASES,
    CHAIN_AT,
    LATE_LAG,
    chain,
    levitated,
)

from gbid.core.errors import DataError, UsageError
from gbid.identify import fit
from gbid.identify.data import Record, gather
from gbid.identify.predictor import build_predictor
from gbid.identify.start.black_box import Target, black_box, match
from gbid.structure import LinearStructure, Parameter, RotorBearing, evaluate

BY_NAME = {case.name: case for case in CASES}


def record_of(recording, inputs=("u",), outputs=("y",)):
    return gather([recording], inputs, outputs, 10).records[0]


def poles_of(computed, h):
    return np.sort_complex(np.log(np.linalg.eigvals(computed.A).astype(complex)) / h)


def test_data_without_noise_give_the_model_exactly():
    rec = record_of(simulated(EVERY, EVERY_AT, np.random.default_rng(5).normal(size=(800, 2))))
    result = black_box([rec], 2, feedthrough=True)
    model = evaluate(EVERY, EVERY_AT)
    np.testing.assert_allclose(poles_of(result, H), np.sort_complex(model.poles()), rtol=1e-8)
    f = np.array([0.05, 0.5, 3.0])
    response, _ = result.response(np.exp(2j * np.pi * f * H))
    np.testing.assert_allclose(response, model.discretise(H).frequency_response(f), rtol=1e-8)


def test_an_offset_of_each_record_does_no_harm():
    recs = [record_of(simulated(EVERY, EVERY_AT, levels(500, 2, seed=i))) for i in range(2)]
    shifted = [Record(r.name, r.inputs + 0.7 * i, r.outputs + np.array([3.0, -5.0 * i])) for i, r in enumerate(recs, 1)]
    model = black_box(shifted, 2, feedthrough=True)
    np.testing.assert_allclose(poles_of(model, H), np.sort_complex(evaluate(EVERY, EVERY_AT).poles()), rtol=1e-7)


def test_too_few_samples_are_refused():
    with pytest.raises(DataError, match="12 samples are too few for a black-box model of 2 states"):
        black_box(fit_data([(levels(12), levels(12, seed=1))]).records, 2, feedthrough=False)


@pytest.mark.parametrize("factor", [1e-4, 1e4])
def test_a_match_finds_its_way_from_far_off(factor):
    """One start, all parameters wrong by four decades, and five modes; the response itself is flat there."""
    structure = chain(5)
    truth = {**{f"k{i}": 4e3 + 900.0 * i for i in range(5)}, **{f"d{i}": 1.0 + 0.2 * i for i in range(5)}, "b": 500.0}
    predictor = build_predictor(structure, {}, 5e-3, "zoh", "simulation")
    at = np.array([truth[q.name] for q in predictor.free])
    bounds = np.zeros(len(at)), np.full(len(at), np.inf)
    model, f = evaluate(structure, truth), np.geomspace(0.5, 60, 120)
    response = model.frequency_response(f)
    target = Target(2j * np.pi * f, response, 1 / np.abs(response), model.poles(), False)
    computed = match(predictor, target, [at * factor], *bounds)
    assert computed.misfit < 1e-6
    np.testing.assert_allclose(computed.theta, at, rtol=1e-4)


def test_a_match_within_the_errors_of_the_response_ends_the_search():
    structure, truth = chain(2), {"k0": 4e3, "k1": 4.9e3, "d0": 1.0, "d1": 1.2, "b": 500.0}
    predictor = build_predictor(structure, {}, 5e-3, "zoh", "simulation")
    at = np.array([truth[q.name] for q in predictor.free])
    model, f, random = evaluate(structure, truth), np.geomspace(1, 40, 90), np.random.default_rng(4)
    exact = model.frequency_response(f)
    response = exact * (1 + 0.01 * (random.normal(size=exact.shape) + 1j * random.normal(size=exact.shape)))
    starts = iter([1.2 * at, at])
    bounds = np.zeros(len(at)), np.full(len(at), np.inf)
    best = match(
        predictor, Target(2j * np.pi * f, response, 100 / np.abs(exact), model.poles(), False), starts, *bounds
    )
    np.testing.assert_allclose(best.theta, at, rtol=0.02)
    assert len(list(starts)) == 1  # not asked for


def test_free_decays_are_matched_with_weights_of_each_frequency_and_output():
    """Exact decays of unknown initial states: the misfit is zero at the truth alone, whatever the weights."""
    structure = chain(2)
    truth = {"k0": 4e3, "k1": 4.9e3, "d0": 1.0, "d1": 1.2, "b": 500.0}
    predictor = build_predictor(structure, {"b": 500.0}, 5e-3, "zoh", "simulation")
    at = np.array([truth[q.name] for q in predictor.free])
    model, s = evaluate(structure, truth), 2j * np.pi * np.geomspace(2.0, 40, 90)
    state = np.random.default_rng(2).normal(size=len(model.A))
    response = np.array([model.C @ np.linalg.solve(x * np.eye(len(state)) - model.A, state) for x in s])[..., None]
    weight = np.random.default_rng(3).uniform(0.2, 5.0, response.shape) / np.abs(response).max()
    target = Target(s, response, weight, model.poles(), True)
    best = match(predictor, target, [1.3 * at], np.zeros(len(at)), np.full(len(at), np.inf))
    assert best.misfit < 1e-6
    np.testing.assert_allclose(best.theta, at, rtol=1e-4)


@pytest.mark.parametrize("name", BY_NAME)
def test_starts_from_the_data_lead_to_the_best_loss(name):
    case = BY_NAME[name]
    data = case.make(0)
    result = fit(case.structure, data, start="data", **case.options)
    near = fit(case.structure, data, start=case.truth, max_iterations=40, **case.options)
    assert result.status.success
    assert result.loss <= near.loss * (1 + 1e-6)
    assert set(result.start_origin.values()) == {"data"}
    told = [note for note in result.notes if "by a subspace model" in note]
    assert len(told) == (
        0 if name in ("rotor in a gas bearing", "piezo pair") else 1
    )  # these have a method of their own


def test_stated_starts_and_fixed_values_are_kept():
    structure = LinearStructure(
        "chain", [*chain(3).parameters[:-1], Parameter("b", 480.0)], chain(3).matrices, "u", "y"
    )
    rec = BY_NAME["chain of 3"].make(0)
    result = fit(structure, rec, fixed={"d0": 1.0}, max_iterations=1)
    assert result.start["b"] == 480.0
    assert (result.start["d0"], result.parameters["d0"]) == (1.0, 1.0)
    assert (result.start_origin["b"], result.start_origin["d0"], result.start_origin["k0"]) == (
        "structure",
        "user",
        "data",
    )
    assert result.start["k1"] == pytest.approx(CHAIN_AT["k1"], rel=0.1)
    assert any(note.startswith("start values of k0, k1, k2, d1, d2: from the data") for note in result.notes)


def test_starts_stay_within_bounds():
    rec = BY_NAME["chain of 3"].make(0)
    result = fit(chain(3), rec, bounds={"k1": (1e3, 5e3), "d2": (3.0, 9.0)}, max_iterations=1)
    assert 1e3 <= result.start["k1"] <= 5e3
    assert 3.0 <= result.start["d2"] <= 9.0


def test_bounds_of_the_caller_count_more_than_a_stated_start():
    rec = BY_NAME["lag with dead time"].make(0)
    stated = LinearStructure(
        "lag", [Parameter("gain", 5.0), Parameter("T", 9.0), Parameter("dead_time", 0.0)], LATE_LAG.matrices
    )
    result = fit(stated, rec, start="data", bounds={"gain": (-10.0, 0.0), "T": (0.01, 2.0), "dead_time": (0.0, 2.0)})
    assert result.status.success
    assert result.parameters["dead_time"] == pytest.approx(0.73, abs=0.02)


def test_a_structure_that_does_not_fit_says_so():
    rec = simulated(MODE, {**MODE_AT, "z": 0.01}, levels(800), noise=0.1, seed=7)
    lag = LinearStructure(
        "lag", [Parameter("T", None, 0.0), Parameter("g")], lambda p: {"A": [[-p.T]], "B": [[p.g]], "C": [[1]]}
    )
    result = fit(lag, rec, focus="simulation", max_iterations=5)
    assert any("try fit_multistart" in note for note in result.notes)


def test_a_disturbance_gain_starts_at_zero():
    structure = LinearStructure(
        "mode", [Parameter(q.name, None, q.lower, q.upper) for q in MODE.parameters], MODE.matrices
    )
    rec = innovations(MODE, {**MODE_AT, "l1": 0.4, "l2": -0.3}, levels(900), noise=0.2)
    result = fit(structure, rec)
    assert (result.start["l1"], result.start["l2"]) == (0.0, 0.0)
    assert result.parameters["w"] == pytest.approx(MODE_AT["w"], rel=0.01)


def test_another_word_than_data_is_refused():
    with pytest.raises(UsageError, match="start = 'zero'; give values by name, or the word data"):
        fit(RotorBearing(), levitated(0), start="zero")
