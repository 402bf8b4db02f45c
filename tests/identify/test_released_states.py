"""Initial states that are functions of the parameters: ``x0`` of a structure."""

import numpy as np
import pytest
from fit_cases import H, levels
from scipy.optimize import least_squares

from gbid.core.errors import DataError, UsageError
from gbid.identify import fit
from gbid.recording import Recording
from gbid.structure import LinearStructure, Parameter, evaluate

STEP, COUNT, NOISE = 0.02, 300, 0.05
TRUTH = {"w": 5.0, "z": 0.02, "angle": 1.0}


def _released(p):
    return {"A": [[0, 1], [-(p.w**2), -2 * p.z * p.w]], "C": [[1, 0]], "x0": [p.angle, 0]}


PENDULUM = LinearStructure(
    "pendulum",
    [Parameter("w", 5.3, 0.1, 50.0), Parameter("z", 0.04, 0.0, 1.0), Parameter("angle", 0.7)],
    _released,
    (),
    "y",
)


def swing(w, z, angle, t):
    """Angle of a pendulum that is released at rest."""
    fast = w * np.sqrt(1 - z**2)
    return angle * np.exp(-z * w * t) * (np.cos(fast * t) + z * w / fast * np.sin(fast * t))


def decay(seed, name="decay", **other):
    y = swing(**{**TRUTH, **other}, t=STEP * np.arange(COUNT)) + NOISE * np.random.default_rng(seed).normal(size=COUNT)
    return Recording({"y": y[:, None]}, STEP, name=name)


@pytest.mark.parametrize("window", [None, 40])
def test_a_pendulum_that_is_released_at_rest(window):
    recording = decay(0)
    result = fit(PENDULUM, recording, window=window)
    t, y = STEP * np.arange(COUNT), recording.signal("y")[:, 0]
    best = least_squares(lambda x: y - swing(*x, t), list(TRUTH.values()), x_scale=[5, 0.02, 1], xtol=1e-14, ftol=1e-14)
    assert result.success
    np.testing.assert_allclose(list(result.parameters.values()), best.x, rtol=1e-6)
    std = np.sqrt(np.diag(np.linalg.inv(best.jac.T @ best.jac)) * 2 * best.cost / (COUNT - 3))
    np.testing.assert_allclose(np.sqrt(np.diag(result.covariance_white)), std, rtol=1e-4)
    np.testing.assert_allclose(result.initial_states, [[best.x[2], 0.0]], rtol=1e-6)
    free = fit(PENDULUM, recording, initial_state="estimated", fixed={"angle": 1.0})
    assert result.std["w"] < 0.7 * free.std["w"]  # a velocity of zero is known: the phase need not be estimated
    assert result.options.initial_state == "structure"


def test_each_recording_has_its_own_angle_and_one_begins_anywhere():
    recordings = [decay(1, "a"), decay(2, "b", angle=-0.4), decay(3, "c")]
    states = {"a": "structure", "b": "structure", "c": ["structure", "estimated"]}
    result = fit(PENDULUM, recordings, initial_state=states, local={"angle": "recording"})
    for name, angle in (("a", 1.0), ("b", -0.4), ("c", 1.0)):
        assert abs(result.parameters[f"angle[{name}]"] - angle) < 4 * result.std[f"angle[{name}]"]
    np.testing.assert_allclose(result.initial_states[:, 0], [result.parameters[f"angle[{n}]"] for n in "abc"])
    np.testing.assert_array_equal(result.initial_states[:2, 1], 0.0)
    assert result.initial_states[2, 1] != 0.0


def _everything(p):
    return {
        "A": [[-p.a, p.w], [-p.w, -0.3 * p.a]],
        "B": [[1.0], [0.2]],
        "C": [[1.0, 0.4]],
        "D": [[p.d]],
        "K": [[p.k], [0.3]],
        "B_delayed": [[0.3], [p.w / 3]],
        "delay": [0.13],
        "x0": [p.start, p.start * p.a],
    }


EVERYTHING = LinearStructure(
    "everything",
    [Parameter("a", 0.9), Parameter("w", 2.8), Parameter("d", 0.1), Parameter("k", 0.5), Parameter("start", 3.0)],
    _everything,
)
EVERYTHING_AT = {"a": 0.8, "w": 3.0, "d": 0.15, "k": 1.2, "start": 2.5}


