"""Initial states that are given for each recording, or for some of its states."""

import numpy as np
import pytest
from fit_cases import MODE, MODE_AT, H, levels, simulated
from scipy.optimize import least_squares

from gbid.core.errors import UsageError
from gbid.identify import fit
from gbid.structure import evaluate

STARTS = {"a": [2.0, 0.0], "b": [0.0, -6.0]}


def recordings(noise=0.05):
    return [
        simulated(MODE, MODE_AT, levels(600, seed=i), x0=x0, noise=noise, seed=i, name=name)
        for i, (name, x0) in enumerate(STARTS.items())
    ]


def test_each_recording_has_the_state_that_is_given():
    result = fit(MODE, recordings(), initial_state=STARTS, focus="simulation")
    np.testing.assert_allclose(result.initial_states, list(STARTS.values()), atol=1e-12)
    free = fit(MODE, recordings(), focus="simulation")
    assert result.options.initial_state == {name: tuple(state) for name, state in STARTS.items()}
    for name in "wzg":
        assert abs(result.parameters[name] - MODE_AT[name]) < 4 * result.std[name]
        assert result.std[name] < free.std[name]  # what is known need not be estimated
    swapped = fit(MODE, recordings(), initial_state=dict(zip("ba", STARTS.values(), strict=True)), focus="simulation")
    assert swapped.loss > 2 * result.loss


def test_zero_is_a_state_of_a_recording():
    rest = simulated(MODE, MODE_AT, levels(600), noise=0.05, name="rest")
    result = fit(MODE, [rest, recordings()[1]], initial_state={"rest": "zero", "b": STARTS["b"]})
    np.testing.assert_allclose(result.initial_states, [[0.0, 0.0], STARTS["b"]], atol=1e-12)
    assert result.success
    assert rest.sample_time == H


def test_some_states_are_given_and_others_estimated():
    states = {"a": [2.0, "estimated"], "b": "estimated"}
    result = fit(MODE, recordings(), initial_state=states, focus="simulation")
    assert result.options.initial_state == {"a": (2.0, "estimated"), "b": "estimated"}
    assert result.initial_states[0, 0] == 2.0
    both = recordings()

    def errors(x):
        model = evaluate(MODE, dict(zip("wzg", x[:3], strict=True)) | {"l1": 0.0, "l2": 0.0})
        starts = [2.0, x[3]], x[4:]
        return np.concatenate(
            [
                r.signal("y") - model.simulate(r.signal("u"), H, initial_state=s)
                for r, s in zip(both, starts, strict=True)
            ]
        )[:, 0]

    best = least_squares(
        errors, [5.0, 0.05, 2.0, 0.0, 0.0, -6.0], x_scale=[5, 0.05, 2, 1, 1, 1], xtol=1e-13, ftol=1e-13
    )
    np.testing.assert_allclose([result.parameters[q] for q in "wzg"], best.x[:3], rtol=1e-6)
    np.testing.assert_allclose(result.initial_states.ravel()[1:], best.x[3:], rtol=1e-4, atol=1e-5)
    variance = 2 * best.cost / (len(best.fun) - len(best.x))
    std = np.sqrt(np.diag(np.linalg.inv(best.jac.T @ best.jac)) * variance)
    np.testing.assert_allclose(np.sqrt(np.diag(result.covariance_white)), std[:3], rtol=1e-4)
    free = fit(MODE, both, focus="simulation")
    assert free.aic - result.aic == pytest.approx(
        1200 * np.log(free.error_covariance[0, 0] / result.error_covariance[0, 0]) + 2, abs=1e-6
    )


@pytest.mark.parametrize(
    ("states", "words"),
    [
        ({"a": [2.0, 0.0]}, "give one for each recording of the fit and for no other; wrong: b"),
        ({**STARTS, "c": "zero"}, "wrong: c"),
        ({"a": [2.0], "b": "zero"}, "initial_state has shape (1,); the structure has 2 states"),
        ({"a": "rest", "b": "zero"}, "'rest', 'b': 'zero'}; give the word auto, estimated, zero or structure, a list"),
        ([0.0, "free"], "initial_state = [0.0, 'free']; give the word auto, estimated, zero or structure"),
        ([0.0, float("inf")], "it must be finite"),
        ("structure", "structure 'mode' states none; add x0 to its matrices(p)"),
    ],
)
def test_what_is_missing_is_refused(states, words):
    with pytest.raises(UsageError) as caught:
        fit(MODE, recordings(), initial_state=states)
    assert words in str(caught.value)
