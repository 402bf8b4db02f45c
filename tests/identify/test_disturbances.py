"""Trends and hum that are estimated along: known answers, invariance, coverage, and what is refused."""

import numpy as np
import pytest
from fit_cases import EVERY, EVERY_AT, MODE, MODE_AT, H, innovations, levels, simulated

import gbid
from gbid.core.errors import UsageError
from gbid.identify import FitOptions, fit
from gbid.identify.disturbances import Disturbances, Trend, disturbances_of
from gbid.structure import evaluate

N = 1500
T = H * (np.arange(N) - (N - 1) / 2)  # from the middle of the record


def shifted(rec, course):
    return rec.with_signals(y=rec.signal("y") + course)


def away(result, truth):
    return np.array([(result.parameters[name] - value) / result.std[name] for name, value in truth.items()])


def mode_data(seed=1, n=N, noise=0.05):
    return simulated(MODE, MODE_AT, levels(n, seed=seed), noise=noise, seed=seed)


# ---- known answers ----


@pytest.mark.parametrize("focus", ["prediction", "simulation"])
def test_coefficients_of_drift_and_hum_are_found(focus):
    angle = 2 * np.pi * 1.7 * H * np.arange(N)
    course = 3.0 + 0.2 * T + 0.4 * np.cos(angle) - 0.7 * np.sin(angle)
    result = fit(MODE, shifted(mode_data(), course[:, None]), trend="linear", hum=1.7, focus=focus)
    truth = {"offset_y": 3.0, "trend1_y": 0.2, "hum1.7_cos_y": 0.4, "hum1.7_sin_y": -0.7}
    assert result.success
    assert np.abs(away(result, {**truth, **{name: MODE_AT[name] for name in "wzg"}})).max() < 4
    assert {name: result.units[name] for name in truth} == {
        "offset_y": "",
        "trend1_y": "1/s",
        "hum1.7_cos_y": "",
        "hum1.7_sin_y": "",
    }
    free = fit(MODE, mode_data(), focus=focus)
    for name in "wzg":  # as sure as without any disturbance
        assert result.std[name] == pytest.approx(free.std[name], rel=0.05)


def test_a_polynomial_is_that_of_numpy():
    """The monic Legendre polynomials span the same courses as powers of time."""
    columns = Disturbances(("y",), (Trend(5),)).regressors(H * np.arange(N))
    for power in range(5):
        fitted = np.polynomial.Polynomial.fit(T, columns[:, power], power).convert()
        assert fitted.coef[-1] == pytest.approx(1.0, rel=1e-9)
    scaled = columns / np.linalg.norm(columns, axis=0)
    assert np.abs(scaled.T @ scaled - np.eye(5)).max() < 0.01
    course = np.polyval([0.001, -0.02, 0.3, 2.0], T)
    rec = mode_data()
    plain, bent = fit(MODE, rec, trend=3), fit(MODE, shifted(rec, course[:, None]), trend=3)
    for name in ("w", "z", "g"):
        assert bent.parameters[name] == pytest.approx(plain.parameters[name], abs=1e-3 * plain.std[name])
    assert bent.parameters["trend3_y"] - plain.parameters["trend3_y"] == pytest.approx(0.001, abs=1e-9)


def test_a_trend_goes_through_the_predictor():
    """With a disturbance gain measured outputs are fed back: a trend that were subtracted late would show."""
    rec = innovations(EVERY, EVERY_AT, levels(N, 2, hold=3), noise=[0.2, 0.1])
    course = np.column_stack([1.0 + 0.5 * T, np.sin(2 * np.pi * 0.9 * H * np.arange(N))])
    result = fit(EVERY, shifted(rec, course), start=EVERY_AT, trend={"y_1": "linear"}, hum=[0.9])
    truth = {**EVERY_AT, "offset_y_1": 1.0, "trend1_y_1": 0.5, "hum0.9_cos_y_2": 0.0, "hum0.9_sin_y_2": 1.0}
    assert result.success
    assert "trend1_y_2" not in result.parameters
    assert np.abs(away(result, truth)).max() < 4


# ---- random walk ----


def walking(seed, step, n=4000):
    random = np.random.default_rng(seed)
    rec = simulated(MODE, MODE_AT, levels(n, seed=seed), noise=0.1, seed=seed)
    return rec.with_signals(y=rec.signal("y") + 2.0 + np.cumsum(step * random.standard_normal((n, 1)), axis=0))


def test_the_gain_of_a_random_walk_is_that_of_kalman():
    """Steady Kalman filter of a random walk in white noise: share of the error ``s`` with ``s^2 / (1 - s) = q / r``."""
    ratio = (0.02 / 0.1) ** 2
    share = (-ratio + np.sqrt(ratio**2 + 4 * ratio)) / 2
    result = fit(MODE, walking(3, 0.02), trend="random walk", fixed={"l1": 0.0, "l2": 0.0})
    assert result.success
    assert result.trusted == "white"
    assert abs(result.parameters["walk_y"] * H - share) < 4 * result.std["walk_y"] * H
    assert result.units["walk_y"] == "1/s"
    assert len(result.initial_states[0]) == len(result.modes_std) * 2 == 2


