"""Comparison of run-out maps, the online filter, missing index, and what a map leaves."""

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rig_point import machine

from gbid.core.errors import DataError, UsageError
from gbid.prefilter import (
    OnlinePrefilter,
    align_index,
    compare_runout,
    identify_runout,
    prefilter,
    runout_residual,
)
from gbid.prefilter.runout_identification import refuse_lost_index
from gbid.recording import Recording
from gbid.rig import NonSynchronous, Prbs, Stationary, record

NOISE = 30e-9
TURN = 2 * np.pi


def rig(experiment, name, pressure=5.0, speed=6000.0, seed=4, faults=None, **parts):
    conditions = {"pressure_bar": pressure, "speed_rpm": speed}
    made = machine(pressure, speed, **parts)
    return record(made, experiment, conditions=conditions, seed=seed, name=name, faults=faults)


def table(amplitudes, noise=NOISE, speed_rpm=5900.0, n=5000, start=0.3, seed=1):
    """Stationary recording with run-out of a few orders: amplitude and phase by order, the same in x and y."""
    angle = start + speed_rpm * np.pi / 30 * 2e-4 * np.arange(n)
    p = np.zeros((n, 2))
    for order, (amplitude, phase) in amplitudes.items():
        p[:, 0] += amplitude * np.cos(order * angle + phase)
        p[:, 1] += amplitude * np.sin(order * angle + phase)
    p += noise * np.random.default_rng(seed).standard_normal(p.shape)
    phi = np.mod(angle, TURN)[:, None]
    signals = {"r": np.zeros((n, 2)), "p": p, "phi": phi}
    return Recording(signals, 2e-4, {"pressure_bar": 5.0, "speed_rpm": speed_rpm}, f"still{seed}")


# ---- comparison ----


def test_comparison_chooses_the_orders_that_are_there():
    amplitudes = {1: (3e-6, 0.2), 3: (0.5e-6, 1.0)}
    group = [table(amplitudes, start=0.4 * seed, seed=seed) for seed in range(4)]
    comparison = compare_runout(group, harmonics=(1, 2, 3, 5, 10), bins=(25, 100))
    assert (comparison.chosen.method, comparison.chosen.size) == ("harmonics", 3)
    np.testing.assert_allclose(comparison.chosen.residual_rms, NOISE, rtol=0.03)
    assert comparison.runout_map.sources == ("still0", "still1", "still2", "still3")
    assert [trial.chosen for trial in comparison.trials].count(True) == 1
    rows = comparison.rows()
    assert json.loads(json.dumps(rows)) == rows
    # orders 1 and 2 leave the third: half its amplitude squared beside the noise
    assert rows[1]["residual_rms_x"] == pytest.approx(np.hypot(0.5e-6 / np.sqrt(2), NOISE), rel=0.01)


def test_comparison_judges_on_parts_held_out():
    """By brute force: one fold by hand."""
    group = [table({1: (3e-6, 0.2)}, start=0.4 * seed, seed=seed) for seed in range(3)]
    comparison = compare_runout(group, harmonics=(2,), bins=())
    made = identify_runout(group[:2], harmonics=2)
    rest = group[2].signal("p") - made.evaluate(group[2].signal("phi")[:, 0])
    np.testing.assert_allclose(comparison.trials[0].fold_rms[2], rest.std(axis=0), rtol=1e-12)


def test_a_sharp_spot_is_better_told_by_bins():
    rng = np.random.default_rng(0)
    group = []
    for seed in range(3):
        rec = table({1: (3e-6, 0.2)}, n=20_000, start=0.4 * seed, seed=seed, noise=10e-9)
        spot = 4e-6 * np.exp(-(((rec.signal("phi") - 2.0) / 0.03) ** 2))  # an electrical spot on the disc
        group.append(rec.with_signals(p=rec.signal("p") + spot + 0 * rng.standard_normal()))
    comparison = compare_runout(group, harmonics=(5, 10), bins=(100, 400))
    assert (comparison.chosen.method, comparison.chosen.size) == ("bins", 400)


def test_one_recording_is_cut_into_stretches():
    rec = table({1: (3e-6, 0.2)})
    comparison = compare_runout(rec, harmonics=(1, 2), bins=())
    assert comparison.held_out == ("still1[0:1250]", "still1[1250:2500]", "still1[2500:3750]", "still1[3750:5000]")
    assert comparison.chosen.size == 1


