"""Poles, zeros, step and impulse responses with their uncertainty; delays of recordings."""

import numpy as np
import pytest
from fit_cases import EVERY, EVERY_AT, LATE, LATE_AT, MODE, MODE_AT, H, levels, simulated
from scipy.signal import StateSpace, impulse, step, tf2ss

from gbid.core.errors import DataError, UsageError
from gbid.core.tables import csv_text
from gbid.identify import fit, time_response
from gbid.identify.frequency_data import estimate_delay
from gbid.identify.uncertainty.curves import _settling, ellipse, pole_zero
from gbid.recording import Recording
from gbid.structure import LinearModel, LinearStructure, Parameter, evaluate


@pytest.fixture(scope="module")
def every():
    rec = simulated(EVERY, EVERY_AT, levels(500, 2, hold=3), noise=0.1, seed=8)
    return fit(EVERY, rec, focus="simulation", start=EVERY_AT)


@pytest.fixture(scope="module")
def late():
    return fit(LATE, simulated(LATE, LATE_AT, levels(800, 2, hold=3), noise=0.02), start=LATE_AT)


def drawn(result, structure, n=150, shrink=0.01):
    """Models drawn close to the estimates, so that the first order is exact enough."""
    random = np.random.default_rng(0)
    centre = [result.parameters[name] for name in result.free]
    rows = random.multivariate_normal(centre, shrink**2 * result.covariance, size=n)
    for row in rows:
        yield evaluate(structure, {**result.parameters, **dict(zip(result.free, row, strict=True))})


def test_zeros_are_those_of_the_transfer_function():
    poles = pole_zero(LinearModel(*tf2ss([1.0, 3.0], [1.0, 4.0, 7.0])))
    np.testing.assert_allclose(poles.zeros, [-3.0])
    assert not poles.has_ellipses
    triple = pole_zero(LinearModel(-np.eye(2), np.eye(2)[:, :1], np.eye(2), np.zeros((2, 1))))
    assert len(triple.zeros) == 0  # two outputs, one input


def test_zeros_do_not_depend_on_units():
    model = evaluate(EVERY, EVERY_AT)
    other = LinearModel(
        model.A, model.B * [1e6, 1e-3], model.C * [[1e-9], [1e2]], model.D * [1e6, 1e-3] * [[1e-9], [1e2]]
    )
    np.testing.assert_allclose(pole_zero(other).zeros, pole_zero(model).zeros, rtol=1e-8)


@pytest.mark.parametrize("which", ["every", "late"])
def test_ellipses_are_those_of_models_drawn_from_the_covariance(which, request):
    result = request.getfixturevalue(which)
    structure = EVERY if which == "every" else LATE
    poles = pole_zero(result)
    places = {"poles": [], "zeros": []}
    for model in drawn(result, structure):
        other = pole_zero(model)
        places["poles"].append(_matched(other.poles, poles.poles))
        places["zeros"].append(_matched(other.zeros, poles.zeros))
    for name, cov in (("poles", poles.pole_covariance), ("zeros", poles.zero_covariance)):
        cloud = np.array(places[name])
        spread = 100 * np.stack([cloud.real.std(0), cloud.imag.std(0)], axis=-1)
        np.testing.assert_allclose(spread, np.sqrt(np.diagonal(cov, axis1=1, axis2=2)), rtol=0.25, atol=1e-6)
    assert poles.has_ellipses
    assert len(csv_text(poles.table()).splitlines()) == 1 + len(poles.poles) + len(poles.zeros)


def _matched(values, order):
    return [values[np.argmin(np.abs(values - place))] for place in order]


def test_an_ellipse_holds_its_share():
    cov = np.array([[2.0, -0.7], [-0.7, 0.5]])
    edge = ellipse(cov, 0.9)
    radius = np.einsum("ia,ab,ib->i", edge, np.linalg.inv(cov), edge)
    np.testing.assert_allclose(radius, -2 * np.log(0.1))
    line = ellipse(np.diag([4.0, 0.0]), 0.95)
    np.testing.assert_allclose(
        [np.abs(line[:, 0]).max(), np.abs(line[:, 1]).max()], [1.96 * 2, 0.0], rtol=2e-3, atol=1e-12
    )