def test_random_walks_do_not_spoil_the_standard_deviations():
    truth = {name: MODE_AT[name] for name in "wzg"}
    fits = [
        fit(MODE, walking(seed, 0.02, 2000), trend="random walk", fixed={"l1": 0.0, "l2": 0.0}) for seed in range(8)
    ]
    assert all(each.success for each in fits)
    off = np.array([away(each, truth) for each in fits])
    assert 0.7 < np.sqrt((off**2).mean()) < 1.3
    blind = fit(MODE, walking(0, 0.02, 2000), trend="offset", focus="simulation")
    assert blind.std["g"] > 2 * fits[0].std["g"]


def test_the_walking_model_predicts_as_the_fit_did():
    rec = walking(5, 0.02, n=1200)
    result = fit(MODE, rec, trend="random walk", window=None)
    model = result.disturbances.with_walks_as_states(result.model, result.parameters)
    assert model.n_states == 3
    first = [*result.initial_states[0], 2.0]
    error = rec.signal("y") - model.predict(rec.signal("u"), rec.signal("y"), H, initial_state=first)
    assert float((error[300:] ** 2).mean()) == pytest.approx(result.loss, rel=0.1)
    assert gbid.check_residuals(result, rec).white.all()


def test_the_walking_model_keeps_delays():
    delayed = gbid.LinearModel([[-2.0]], [[0.0]], [[1.0]], [[0.0]], B_delayed=[[2.0]], delay=[0.3])
    walk = disturbances_of(FitOptions(trend="random walk"), ("y",), H)
    model = walk.with_walks_as_states(delayed, {"walk_y": 0.1})
    np.testing.assert_array_equal(model.B_delayed, [[2.0], [0.0]])
    u = levels(200)
    np.testing.assert_allclose(model.simulate(u, H), delayed.simulate(u, H), atol=1e-12)


# ---- around the fit ----


def test_results_come_back_from_their_file(tmp_path):
    result = fit(EVERY, innovations(EVERY, EVERY_AT, levels(900, 2, hold=3), noise=0.1), start=EVERY_AT,
                 trend={"y_2": "random walk"}, hum=(0.4, 1.3))  # fmt: skip
    gbid.save(result, tmp_path / "fit.h5")
    again = gbid.load(tmp_path / "fit.h5")
    assert again.options == result.options
    assert again.disturbances.trends == (Trend(0), Trend(0, random_walk=True))
    assert dict(again.parameters) == dict(result.parameters)


def test_samples_left_out_are_no_obstacle():
    rec = shifted(mode_data(), 1.0 + 0.3 * T[:, None])
    spoilt = rec.signal("y").copy()
    spoilt[400:450] = 1e3
    result = fit(MODE, rec.with_signals(y=spoilt), trend="linear", left_out={"data": [(400, 450)]})
    assert np.abs(away(result, {"offset_y": 1.0, "trend1_y": 0.3, "w": MODE_AT["w"]})).max() < 4


def test_start_values_of_a_bearing_are_found_beside_a_drift():
    true = gbid.load_model("theisen2016").key_parameters(6.0, 0.0)
    u = 4e-6 * levels(3000, 2, hold=40)
    p = evaluate(gbid.RotorBearing(), {**true, **dict.fromkeys(("bd_xx", "bd_xy", "bd_yx", "bd_yy"), 0.0)}).simulate(
        u, 2e-4, intersample="foh"
    )
    p = p + 2e-9 * np.random.default_rng(1).standard_normal(p.shape)
    t = 2e-4 * np.arange(3000)[:, None]
    channels, units = {"u": ("x", "y"), "p": ("x", "y")}, {"u": "m", "p": "m"}
    clean, drifting = (
        gbid.Recording({"u": u, "p": y}, 2e-4, channels=channels, units=units) for y in (p, p + 1e-6 * t * [1.0, -0.5])
    )
    free = fit(gbid.RotorBearing(), clean)
    result = fit(gbid.RotorBearing(), drifting, trend="linear")
    assert result.success
    for name in true:
        assert result.parameters[name] == pytest.approx(free.parameters[name], abs=0.5 * free.std[name])
        assert result.std[name] == pytest.approx(free.std[name], rel=0.05)
    assert result.parameters["trend1_p_x"] == pytest.approx(1e-6, abs=4 * result.std["trend1_p_x"])
    assert result.units["trend1_p_x"] == "m/s"


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"trend": "cubic"}, "trend = 'cubic'; give none, offset, linear, random walk, or a degree from 0 to 9"),
        ({"trend": 12}, "trend = 12; give"),
        ({"trend": {"p": "linear"}}, "trend names 'p', which is no output of the fit; they are y"),
        ({"trend": "random walk", "focus": "simulation"}, "is for focus = 'prediction'"),
        ({"hum": 50.0}, "hum = 50.0 Hz; give frequencies above 0 and below 5 Hz"),
        ({"hum": [1.0, 1.0]}, "given twice"),
    ],
)
def test_what_cannot_be_is_refused(options, words):
    with pytest.raises(UsageError) as caught:
        fit(MODE, mode_data(n=200), **options)
    assert words in str(caught.value)