def test_a_size_that_cannot_be_made_is_listed_with_its_reason():
    comparison = compare_runout(table({1: (3e-6, 0.2)}, speed_rpm=6000.0), harmonics=(3, 40), bins=())
    assert "cannot distinguish 40 harmonics" in comparison.trials[1].note
    assert np.isnan(comparison.trials[1].residual_rms).all()
    assert comparison.chosen.size == 3
    with pytest.raises(DataError, match="no run-out map can be made"):
        compare_runout(table({1: (3e-6, 0.2)}, speed_rpm=6000.0), harmonics=(40,), bins=())


def test_a_shaft_at_rest_has_its_mean_only():
    still = rig(Stationary(1.0), "still", speed=0.0)
    comparison = compare_runout(still)
    assert (comparison.chosen.method, comparison.runout_map.method) == ("mean", "mean")
    assert comparison.chosen.residual_rms == pytest.approx(still.signal("p").std(axis=0), rel=0.05)


@pytest.mark.parametrize(
    ("call", "error", "words"),
    [
        (lambda rec: compare_runout([]), UsageError, "at least one"),
        (lambda rec: compare_runout(rec, harmonics=(), bins=()), UsageError, "nothing to compare"),
        (lambda rec: compare_runout(rec, folds=1), UsageError, "at least 2"),
        (lambda rec: compare_runout(rec.slice(0, 300)), DataError, "too few for 4 stretches"),
    ],
)
def test_wrong_comparisons_are_named(call, error, words):
    with pytest.raises(error, match=words):
        call(table({1: (3e-6, 0.2)}))


# ---- what is left ----


def test_runout_residual_measures_noise_and_a_line_beside_it():
    rec = table({1: (3e-6, 0.2)}, n=25_000)
    whirl = 0.4e-6 * np.cos(TURN * 47.0 * rec.time)
    shifted = rec.with_signals(p=rec.signal("p") + np.column_stack([whirl, 0 * whirl]))
    left = runout_residual(identify_runout(rec), shifted)
    np.testing.assert_allclose(left.noise, NOISE, rtol=0.03)
    assert left.frequency_hz[0] == pytest.approx(47.0, abs=0.2)
    assert left.order[0] == pytest.approx(47.0 * 60 / 5900, rel=0.01)
    np.testing.assert_allclose(left.order, left.frequency_hz * 60 / 5900, rtol=1e-6)
    assert left.non_synchronous[0] == pytest.approx(0.4e-6 / np.sqrt(2), rel=0.01)
    assert left.line_rms[0] == pytest.approx(0.4e-6 / np.sqrt(2), rel=0.01)
    assert left.over_noise[1] == pytest.approx(1.0, abs=0.03)
    np.testing.assert_allclose(left.non_synchronous, np.sqrt(np.maximum(left.rms**2 - left.noise**2, 0.0)), rtol=1e-9)


def test_at_4000_rpm_the_orbit_wanders_and_much_is_left():
    """Sec. 4: small deviations in the orbit, so that no filter over the angle can eliminate the response."""
    left = {}
    for speed in (4000.0, 6000.0):
        first, second = (
            rig(Stationary(2.0), name, speed=speed, seed=1, non_synchronous=NonSynchronous()) for name in "ab"
        )
        left[speed] = runout_residual(identify_runout(first), second)
    assert left[4000.0].over_noise.min() > 2.0
    assert left[4000.0].non_synchronous.min() > 3 * left[6000.0].non_synchronous.max()


# ---- online ----


@pytest.mark.parametrize(("method", "median"), [("harmonics", 1), ("bins", 3), ("harmonics", 7)])
def test_online_is_the_offline_filter_bit_for_bit(method, median):
    still, excited = rig(Stationary(0.5), "still"), rig(Prbs(0.5), "prbs")
    made = identify_runout(still, method=method, harmonics=15)
    offline, report = prefilter(excited, made, median=median)
    online = OnlinePrefilter(made, offset=report.offsets["p"], median=median)
    values = zip(excited.signal("p"), excited.signal("phi")[:, 0], strict=True)
    results = [online.step(p, phi) for p, phi in values]
    assert results[: online.delay] == [None] * online.delay
    delayed = results[online.delay :] + online.finish()
    assert np.array_equal(np.array(delayed), offline.signal("p"))
    assert online.delay == median // 2


