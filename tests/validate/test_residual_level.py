"""The level of the test of independence, and offsets that belong to a recording."""

from dataclasses import replace

import numpy as np
import pytest
from fit_cases import MODE, MODE_AT, levels, simulated
from scipy.signal import lfilter

from gbid.core.errors import DataError, UsageError
from gbid.identify import correlation, fit
from gbid.identify.disturbances import Disturbances
from gbid.structure import LinearModel
from gbid.validate import check_residuals, cross_validate
from gbid.validate.residuals import _bartlett, _independent


@pytest.mark.parametrize(("hold", "memory"), [(1, 0.0), (50, 0.0), (50, 0.7), (5, 0.9)])
def test_the_test_of_independence_keeps_its_level(hold, memory):
    """Residuals of any colour, inputs slow or fast: about one in twenty below 0.05, half below 0.5."""
    random = np.random.default_rng(1)
    n, p = 8000, []
    for _ in range(200):
        u = np.repeat(random.choice([-1.0, 1.0], n // hold), hold)
        e = lfilter([1.0], [1.0, -memory], random.standard_normal(n))
        u, e = u - u.mean(), e - e.mean()
        p.append(_independent(correlation(u, e, 50), _bartlett(e, u, 50), n))
    assert 0.005 <= np.mean(np.array(p) < 0.05) <= 0.12
    assert 0.25 <= np.mean(np.array(p) < 0.5) <= 0.65  # long memory: on the safe side


@pytest.fixture(scope="module")
def model():
    """A fit with an offset, its parameters the truth but for noise."""
    recording = simulated(MODE, MODE_AT, levels(2000), name="first")
    return fit(MODE, with_offset(recording, 3.0, 1), focus="simulation", trend="offset")


def with_offset(recording, offset, seed):
    signals = dict(recording.signals)
    name = MODE.outputs[0]
    noise = np.random.default_rng(seed).standard_normal(signals[name].shape)
    signals[name] = signals[name] + offset + 0.01 * signals[name].std() * noise
    return replace(recording, signals=signals)


def test_a_recording_has_an_offset_of_its_own(model):
    other = with_offset(simulated(MODE, MODE_AT, levels(2000, seed=5), name="second"), -7.0, 2)
    assert cross_validate(model, other).fit_percent.min() > 98.5
    assert check_residuals(model, other).white.all()
    without = replace(model, disturbances=Disturbances())
    assert cross_validate(without, other).fit_percent.min() < 90


def test_residuals_of_the_wrong_model_follow_the_input(model):
    other = with_offset(simulated(MODE, MODE_AT, levels(2000, seed=5), name="second"), 0.0, 2)
    A, B = np.array(model.model.A), 0.9 * np.array(model.model.B)
    wrong = replace(model, model=replace(model.model, A=A, B=B))
    test = check_residuals(wrong, other)
    assert not test.white.any()
    assert test.follows[0] == tuple(test.input_names)
    assert any("follow" in words for words in test.verdict)


def test_overflow_and_short_recordings_are_refused_in_one_line(model):
    other = simulated(MODE, MODE_AT, levels(2000), name="second")
    wild = LinearModel(
        np.array([[80.0]]), np.ones((1, len(model.model.input_names))), np.ones((1, 1)),
        np.zeros((1, len(model.model.input_names))), input_names=model.model.input_names,
        output_names=model.model.output_names,
    )  # fmt: skip
    with pytest.raises(DataError, match="overflows on recording 'second'"):
        check_residuals(replace(model, model=wild), other)
    with pytest.raises(UsageError, match="lags must be 1 to a fourth"):
        check_residuals(model, other, lags=501)
