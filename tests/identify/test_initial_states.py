"""Initial states that are given for each recording."""

import numpy as np
import pytest
from fit_cases import MODE, MODE_AT, H, levels, simulated

from gbid.errors import UsageError
from gbid.identify import fit

STARTS = {"a": [2.0, 0.0], "b": [0.0, -6.0]}


def recordings(noise=0.05):
    return [
        simulated(MODE, MODE_AT, levels(600, seed=i), x0=x0, noise=noise, seed=i, name=name)
        for i, (name, x0) in enumerate(STARTS.items())
    ]


def test_each_recording_has_the_state_that_is_given():
    found = fit(MODE, recordings(), initial_state=STARTS, focus="simulation")
    np.testing.assert_allclose(found.initial_states, list(STARTS.values()), atol=1e-12)
    free = fit(MODE, recordings(), focus="simulation")
    assert found.options.initial_state == "given"
    for name in "wzg":
        assert abs(found.parameters[name] - MODE_AT[name]) < 4 * found.std[name]
        assert found.std[name] < free.std[name]  # what is known need not be estimated
    swapped = fit(MODE, recordings(), initial_state=dict(zip("ba", STARTS.values(), strict=True)), focus="simulation")
    assert swapped.loss > 2 * found.loss


def test_zero_is_a_state_of_a_recording():
    rest = simulated(MODE, MODE_AT, levels(600), noise=0.05, name="rest")
    found = fit(MODE, [rest, recordings()[1]], initial_state={"rest": "zero", "b": STARTS["b"]})
    np.testing.assert_allclose(found.initial_states, [[0.0, 0.0], STARTS["b"]], atol=1e-12)
    assert found.success
    assert rest.sample_time == H


@pytest.mark.parametrize(
    ("states", "words"),
    [
        ({"a": [2.0, 0.0]}, "give one for each recording of the fit and for no other; wrong: b"),
        ({**STARTS, "c": "zero"}, "wrong: c"),
        ({"a": [2.0], "b": "zero"}, "initial_state has shape (1,); the structure has 2 states"),
        ({"a": "estimated", "b": "zero"}, "initial_state = 'estimated'"),
    ],
)
def test_what_is_missing_is_refused(states, words):
    with pytest.raises(UsageError) as caught:
        fit(MODE, recordings(), initial_state=states)
    assert words in str(caught.value)