def driven(seed=3, count=400, noise=0.05, name="driven"):
    model, u = evaluate(EVERYTHING, EVERYTHING_AT), levels(count, seed=seed)
    y = model.simulate(u, H, initial_state=[2.5, 2.0]) + noise * np.random.default_rng(seed).normal(size=(count, 1))
    return Recording({"u": u, "y": y}, H, name=name)


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"intersample": "foh"},
        {"focus": "simulation"},
        {"left_out": {"driven": [(0, 3), (50, 60)]}},
        {"trend": "random walk"},
        {"robust": "huber"},
        {"window": 50, "criterion": "det"},
    ],
)
def test_a_fixed_function_is_a_given_state(options):
    """Without a free parameter in x0 the fit is that with the same numbers as a given state."""
    held = {"a": 0.8, "start": 2.5}
    by_structure = fit(EVERYTHING, driven(), fixed=held, **options)
    given = fit(EVERYTHING, driven(), fixed=held, initial_state=[2.5, 2.0], **options)
    assert by_structure.success
    np.testing.assert_allclose(by_structure.initial_states, [[2.5, 2.0]])
    assert by_structure.loss == pytest.approx(given.loss, rel=1e-9)
    for name in given.free:
        near = 1e-3 * given.std[name] if np.isfinite(given.std[name]) else 1e-4  # a gain of a random walk on its bound
        assert by_structure.parameters[name] == pytest.approx(given.parameters[name], abs=near)
        assert by_structure.std[name] == pytest.approx(given.std[name], rel=1e-3, nan_ok=True)


def test_the_prediction_begins_at_the_function():
    recording = driven()
    result = fit(EVERYTHING, recording)
    u, y = recording.signal("u"), recording.signal("y")

    def errors(x):
        values = dict(zip(EVERYTHING_AT, x, strict=True))
        model, start = evaluate(EVERYTHING, values), values["start"]
        return (y - model.predict(u, y, H, initial_state=[start, start * values["a"]]))[:, 0]

    best = least_squares(errors, list(EVERYTHING_AT.values()), xtol=1e-13, ftol=1e-13)
    np.testing.assert_allclose(list(result.parameters.values()), best.x, rtol=1e-4)
    std = np.sqrt(np.diag(np.linalg.inv(best.jac.T @ best.jac)) * 2 * best.cost / (len(y) - 5))
    np.testing.assert_allclose(np.sqrt(np.diag(result.covariance_white)), std, rtol=1e-3)


@pytest.mark.parametrize("states", ["structure", ["structure", "estimated"], [2.5, "estimated"], [2.5, 2.0]])
def test_the_covariance_by_windows_knows_the_same_states(states, monkeypatch):
    """Where a model grows, sensitivities are taken by windows; here both ways have the same answer."""
    options = {"initial_state": states, "window": 60, "focus": "simulation"}
    options["fixed"] = {} if "structure" in states else {"start": 2.5}
    over_record = fit(EVERYTHING, driven(), **options)
    monkeypatch.setattr("gbid.identify.uncertainty.covariance.grows", lambda *_: True)
    by_windows = fit(EVERYTHING, driven(), **options)
    np.testing.assert_allclose(by_windows.covariance_white, over_record.covariance_white, rtol=1e-4)


def test_no_start_value_is_needed():
    blank = LinearStructure(
        "blank",
        [Parameter("w", lower=0.0), Parameter("z", lower=0.0, upper=1.0), Parameter("angle")],
        _released,
        (),
        "y",
    )
    computed, stated = fit(blank, decay(6)), fit(PENDULUM, decay(6))
    assert computed.success
    np.testing.assert_allclose(list(computed.parameters.values()), list(stated.parameters.values()), rtol=1e-5)


def test_a_parameter_of_a_state_that_is_given_is_refused():
    with pytest.raises(DataError, match=r"no recording starts from the state with angle; fix each of these \(fixed="):
        fit(PENDULUM, decay(0), initial_state="estimated")
    with pytest.raises(DataError, match="angle"):
        fit(PENDULUM, decay(0), initial_state=["estimated", "structure"])


def test_a_state_of_wrong_size_is_refused():
    wrong = LinearStructure("wrong", PENDULUM.parameters, lambda p: {**_released(p), "x0": [p.angle]}, (), "y")
    with pytest.raises(UsageError, match=r"structure 'wrong': x0 has shape \(1, 1\), expected \(2, 1\)"):
        fit(wrong, decay(0))