@pytest.mark.parametrize(("kind", "reference"), [("step", step), ("impulse", impulse)])
def test_responses_are_those_of_scipy(kind, reference):
    model = evaluate(MODE, MODE_AT)
    response = time_response(model, kind, 8.0)
    _, y = reference(StateSpace(model.A, model.B, model.C, model.D), T=response.time_s)
    np.testing.assert_allclose(response.value[:, 0, 0], y, atol=1e-9)
    assert not response.has_band


def test_a_delayed_input_gives_the_same_response_later():
    prompt, late = (time_response(evaluate(LATE, {**LATE_AT, "tau": tau}), "step", 6.0) for tau in (0.0, 1.5))
    shift = np.interp(late.time_s - 1.5, prompt.time_s, prompt.value[:, 0, 0], left=0.0)
    np.testing.assert_allclose(late.value[:, 0, 0], shift, atol=2e-4)
    np.testing.assert_allclose(late.value[:, :, 1], prompt.value[:, :, 1])
    assert late.value[0, 0, 1] == pytest.approx(LATE_AT["b"])  # the feedthrough acts at once


@pytest.mark.parametrize("kind", ["step", "impulse"])
def test_bands_of_responses_are_those_of_models_drawn_from_the_covariance(late, kind):
    response = time_response(late, kind, 4.0)
    clouds = np.array([time_response(model, kind, 4.0).value for model in drawn(late, LATE, 50)])
    std = 100 * clouds.std(0)
    away = np.abs(response.time_s - late.parameters["tau"]) > 0.02  # at its beginning a delayed response jumps
    np.testing.assert_allclose(std[away], response.std[away], rtol=0.25, atol=0.02 * response.std.max())
    low, high = response.band()
    assert ((high - low)[away] >= 0).all()


def test_the_step_ends_at_the_static_gain(every):
    response = time_response(every, "step")
    np.testing.assert_allclose(response.value[-1], every.model.static_gain(), atol=5e-3)
    np.testing.assert_allclose(response.std[-1], every.static_gain_std, rtol=0.05)
    assert csv_text(response.table()).splitlines()[0] == "output,input,time_s,response,std"


def test_wrong_questions_are_refused(every):
    with pytest.raises(UsageError, match="choose 'step' or 'impulse'"):
        time_response(every, "ramp")
    with pytest.raises(UsageError, match=r"duration_s = 0\.0; give a number above 0"):
        time_response(every, "step", 0.0)
    with pytest.raises(UsageError, match="discrete"):
        time_response(every.model.discretise(H))


# ---- delay of a recording ----

LAG = LinearStructure(
    "lag",
    [Parameter("tau", 0.0, 0.0)],
    lambda p: {"A": [[-2.0]], "B": [[0]], "B_delayed": [[2.0]], "delay": [p.tau], "C": [[1]]},
)


@pytest.mark.parametrize("tau", [0.0, 0.35, 1.25])
@pytest.mark.parametrize("hold", [1, 4])
def test_a_delay_is_found_to_the_sample(tau, hold):
    """Also with an input that is held for several samples, whose own correlation would hide it."""
    rec = simulated(LAG, {"tau": tau}, levels(3000, hold=hold), noise=0.02, seed=4)
    delays = estimate_delay(rec)
    assert delays.lag - 1 == int(tau / H + 1e-9)
    assert delays.delay_s == pytest.approx(int(tau / H + 1e-9) * H)


def test_a_drift_does_not_make_a_response_long():
    drifting = LinearModel(np.diag([-1e-5, -1e6]), [[1.0], [1.0]], [[1.0, 1.0]], [[0.0]])
    assert _settling(drifting) < 1e-3


def test_no_connection_is_said():
    random = np.random.default_rng(3)
    rec = Recording({"u": random.normal(size=(2000, 1)), "y": random.normal(size=(2000, 1))}, H, name="apart")
    with pytest.raises(DataError, match="'y' does not follow 'u' within 2 s"):
        estimate_delay(rec, longest_s=2.0)
    with pytest.raises(UsageError, match="between one sample and half"):
        estimate_delay(rec, longest_s=1000.0)
    wide = Recording({"u": random.normal(size=(2000, 2)), "y": random.normal(size=(2000, 1))}, H)
    with pytest.raises(UsageError, match="'u' has 2 channels, u_x, u_y; name one"):
        estimate_delay(wide)
