"""The prefilter against known run-out, the virtual rig and statistics."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rig_point import actuator, rotor_bearing

from gbid.core.errors import DataError, UsageError
from gbid.prefilter import identify_runout, prefilter
from gbid.prefilter.runout import running_median
from gbid.recording import Recording
from gbid.rig import Machine, Prbs, SensorChain, Stationary, Unbalance, record

TS = 2e-4
FIG7 = {"pressure_bar": 5.0, "speed_rpm": 6000.0}
AT_REST = {"pressure_bar": 5.0, "speed_rpm": 0.0}
NOISE = 30e-9
AMPLITUDES = 1e-6 * np.array([[3.0, 2.0], [1.0, 0.5], [0.0, 0.2]])  # orders down, x and y across
PHASES = np.array([[0.3, -1.0], [2.0, 0.4], [0.0, 1.1]])


def rig_recording(experiment, name, conditions=FIG7, **machine):
    return record(
        Machine(rotor_bearing(**conditions), actuator(), **machine),
        experiment,
        conditions=conditions,
        seed=11,
        name=name,
    )


def known(n_samples=5000, speed_rpm=5900.0, start=0.5, noise=0.0, mean=(4e-6, -2e-6), counts=None, **changes):
    """Stationary recording with the harmonics above."""
    angle = start + speed_rpm * np.pi / 30 * TS * np.arange(n_samples)
    p = np.tile(np.array(mean), (n_samples, 1))
    for order, (a, phase) in enumerate(zip(AMPLITUDES, PHASES, strict=True), start=1):
        p = p + a * np.cos(order * angle[:, None] + phase)
    p += noise * np.random.default_rng(int(start * 1000)).standard_normal(p.shape)
    phi = np.mod(angle, 2 * np.pi)
    if counts:
        phi = np.floor(phi / (2 * np.pi) * counts) / counts * 2 * np.pi
    signals = {"r": np.zeros_like(p), "u": np.zeros_like(p), "p": p, "phi": phi[:, None]}
    settings = {"conditions": {"pressure_bar": 5.0, "speed_rpm": speed_rpm}, "name": "still", **changes}
    return Recording(signals, TS, **settings)


# ---- the map ----


def test_known_harmonics_come_back():
    made = identify_runout(known(), harmonics=6)
    np.testing.assert_allclose(made.mean, [4e-6, -2e-6], atol=1e-15)
    np.testing.assert_allclose(made.amplitudes(), np.vstack([AMPLITUDES, np.zeros((3, 2))]), atol=1e-15)
    np.testing.assert_allclose(made.rms_after, 0, atol=1e-15)
    np.testing.assert_allclose(made.rms_before, np.sqrt((AMPLITUDES**2).sum(axis=0) / 2), rtol=1e-2)
    assert (made.method, made.sources, made.channels) == ("harmonics", ("still",), ("x", "y"))
    assert made.turns == pytest.approx(5900 / 60, rel=1e-3)


def test_a_clipped_position_and_a_lost_index_are_named():
    """A lost index turns the map from there on: the run-out that it leaves is as large as the run-out."""
    rec = known()
    clipped = replace(rec, signals={**rec.signals, "p": np.clip(rec.signal("p"), None, 6e-6)})
    phi = rec.signal("phi").copy()
    phi[2500:] = np.mod(phi[2500:] + 1.1, 2 * np.pi)
    slipped = replace(rec, signals={**rec.signals, "phi": phi}, conditions={})
    for signals, code in ((clipped, "GB209"), (slipped, "GB210")):
        assert any(code in note for note in identify_runout(signals).notes)
        assert any(code in note for note in prefilter(signals, identify_runout(rec), any_condition=True)[1].notes)
    assert not identify_runout(rec).notes


def test_bins_find_the_same_run_out_without_knowing_its_orders():
    made = identify_runout(known(), method="bins", bins=200)
    np.testing.assert_allclose(made.amplitudes(3), AMPLITUDES, atol=2e-9)
    np.testing.assert_allclose(made.mean, [4e-6, -2e-6], atol=2e-9)
    assert made.rms_after.max() < 5e-9


@pytest.mark.parametrize("method", ["harmonics", "bins"])
def test_several_recordings_share_one_map_with_the_mean_of_their_means(method):
    group = [known(start=0.2, mean=(1e-6, 0), noise=NOISE), known(start=3.0, mean=(3e-6, 2e-6), noise=NOISE)]
    made = identify_runout(group, method=method)
    np.testing.assert_allclose(made.mean, [2e-6, 1e-6], atol=3e-9)
    np.testing.assert_allclose(made.amplitudes(3)[:3], AMPLITUDES, atol=6e-9)
    np.testing.assert_allclose(made.rms_after, NOISE, rtol=0.1)


@pytest.mark.parametrize("method", ["harmonics", "bins"])
@settings(deadline=None)
@given(angle=st.floats(0, 2 * np.pi), turns=st.integers(-3, 3))
def test_the_map_repeats_every_turn(method, angle, turns):
    made = _MAPS[method]
    here, turned = made.evaluate(np.array([angle, angle + turns * 2 * np.pi]))
    np.testing.assert_allclose(here, turned, atol=1e-13)


_MAPS = {method: identify_runout(known(), method=method) for method in ("harmonics", "bins")}


def test_map_has_no_step_where_the_angle_wraps():
    for made in _MAPS.values():
        before, after = made.evaluate(np.array([2 * np.pi - 1e-9, 0.0]))
        np.testing.assert_allclose(before, after, atol=1e-13)


def test_error_of_a_coarse_encoder_is_slope_times_half_a_count():
    counts = 64
    rec = known(counts=counts)
    made = identify_runout(rec)
    slope = np.sqrt(((AMPLITUDES * np.arange(1, 4)[:, None]) ** 2).sum(axis=0) / 2)
    np.testing.assert_allclose(made.rms_after, slope * 2 * np.pi / counts / np.sqrt(12), rtol=0.1)


@pytest.mark.parametrize("method", ["harmonics", "bins"])
def test_rig_at_6000_rpm_keeps_its_sensor_noise_only(method):
    still, other = (rig_recording(Stationary(2.0), name) for name in ("still", "other"))
    made = identify_runout(still, method=method)
    assert made.rms_before.min() > 2e-6
    assert made.rms_after.max() < 1.2 * NOISE
    limit = 1.2 if method == "harmonics" else 1.6  # another start angle falls between the table's entries
    filtered, report = prefilter(other, made, median=1)
    assert report.map_sources == made.sources == ("still",)
    assert "median" not in filtered.provenance["prefilter"]
    assert filtered.signal("p").std(axis=0).max() < limit * NOISE
    assert report.runout_share.min() > 0.999


def test_run_out_and_unbalance_are_told_apart_from_the_response_to_the_piezos():
    made = identify_runout(rig_recording(Stationary(2.0), "still"))
    bare = SensorChain(
        noise_p_m=0.0, noise_u_m=0.0, runout_amplitude_m=np.zeros((2, 0)), runout_phase_rad=np.zeros((2, 0))
    )
    clean = rig_recording(Prbs(2.0), "prbs", sensors=bare, unbalance=Unbalance(0.0))
    raw = rig_recording(Prbs(2.0), "prbs")
    filtered, report = prefilter(raw, made, median=1)
    wanted = clean.signal("p") - clean.signal("p").mean(axis=0)
    assert wanted.std() > 2e-6
    assert (filtered.signal("p") - wanted).std(axis=0).max() < 1.2 * NOISE
    assert np.abs(filtered.signal("u").mean(axis=0)).max() < 1e-18
    np.testing.assert_array_equal(filtered.signal("phi"), raw.signal("phi"))
    np.testing.assert_allclose(report.rms_after["p"], wanted.std(axis=0), rtol=1e-3)


def test_shaft_at_rest_gives_the_mean_and_says_so():
    made = identify_runout(rig_recording(Stationary(1.0), "still", AT_REST))
    assert made.method == "mean"
    assert not made.needs_angle
    assert made.amplitudes().shape == (0, 2)
    np.testing.assert_allclose(made.rms_after, NOISE, rtol=0.1)
    filtered, report = prefilter(rig_recording(Prbs(1.0), "prbs", AT_REST), made)
    assert any("stood still" in note for note in report.notes)
    np.testing.assert_allclose(filtered.signal("p").mean(axis=0), 0, atol=2e-9)


# ---- offsets, median, report ----


def test_report_says_what_was_taken_out_and_raw_data_can_be_rebuilt():
    made, raw = identify_runout(known(noise=NOISE)), known(start=1.0, noise=NOISE, name="b")
    raw = raw.with_signals(u=raw.signal("u") + np.array([1e-6, 2e-6]), r=raw.signal("r") + np.array([3e-6, 0.0]))
    filtered, report = prefilter(raw, made, median=1)
    rebuilt = filtered.signal("p") + made.evaluate(raw.signal("phi")[:, 0]) + report.offsets["p"]
    np.testing.assert_allclose(rebuilt, raw.signal("p"), atol=1e-18)
    np.testing.assert_allclose(report.offsets["u"], [1e-6, 2e-6])
    np.testing.assert_allclose(report.offsets["r"], [3e-6, 0.0], atol=1e-20)
    np.testing.assert_allclose(report.rms_before["p"], raw.signal("p").std(axis=0))
    np.testing.assert_allclose(report.rms_after["p"], NOISE, rtol=0.1)
    np.testing.assert_allclose(report.harmonics[:3], AMPLITUDES, atol=3e-9)
    share = 1 - NOISE**2 / raw.signal("p").var(axis=0)
    np.testing.assert_allclose(report.runout_share, share, atol=1e-4)
    assert "run-out map (harmonics) of still" in filtered.provenance["prefilter"]
    assert "means of r, u, p removed" in filtered.provenance["prefilter"]
    assert raw.provenance == {}


def test_nothing_asked_for_changes_nothing():
    raw = known(noise=NOISE)
    filtered, report = prefilter(raw, median=1, remove_mean=False)
    for name, values in raw.signals.items():
        np.testing.assert_array_equal(filtered.signal(name), values)
    assert not report.offsets["p"].any()
    assert report.harmonics.shape == (0, 2)
    assert report.spikes == (0, 0)


def test_signals_that_are_missing_are_left_out():
    raw = known()
    only_p = replace(raw, signals={"p": raw.signal("p")}, units={}, channels={})
    filtered, report = prefilter(only_p)
    assert set(filtered.signals) == set(report.offsets) == {"p"}


@settings(deadline=None)
@given(st.lists(st.floats(-1, 1), min_size=7, max_size=30), st.sampled_from([1, 3, 5, 7]))
def test_median_matches_its_definition_and_keeps_the_ends(values, size):
    signal = np.array([values, values[::-1]]).T
    filtered, half = running_median(signal, size), size // 2
    for k in range(len(signal)):
        inside = half <= k < len(signal) - half
        wanted = np.median(signal[k - half : k + half + 1], axis=0) if inside else signal[k]
        np.testing.assert_array_equal(filtered[k], wanted)


def test_median_colours_noise_and_cuts_crests_as_documented():
    noise = np.random.default_rng(0).standard_normal((400_000, 1))
    filtered = running_median(noise, 3)[:, 0]
    lags = [np.mean(filtered[k:] * filtered[: len(filtered) - k]) for k in range(4)]
    np.testing.assert_allclose(lags[0], 0.449, atol=0.005)
    np.testing.assert_allclose(np.array(lags[1:]) / lags[0], [0.553, 0.263, 0.0], atol=0.01)
    wave = 10e-6 * np.cos(2 * np.pi * 125 * TS * np.arange(400))[:, None]
    cut = np.abs(running_median(wave, 3) - wave).max()
    assert cut == pytest.approx(10e-6 * (2 * np.pi * 125 * TS) ** 2 / 2, rel=0.02)


# ---- the file ----


# ---- bad input ----


def without(rec, *names):
    kept = {name: values for name, values in rec.signals.items() if name not in names}
    return replace(rec, signals=kept, units={}, channels={})


def moving(signal):
    rec = known()
    values = np.array(rec.signal(signal))
    values[1000:1100, 1] += 4.5e-6
    return rec.with_signals(**{signal: values})


def test_a_spike_in_u_is_no_movement_but_a_step_is():
    rec = known()
    u = np.array(rec.signal("u"))
    u[500, 0] = 5e-6
    assert identify_runout(rec.with_signals(u=u)).method == "harmonics"
    made = identify_runout(without(rec, "r", "u"))
    text = "still: neither r nor u is recorded, so it was not checked that the piezos were at rest [GB202]"
    assert made.notes == (text,)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: identify_runout(moving("r")), "recording 'still': r_y moves by 4.50 um"),
        (lambda: identify_runout(moving("u")), "recording 'still': u_y moves by 4.50 um"),
        (lambda: identify_runout(without(known(), "p")), "has no signal 'p'"),
        (lambda: identify_runout(without(known(), "phi")), "has no signal 'phi'"),
        (lambda: identify_runout(known(n_samples=40)), "0.77 of a turn"),
        (lambda: identify_runout(known(n_samples=60), harmonics=40), "60 samples cannot determine 40"),
        (lambda: identify_runout(known(speed_rpm=6000.0), harmonics=25), "cannot distinguish 25 harmonics"),
        (lambda: identify_runout(known(speed_rpm=30000.0), method="bins"), "36 degrees"),
        (
            lambda: identify_runout(known(conditions={"speed_rpm": 4000.0})),
            "phi turns at 5900.0 rpm, but speed_rpm = 4000",
        ),
        (
            lambda: identify_runout([known(), known(speed_rpm=4000.0, name="b")]),
            "recordings 'still' and 'b' differ in channels or conditions",
        ),
        (
            lambda: identify_runout([known(conditions={}), known(conditions={}, speed_rpm=0.0, name="b")]),
            "some turn and some stand still",
        ),
        (lambda: prefilter(without(known(), "p")), "has no signal 'p'"),
        (lambda: prefilter(without(known(), "phi"), _MAPS["bins"]), "has no signal 'phi'"),
        (lambda: prefilter(known(speed_rpm=4000.0, name="b"), _MAPS["bins"]), "'b': speed_rpm = 4000.0, but"),
        (lambda: prefilter(known(conditions={}), _MAPS["bins"]), "pressure_bar = None, but"),
        (
            lambda: prefilter(Recording({"p": np.zeros((9, 1))}, TS, channels={"p": ("x",)}), _MAPS["bins"]),
            "p has the channels x, the run-out map x, y",
        ),
    ],
)
def test_bad_data_is_one_clear_line(call, words):
    with pytest.raises(DataError, match=words) as caught:
        call()
    assert "\n" not in str(caught.value)


def test_map_of_another_point_can_be_allowed_and_is_noted():
    _, report = prefilter(known(speed_rpm=4000.0, name="b"), _MAPS["harmonics"], any_condition=True)
    assert any("speed_rpm = 4000.0, but the run-out map was made at 5900.0" in note for note in report.notes)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: prefilter(known(), median=2), "median = 2"),
        (lambda: prefilter(known(), median=0), "median = 0"),
        (lambda: prefilter(known(n_samples=4), median=5), "longer than the 4 samples"),
        (lambda: identify_runout(known(), method="spline"), "method = 'spline'"),
        (lambda: identify_runout(known(), harmonics=0), "harmonics = 0"),
        (lambda: identify_runout([]), "no stationary recording"),
    ],
)
def test_wrong_arguments_are_named(call, words):
    with pytest.raises(UsageError, match=words):
        call()
