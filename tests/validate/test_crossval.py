"""Fit percent, initial states and cross-validation against known answers."""

from dataclasses import replace

import numpy as np
import pytest
from fit_cases import EVERY, EVERY_AT, MODE, MODE_AT, H, levels, simulated, smooth

from gbid.core.errors import DataError, UsageError
from gbid.identify import fit
from gbid.recording import Recording
from gbid.structure import evaluate
from gbid.validate import cross_validate, fit_percent
from gbid.validate.simulate import LinearSimulator


@pytest.fixture(scope="module")
def model():
    """A fit whose parameters are the truth."""
    return fit(MODE, simulated(MODE, MODE_AT, levels(400), name="first"), focus="simulation")


# ---- fit percent ----


def test_fit_percent_of_known_signals():
    y = np.array([[1.0, 10.0], [2.0, 20.0], [3.0, 30.0], [4.0, 40.0]])
    np.testing.assert_array_equal(fit_percent(y, y), [100, 100])
    np.testing.assert_allclose(fit_percent(y, np.tile(y.mean(0), (4, 1))), [0, 0], atol=1e-12)
    # An error of half the deviations leaves half.
    np.testing.assert_allclose(fit_percent(y, y.mean(0) + 0.5 * (y - y.mean(0))), [50, 50], rtol=1e-12)
    np.testing.assert_allclose(fit_percent(y, y.mean(0) - (y - y.mean(0))), [-100, -100], rtol=1e-12)


# ---- initial states ----


@pytest.mark.parametrize("hold", ["zoh", "foh", ["zoh", "foh"]])
def test_the_initial_state_of_an_exact_recording_is_found(hold):
    x0 = np.array([3.0, -1.5])
    every = evaluate(EVERY, EVERY_AT)
    u = smooth(100)
    y = every.simulate(u, H, initial_state=x0, intersample=hold)
    state = LinearSimulator(every, H, hold).explain(u.T, y.T).initial_state
    np.testing.assert_allclose(state, x0, rtol=1e-9)


def test_a_state_that_no_output_sees_is_left_at_zero():
    every = evaluate(EVERY, EVERY_AT)
    blind = replace(every, A=np.diag([-1.0, -2.0]), C=np.array([[1.0, 0.0], [2.0, 0.0]]), K=None)
    u = smooth(50)
    y = blind.simulate(u, H, initial_state=[2.0, 7.0])
    state = LinearSimulator(blind, H, None).explain(u.T, y.T).initial_state
    np.testing.assert_allclose(state, [2.0, 0.0], atol=1e-9)


# ---- cross-validation ----


def test_the_truth_explains_all_of_another_recording(model):
    x0 = [2.0, -4.0]
    rec = simulated(MODE, MODE_AT, levels(300, seed=7), x0=x0, name="second")
    validation = cross_validate(
        model, Recording(rec.signals, H, {"speed_rpm": 60.0}, "second", units={"u": "V", "y": "m"})
    )
    assert validation.fit_percent == pytest.approx([100.0], abs=1e-3)
    assert validation.infinity_norm == pytest.approx([0.0], abs=1e-4)
    np.testing.assert_allclose(validation.initial_state, x0, rtol=1e-4)
    np.testing.assert_array_equal(validation.measured, rec.signal("y"))
    np.testing.assert_allclose(validation.simulated, rec.signal("y"), atol=1e-4)
    np.testing.assert_array_equal(validation.inputs, rec.signal("u"))
    np.testing.assert_allclose(validation.time, H * np.arange(300))
    assert (validation.recording, validation.fitted_to) == ("second", ("first",))
    assert (validation.input_names, validation.output_names) == (("u",), ("y",))
    assert (validation.input_units, validation.output_units) == (("V",), ("m",))
    assert validation.conditions == {"speed_rpm": 60.0}


def test_noise_leaves_its_own_part(model):
    clean = simulated(MODE, MODE_AT, levels(3000, seed=7)).signal("y")
    noise = clean.std() * np.random.default_rng(1).normal(size=clean.shape)
    rec = Recording({"u": levels(3000, seed=7), "y": clean + noise}, H)
    validation = cross_validate(model, rec)
    assert validation.fit_percent[0] == pytest.approx(100 * (1 - np.sqrt(0.5)), abs=2)
    assert validation.infinity_norm[0] == pytest.approx(np.abs(noise).max(), rel=0.1)


def test_the_hold_and_the_channels_of_the_fit_are_kept():
    u = smooth(400)
    rec = simulated(EVERY, EVERY_AT, u, hold=("zoh", "foh"), name="a")
    result = fit(EVERY, rec, start=EVERY_AT, intersample=("zoh", "foh"), focus="simulation")
    other = simulated(EVERY, EVERY_AT, smooth(300, seed=5), hold=("zoh", "foh"), x0=[1.0, 2.0], name="b")
    assert cross_validate(result, other).fit_percent == pytest.approx([100, 100], abs=1e-5)
    held = simulated(EVERY, EVERY_AT, smooth(300, seed=5), hold="zoh", x0=[1.0, 2.0], name="b")
    assert (cross_validate(result, held).fit_percent < 99.9).all()


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (lambda r: Recording(r.signals, 0.05, name="b"), "'b' has sample time 0.05 s; the model was fitted at 0.1 s"),
        (lambda r: Recording({"u": r.signal("u")}, H, name="b"), "'b' has no signal 'y'; it has u"),
        (lambda r: Recording({"y": r.signal("y")}, H, name="b"), "'b' has no signal 'u'; it has y"),
    ],
)
def test_recordings_that_do_not_fit_the_model_are_refused(model, change, text):
    with pytest.raises(DataError, match=text) as caught:
        cross_validate(model, change(simulated(MODE, MODE_AT, levels(200, seed=7))))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("widths", "text"),
    [
        ((2, 1), "'wide' gives the inputs u_x, u_y and the outputs y; the model has u and y"),
        ((1, 2), "the outputs y_1, y_2"),
    ],
)
def test_another_number_of_channels_is_refused(model, widths, text):
    signals = {name: levels(200, width) for name, width in zip("uy", widths, strict=True)}
    with pytest.raises(DataError, match=text):
        cross_validate(model, Recording(signals, H, name="wide"))


def test_the_order_of_other_programs_is_named(model):
    recording = Recording({"u": np.ones((9, 1)), "y": np.ones((9, 1))}, H, name="data")
    with pytest.raises(UsageError, match=r"Recording 'data'; .* other way round: cross_validate\(result, recording\)"):
        cross_validate(recording, model)


def test_an_unstable_model_is_not_simulated(model):
    unstable = model.changed(model=replace(model.model, A=np.array([[50.0, 1.0], [0.0, 60.0]]), K=None))
    rec = simulated(MODE, MODE_AT, levels(2000, seed=7), name="long")
    with pytest.raises(DataError, match=r"first is unstable: not simulated on recording 'long'.* a factor of 1e\d+;"):
        cross_validate(unstable, rec)
