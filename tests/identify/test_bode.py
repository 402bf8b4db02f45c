"""Frequency responses with confidence bands, and measured ones."""

import numpy as np
import pytest
from fit_cases import EVERY, EVERY_AT, LATE, LATE_AT, MODE, MODE_AT, H, levels, simulated
from scipy.signal import csd, welch

from gbid import load, save
from gbid.core.errors import DataError, UsageError
from gbid.core.tables import csv_text
from gbid.identify import bode, fit, measured_response
from gbid.identify.uncertainty.curves import response_slopes
from gbid.recording import Recording
from gbid.structure import evaluate


@pytest.fixture(scope="module")
def late():
    return fit(LATE, simulated(LATE, LATE_AT, levels(800, 2, hold=3), noise=0.02), start=LATE_AT)


@pytest.mark.parametrize(("structure", "at", "n_u"), [(EVERY, EVERY_AT, 2), (LATE, LATE_AT, 2)])
def test_derivatives_are_those_of_the_response(structure, at, n_u):
    """Against central differences of the frequency response of the structure, feedthrough and delays included."""
    rec = simulated(structure, at, levels(400, n_u, hold=3), noise=0.05)
    result = fit(structure, rec, focus="simulation", start=at, max_iterations=3)
    f = np.array([0.05, 0.4, 0.8, 2.0, 7.0])
    slopes = response_slopes(result.model, result.model_slopes, f)
    estimates = {name: result.parameters[name] for name in at}
    for k, name in enumerate(result.free):
        step = 1e-5 * max(1.0, abs(estimates[name]))
        up, down = (
            evaluate(structure, {**estimates, name: estimates[name] + d}).frequency_response(f) for d in (step, -step)
        )
        np.testing.assert_allclose(slopes[k], (up - down) / (2 * step), rtol=1e-6, atol=1e-8)


def test_bands_are_those_of_models_drawn_from_the_covariance(late):
    f = np.geomspace(0.05, 4.0, 15)
    response = late.bode(f)
    random = np.random.default_rng(0)
    draws = random.multivariate_normal([late.parameters[n] for n in late.free], 0.01 * late.covariance, size=400)
    drawn = np.array([evaluate(LATE, dict(zip(late.free, row, strict=True))).frequency_response(f) for row in draws])
    shifted = drawn / response.response
    np.testing.assert_allclose(10 * np.abs(drawn).std(0), response.magnitude_std, rtol=0.1)
    np.testing.assert_allclose(10 * np.degrees(np.angle(shifted)).std(0), response.phase_std_deg, rtol=0.1, atol=1e-6)
    for axes, part in ((0, drawn.real), (1, drawn.imag)):
        np.testing.assert_allclose(10 * part.std(0), np.sqrt(response.covariance[..., axes, axes]), rtol=0.1, atol=1e-7)


def test_the_resonance_frequency_has_the_same_std_as_the_modes():
    """At the natural frequency the phase of a mode moves by 1 / (zeta w) rad for each rad/s of the mode."""
    rec = simulated(MODE, MODE_AT, levels(600, hold=2), noise=0.3)
    result = fit(MODE, rec, focus="simulation", fixed={"z": 0.05, "g": 2.0})
    (f, zeta), (f_std, _) = result.model.modes()[0], result.modes_std[0]
    response = result.bode([f])
    assert response.phase_std_deg[0, 0, 0] == pytest.approx(np.degrees(f_std / f / zeta), rel=1e-9)
    assert response.phase_deg[0, 0, 0] == pytest.approx(-90.0, abs=1e-9)


def test_the_phase_of_a_long_delay_has_no_jumps():
    model = evaluate(LATE, {**LATE_AT, "tau": 30.0})
    f = np.linspace(0.1, 20.0, 50)  # 12 turns of the delay between two frequencies
    phase = bode(model, f).phase_deg[:, 0, 0]
    rest = bode(evaluate(LATE, {**LATE_AT, "tau": 0.0}), f).phase_deg[:, 0, 0]
    np.testing.assert_allclose(np.diff(phase - rest), -360 * 30.0 * np.diff(f), atol=1e-6)


def test_a_plain_model_has_no_bands_and_a_stored_fit_keeps_them(late, tmp_path):
    plain = bode(late.model, [1.0])
    assert not plain.has_band
    assert np.isnan(plain.magnitude_std).all()
    np.testing.assert_array_equal(plain.response, late.bode([1.0]).response)
    save(late, tmp_path / "late.h5")
    np.testing.assert_array_equal(load(tmp_path / "late.h5").bode().magnitude_std, late.bode().magnitude_std)


def test_the_table_has_a_row_for_each_pair_and_frequency(late):
    response = late.bode([0.5, 1.0])
    lines = csv_text(response.table()).splitlines()
    assert lines[1].startswith("output,input,frequency_hz,magnitude,magnitude_std,magnitude_lower")
    assert len(lines) == 2 + 2 * 2 * 2
    name_y, name_u, f, magnitude, std, *_ = lines[5].split(",")
    assert (name_y, name_u, float(f)) == ("y_1", "u_y", 1.0)
    assert (float(magnitude), float(std)) == (response.magnitude[1, 0, 1], response.magnitude_std[1, 0, 1])


def test_parameters_of_other_recordings_do_not_widen_the_band():
    recs = [
        simulated(MODE, {**MODE_AT, "g": g}, levels(300, seed=i), noise=0.3, name=f"r{i}")
        for i, g in enumerate((2.0, 1.0))
    ]
    result = fit(MODE, recs, focus="simulation", local={"g": "recording"}, start=MODE_AT, trend="offset")
    other = result.free.index("g[r1]")
    assert not any(getattr(result.model_slopes, m)[other].any() for m in "ABCD")
    gain = result.bode([1e-6])
    assert gain.magnitude_std[0, 0, 0] == pytest.approx(result.static_gain_std[0, 0], rel=1e-6)