@settings(deadline=None, max_examples=30)
@given(values=st.lists(st.floats(-1e3, 1e3), min_size=7, max_size=30), half=st.integers(0, 3))
def test_online_median_alone(values, half):
    rec = Recording({"p": np.array(values)[:, None]}, 1.0)
    offline, _ = prefilter(rec, median=2 * half + 1, remove_mean=False)
    online = OnlinePrefilter(None, median=2 * half + 1)
    results = [online.step([value], None) for value in values]
    assert np.array_equal(np.array(results[half:] + online.finish()), offline.signal("p"))


def test_online_refuses_a_bad_sample_and_goes_on():
    made = identify_runout(rig(Stationary(0.5), "still"))
    online = OnlinePrefilter(made, median=1)
    first = online.step([1e-6, 2e-6], 0.3)
    for position, angle in (([np.nan, 0.0], 0.3), ([0.0], 0.3), ([0.0, 0.0], None)):
        with pytest.raises(DataError):
            online.step(position, angle)
    assert np.array_equal(online.step([1e-6, 2e-6], 0.3 + 0.0), first)
    with pytest.raises(UsageError, match="odd"):
        OnlinePrefilter(made, median=2)
    with pytest.raises(UsageError, match="offset"):
        OnlinePrefilter(made, offset=[0.0])


# ---- index ----


@pytest.mark.parametrize("experiment", [Stationary(2.0), Prbs(2.0)], ids=["still", "excited"])
@pytest.mark.parametrize("method", ["harmonics", "bins"])
def test_missing_index_is_found_from_the_run_out(experiment, method):
    made = identify_runout(rig(Stationary(2.0), "still"), method=method)
    rec = rig(experiment, "other")
    shift = 2.1
    lost = rec.with_signals(phi=np.mod(rec.signal("phi") - shift, TURN))
    alignment = align_index(made, lost)
    assert alignment.sure
    # An encoder count is 1.5 mrad; half of it may be off by the map's own entries.
    assert abs(alignment.offset - shift) < 5 * alignment.std + 0.8e-3
    aligned = alignment.apply(lost)
    assert "degrees added to phi" in aligned.provenance["index"]
    true, _ = prefilter(rec, made, median=1)
    ours, _ = prefilter(aligned, made, median=1)
    assert np.abs(ours.signal("p") - true.signal("p")).max() < 30e-9
    with pytest.raises(DataError, match="but rotated by"):
        refuse_lost_index(made, lost)
    refuse_lost_index(made, rec)
    # not aligned, the map does harm instead
    assert prefilter(lost, made)[1].runout_share.max() < prefilter(rec, made)[1].runout_share.min()


def test_std_of_the_offset_is_honest():
    """Scatter of the estimate over recordings with known offset."""
    amplitudes = {1: (0.5e-6, 0.2), 2: (0.2e-6, 1.0)}
    made = identify_runout(table(amplitudes, n=100_000, noise=1e-9))
    errors, stds = [], []
    for seed in range(40):
        alignment = align_index(made, table(amplitudes, n=4000, noise=200e-9, seed=seed))
        errors.append((alignment.offset + np.pi) % TURN - np.pi)
        stds.append(alignment.std)
    assert 0.7 < np.std(errors) / np.mean(stds) < 1.4


def test_run_out_alike_after_half_a_turn_is_not_sure():
    only_second = {2: (2e-6, 0.4)}
    made = identify_runout(table(only_second))
    alignment = align_index(made, table(only_second, seed=2))
    assert not alignment.sure
    assert abs(abs(alignment.offset - alignment.next_best) - np.pi) < 0.01
    with pytest.raises(DataError, match="does not determine the missing index"):
        alignment.apply(table(only_second))


def test_another_machines_map_is_not_sure():
    made = identify_runout(table({1: (2e-6, 0.4), 2: (1e-6, 0.0), 3: (1e-6, 1.0)}))
    alignment = align_index(made, table({4: (2e-6, 0.4), 5: (1e-6, 0.2)}, seed=2))
    assert alignment.explained < 0.5
    assert not alignment.sure


@pytest.mark.parametrize(
    ("call", "error", "words"),
    [
        (lambda made, rec: align_index(made, rec, orders=0), UsageError, "at least 1"),
        (lambda made, rec: align_index(made, rec.slice(0, 200)), DataError, "too few to find the index"),
        (lambda made, rec: align_index(replace(made, method="mean"), rec), UsageError, "at rest"),
        (lambda made, rec: align_index(replace(made, channels=("a", "b")), rec), DataError, "channels"),
    ],
)
def test_wrong_alignments_are_named(call, error, words):
    rec = table({1: (2e-6, 0.4)})
    with pytest.raises(error, match=words):
        call(identify_runout(rec), rec)
