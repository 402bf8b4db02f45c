"""Spikes are found where they are, and nothing else is touched."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.signal import lfilter

from gbid.prefilter.filtering import ONE_SIDED, remove_spikes, repair_overloads
from gbid.recording import Recording

TS = 2e-4
NOISE = 30e-9


def wave(n=5000, noise=NOISE, seed=0):
    """The disc: 10 um at 125 Hz and 5 um at 131 Hz, with white noise."""
    t = TS * np.arange(n)
    clean = np.column_stack([10e-6 * np.cos(2 * np.pi * 125 * t), 5e-6 * np.sin(2 * np.pi * 131 * t)])
    return clean, clean + noise * np.random.default_rng(seed).standard_normal(clean.shape)


def test_clean_data_are_left_alone():
    for seed in range(20):
        for noise in (NOISE, 0.65e-6):
            _, values = wave(25_000, noise, seed)
            cleaned = remove_spikes(values)
            np.testing.assert_array_equal(cleaned.values, values)
            assert [len(samples) for samples in cleaned.samples] == [0, 0]


@pytest.mark.parametrize(("run", "size"), [(1, 0.5e-6), (1, -2e-6), (1, 50e-6), (2, 2e-6), (3, -2e-6), (3, 50e-6)])
def test_spikes_are_found_and_replaced(run, size):
    clean, values = wave()
    where = np.concatenate([np.arange(start, start + run) for start in (7, 700, 1234, 1250, 4000, 4993 - run)])
    spiked = values.copy()
    spiked[where, 0] += size
    cleaned = remove_spikes(spiked)
    np.testing.assert_array_equal(cleaned.samples[0], where)
    assert len(cleaned.samples[1]) == 0
    untouched = np.delete(np.arange(len(values)), where)
    np.testing.assert_array_equal(cleaned.values[untouched], values[untouched])
    np.testing.assert_array_equal(cleaned.values[:, 1], values[:, 1])
    # A bridge over three samples carries up to 2.1 times the noise of one sample.
    assert np.abs(cleaned.values[where, 0] - clean[where, 0]).max() < 4 * 2.1 * NOISE


@given(start=st.integers(7, 490), size=st.sampled_from([-1.0, 1.0]), seed=st.integers(0, 100))
def test_one_spike_anywhere(start, size, seed):
    _, values = wave(500, seed=seed)
    spiked = values.copy()
    spiked[start, 0] += 1e-6 * size
    np.testing.assert_array_equal(remove_spikes(spiked).samples[0], [start])


@pytest.mark.parametrize("size", [10, 20, 40, 80, 120, 200, 400])
def test_steps_and_kinks_of_any_size_stay(size):
    """In units of the noise: a velocity under a switched force has kinks, a position after a fall has steps."""
    n = 2000
    ramp = np.clip(np.arange(n) - 1000, 0, None)
    for seed in range(5):
        noise = np.random.default_rng(seed).standard_normal(n)
        for clean in (size * (ramp > 0), size * ramp, size * np.abs(np.arange(n) % 50 - 25)):
            values = (clean + noise)[:, None]
            np.testing.assert_array_equal(remove_spikes(values).values, values)


def test_kinks_of_clean_signals_stay():
    """Without noise the errors of smooth stretches are rounding; those of kinks are no spikes."""
    rng = np.random.default_rng(2)
    force = np.repeat(rng.choice([-1.0, 1.0], 400), 7)
    velocity = lfilter([0.05], [1, -0.95], force)
    for values in (force, velocity, np.cumsum(velocity)):
        np.testing.assert_array_equal(remove_spikes(values[:, None]).values[:, 0], values)


def test_a_coarse_converter_is_no_spike():
    _, values = wave(noise=0.0)
    quantum = 0.3e-6
    coarse = np.round(values / quantum) * quantum
    np.testing.assert_array_equal(remove_spikes(coarse).values, coarse)
    at_rest = np.zeros((1000, 1))
    at_rest[::100] = quantum  # one bit now and then
    np.testing.assert_array_equal(remove_spikes(at_rest).values, at_rest)


def test_spikes_smaller_than_the_limit_stay():
    """The larger limit is that of one side: the error of its cubic is 3.07 standard deviations of the noise."""
    _, values = wave()
    limit = ONE_SIDED * 3.07 * NOISE
    for share, expected in ((0.6, 0), (1.4, 1)):
        spiked = values.copy()
        spiked[1000, 0] += share * limit
        assert len(remove_spikes(spiked).samples[0]) == expected


@pytest.mark.parametrize("n", [0, 1, 4, 14, 15])
def test_short_signals_have_no_neighbours_to_ask(n):
    values = np.full((n, 2), 3.0)
    np.testing.assert_array_equal(remove_spikes(values).values, values)


@pytest.mark.parametrize("wrong", [9999e-6, -1e31, 32.767e-6])
@pytest.mark.parametrize(("first", "count"), [(1000, 1), (1001, 2), (999, 3), (0, 1), (1999, 1), (1500, 2)])
def test_overloads_are_replaced_beside_a_sharp_step_and_at_the_ends(first, count, wrong):
    random = np.random.default_rng(first)
    clean = np.repeat(random.choice([-4e-6, 4e-6], (20, 2)), 100, axis=0) + NOISE * random.standard_normal((2000, 2))
    clean[900:1000, 0], clean[1000:1100, 0] = -4e-6, 4e-6  # a step at sample 1000
    spoilt = clean.copy()
    spoilt[first : first + count, 0] = wrong
    repaired = repair_overloads(Recording({"u": clean, "p": spoilt}, TS, units={"u": "m", "p": "m"}))
    np.testing.assert_allclose(repaired.signal("p"), clean, atol=8.1e-6)
    untouched = np.delete(np.arange(2000), np.arange(first, first + count))
    np.testing.assert_array_equal(repaired.signal("p")[untouched], clean[untouched])
    np.testing.assert_array_equal(repaired.signal("u"), clean)
    words = f"{count} overload{'s' * (count > 1)} of p_x replaced, up to {wrong:g} m, the first at sample {first}"
    assert repaired.provenance["import_remarks"] == words


def test_what_may_be_a_motion_is_no_overload():
    clean, _ = wave(2000)
    pulse, long, rest = clean.copy(), clean.copy(), np.zeros((2000, 2))
    pulse[500, 0] = 2.9 * np.abs(clean[:, 0]).max()
    long[500:504, 0] = 1.0  # a run of four
    rest[500, 0] = 1e-9  # one step of the converter
    for values in (clean, pulse, long, rest):
        rec = Recording({"u": clean, "p": values}, TS)
        assert repair_overloads(rec) is rec


def test_spikes_near_the_noise_stay():
    """As docs/limits.md says: none below twelve standard deviations is found, half at sixteen, nearly all at twenty."""
    where = np.arange(100, 4900, 100)
    shares = []
    for size in (11, 16, 20):
        _, values = wave()
        values[where, 0] += size * NOISE
        shares.append(np.isin(where, remove_spikes(values).samples[0]).mean())
    assert shares[0] == 0.0
    assert 0.35 < shares[1] < 0.75
    assert shares[2] > 0.9