@pytest.mark.parametrize("wrong", [[0.0, 1.0], [-1.0], [1.0, np.nan]])
def test_frequencies_must_be_above_zero(late, wrong):
    with pytest.raises(UsageError, match="above zero"):
        late.bode(wrong)
    with pytest.raises(UsageError, match="probability"):
        late.bode([1.0]).magnitude_band(95)


# ---- measured ----


def test_one_channel_is_the_estimate_of_scipy():
    rec = simulated(MODE, {**MODE_AT, "z": 0.3}, np.random.default_rng(3).normal(size=(4096, 1)), noise=0.2)
    u, y = rec.signal("u")[:, 0], rec.signal("y")[:, 0]
    measured = measured_response(rec, "u", "y", resolution_hz=1 / (256 * H), intersample=None)
    options = {"fs": 1 / H, "nperseg": 256, "noverlap": 128, "window": "hann", "detrend": "constant"}
    f, S_uy = csd(u, y, **options)
    _, S_uu = welch(u, **options)
    _, S_yy = welch(y, **options)
    np.testing.assert_allclose(measured.frequency_hz, f[1:128])
    np.testing.assert_allclose(measured.response[:, 0, 0], (S_uy / S_uu)[1:128], rtol=1e-9)
    np.testing.assert_allclose(measured.coherence[:, 0], (np.abs(S_uy) ** 2 / S_uu / S_yy)[1:128], rtol=1e-9)


def test_std_of_the_measurement_is_its_scatter():
    sampled = evaluate(EVERY, EVERY_AT).discretise(H)
    z = []
    for seed in range(12):
        u = np.random.default_rng(seed).normal(size=(8000, 2))
        rec = simulated(EVERY, EVERY_AT, u, noise=0.3, seed=seed + 100)
        measured = measured_response(rec, "u", "y", resolution_hz=0.05, intersample=None)
        band = measured.frequency_hz > 1.0  # below, the resonance is narrower than the resolution
        off = (measured.response - sampled.frequency_response(measured.frequency_hz)) / measured.std
        z.append([off[band].real, off[band].imag])
    assert 0.93 < np.sqrt(np.square(z).mean()) < 1.07


@pytest.mark.parametrize("hold", ["zoh", "foh"])
def test_the_hold_is_divided_out(hold):
    """A mode far below half the sampling frequency: the continuous-time response is what remains."""
    at = {**MODE_AT, "z": 0.3}
    rec = simulated(MODE, at, np.random.default_rng(3).normal(size=(40_000, 1)), hold=hold)
    measured = measured_response(rec, "u", "y", intersample=hold, resolution_hz=0.02)
    low = measured.frequency_hz < 1.5
    truth = evaluate(MODE, at).frequency_response(measured.frequency_hz[low])
    assert np.abs(measured.response[low] / truth - 1).max() < 0.05
    of_samples = measured_response(rec, "u", "y", intersample=None, resolution_hz=0.02)
    part = np.abs(measured.response / of_samples.response)
    np.testing.assert_allclose(measured.std / of_samples.std, part, rtol=1e-9)  # an error is divided by the hold, too


def test_a_reference_removes_the_bias_of_a_loop():
    """Output noise drives the input: without the reference the estimate tends to minus one over the controller."""
    plant, gain = evaluate(MODE, {**MODE_AT, "z": 0.3, "g": 0.5}).discretise(H), 0.6
    random = np.random.default_rng(0)
    n = 60_000
    r, e = 0.3 * random.normal(size=n), 0.5 * random.normal(size=n)
    u, y, x = np.zeros(n), np.zeros(n), np.zeros(2)
    for k in range(n):
        y[k] = (plant.C @ x)[0] + e[k]
        u[k] = r[k] - gain * y[k]
        x = plant.A @ x + plant.B[:, 0] * u[k]
    rec = Recording({"r": r[:, None], "u": u[:, None], "y": y[:, None]}, H)
    f = np.array([0.5, 1.0, 2.0])
    truth = plant.frequency_response(f)[:, 0, 0]

    def error(**options):
        measured = measured_response(rec, "u", "y", intersample=None, resolution_hz=0.05, **options)
        return np.abs(np.interp(f, measured.frequency_hz, measured.response[:, 0, 0]) - truth)

    assert (error(reference="r") < 0.15).all()
    assert (error() > 3 * error(reference="r"))[1:].all()


def test_wrong_measurements_are_refused():
    rec = simulated(MODE, MODE_AT, levels(300), noise=0.1)
    with pytest.raises(DataError, match=r"too short for resolution_hz = 0\.01; take at least 0\.0333 Hz"):
        measured_response(rec, "u", "y", resolution_hz=0.01)
    with pytest.raises(UsageError, match=r"resolution_hz = -1\.0; give a number above 0"):
        measured_response(rec, "u", "y", resolution_hz=-1.0)
    twin = Recording({"u": np.repeat(rec.signal("u"), 2, axis=1), "y": rec.signal("y")}, H)
    with pytest.raises(DataError, match="independent"):
        measured_response(twin, "u", "y")
    with pytest.raises(UsageError, match="reference has 2 channels for 1"):
        measured_response(twin, "y", "u", reference="u")
    with pytest.raises(DataError, match="at least one"):
        measured_response([], "u", "y")
