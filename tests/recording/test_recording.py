"""The data object and the checks of its quality."""

import copy
import pickle

import numpy as np
import pytest

import gbid
from gbid.core.errors import DataError
from gbid.recording import Recording, find_problems

N = 200
RNG = np.random.default_rng(1)


def make(n=N, **signals):
    noise = np.random.default_rng(2).standard_normal((n, 2))
    units = {"p": "m", "u": "m", "phi": "rad"}
    return Recording({"p": noise, **signals}, 2e-4, {"pressure_bar": 6}, name="a", units=units)


def test_signals_have_the_given_units_and_the_rigs_channels():
    rec = make(phi=np.linspace(0, 1, N)[:, None], mine=np.ones((N, 3)))
    assert dict(rec.units) == {"p": "m", "phi": "rad", "mine": ""}
    assert dict(rec.channels) == {"p": ("x", "y"), "phi": ("phi",), "mine": ("1", "2", "3")}
    assert Recording({"u": np.ones((N, 1))}, 1.0).channels["u"] == ("1",)  # another rig's u
    assert rec.n_samples == N
    assert rec.duration == pytest.approx(0.04)
    np.testing.assert_array_equal(rec.time, 2e-4 * np.arange(N))


def test_it_cannot_be_changed_from_outside():
    values = RNG.standard_normal((N, 2))
    rec = Recording({"p": values}, 1.0)
    values[0, 0] = 7.0
    assert rec.signals["p"][0, 0] != 7.0
    with pytest.raises(ValueError, match="read-only"):
        rec.signals["p"][0, 0] = 7.0
    with pytest.raises(TypeError):
        rec.signals["u"] = values


@pytest.mark.parametrize("again", [lambda r: pickle.loads(pickle.dumps(r)), copy.deepcopy, copy.copy])
def test_copies_are_equal_and_as_read_only(again):
    rec = make()
    other = again(rec)
    np.testing.assert_array_equal(other.signals["p"], rec.signals["p"])
    for key in ("sample_time", "name", "conditions", "units", "channels", "provenance"):
        assert getattr(other, key) == getattr(rec, key)
    with pytest.raises(ValueError, match="read-only"):
        other.signals["p"][0, 0] = 7.0
    with pytest.raises(TypeError):
        other.conditions["x"] = 1.0


def test_slice_and_with_signals():
    rec = make()
    part = rec.slice(10, 30, name="part")
    np.testing.assert_array_equal(part.signals["p"], rec.signals["p"][10:30])
    assert part.name == "part"
    assert part.conditions == rec.conditions
    assert rec.slice(150).n_samples == 50
    more = rec.with_signals(u=np.ones((N, 2), dtype=int))
    assert more.signals["u"].dtype == float
    assert "u" not in rec.signals
    for start, stop in [(-1, 5), (5, 5), (7, 5), (0, N + 1)]:
        with pytest.raises(DataError, match="are not within its 200 samples"):
            rec.slice(start, stop)
    with pytest.raises(DataError, match="no signal 'q'; it has p"):
        rec.signal("q")


INFINITE = RNG.standard_normal((N, 2))
INFINITE[17, 1] = np.inf


@pytest.mark.parametrize(
    ("values", "words"),
    [
        (np.ones((2, N)), "more channels than samples"),
        (np.ones((N, 2, 1)), "(n_samples, n_channels)"),
        (np.ones((0, 2)), "empty"),
        (INFINITE, "the first inf at sample 17, channel 1"),
        (np.column_stack([np.ones(N), np.full(N, np.nan)]), "all samples of channel 1 are missing"),
        (np.ones((N, 2)) * 1j, "real numbers"),
        (np.full((N, 2), "1.0"), "real numbers"),
        ([[1.0, 2.0], [3.0]], "real numbers"),
        (np.full((N, 2), None), "real numbers"),
        (np.zeros((N, 2), dtype="datetime64[s]"), "real numbers"),
    ],
)
def test_bad_signals_are_refused(values, words):
    with pytest.raises(DataError) as caught:
        Recording({"p": values}, 1.0, name="a")
    text = str(caught.value)
    assert text.startswith("recording 'a': signal 'p'")
    assert words in text


def test_missing_samples_are_counted_refused_by_default_and_held_on_demand(tmp_path):
    p = RNG.standard_normal((N, 2))
    p[17, 1] = p[40:43, 0] = np.nan
    rec = Recording({"p": p, "u": np.ma.masked_greater(np.arange(float(N)), 190.0)}, 1.0, name="a")
    assert rec.missing == {"p": 4, "u": 9}
    assert "4 missing" in str(rec)
    with pytest.raises(DataError, match="4 samples of signal 'p' are missing, the first at sample 17, channel 1"):
        rec.signal("p")
    np.testing.assert_array_equal(rec.signal("p", gaps=True), p)
    held = rec.held("p", "u")
    assert not held.missing
    assert held.signal("p")[17, 1] == p[16, 1]
    assert set(held.signal("p")[39:43, 0]) == {p[39, 0]}
    assert held.signal("u")[-1] == 190
    with pytest.raises(DataError, match="the first sample of signal 'p' is missing"):
        rec.slice(17).held("p")
    gbid.save_recording(rec, tmp_path / "a.h5")
    assert gbid.load_recording(tmp_path / "a.h5").missing == rec.missing


def test_other_bad_contents_are_refused():
    good = {"p": np.ones((N, 2))}
    for sample_time in (0, -1, np.nan, np.inf, "1", None, [1.0]):
        with pytest.raises(DataError, match="sample_time"):
            Recording(good, sample_time)
    assert Recording(good, np.array(0.5)).sample_time == 0.5
    for value in (np.nan, "6", None):
        with pytest.raises(DataError, match="pressure_bar"):
            Recording(good, 1.0, {"pressure_bar": value})
    for name in ("", "a/b", ".", "time", 3):
        with pytest.raises(DataError, match="cannot name"):
            Recording({name: np.ones((N, 1))}, 1.0)
    with pytest.raises(DataError, match="different numbers of samples: p 200, u 199"):
        Recording({**good, "u": np.ones((N - 1, 2))}, 1.0)
    with pytest.raises(DataError, match=r"signal 'p' has 2 channels, expected 3 \(a, b, c\)"):
        Recording(good, 1.0, channels={"p": ("a", "b", "c")})
    with pytest.raises(DataError, match="no signals"):
        Recording({}, 1.0)


def kinds(rec, signals=None):
    return [(p.signal, p.channel, p.kind) for p in find_problems(rec, signals)]


def test_a_sound_recording_has_no_problems():
    prbs = np.repeat(RNG.choice([-1e-6, 1e-6], size=(N // 10, 2)), 10, axis=0)
    assert kinds(make(r=prbs)) == []


def test_constant_channels_are_named():
    rec = make(u=np.column_stack([np.full(N, 3e-6), RNG.standard_normal(N)]), phi=np.zeros((N, 1)))
    assert kinds(rec) == [("u", "x", "constant"), ("phi", "phi", "constant")]
    assert kinds(rec, ["u", "p"]) == [("u", "x", "constant")]
    text = find_problems(rec)[0].text
    assert "recording 'a': signal 'u' channel 'x' is constant: all 200 samples are 3e-06 m" in text


def test_too_few_samples():
    assert kinds(make(n=99)) == [("", "", "too_few_samples")]
    assert kinds(make(n=100)) == []
    assert "has 99 samples, at least 100" in find_problems(make(n=99))[0].text


def band_noise(n=5000):
    """Noise that stays above a limit for several samples."""
    return np.convolve(np.random.default_rng(3).standard_normal(n), np.hanning(40) / 4, mode="same")


@pytest.mark.parametrize(("low", "high", "at"), [(-9, 1.5, "1.5"), (-1.5, 9, "-1.5"), (-1.5, 1.5, "-1.5 m and 1.5 m")])
def test_clipped_channels_are_saturated(low, high, at):
    wave = band_noise()
    rec = make(n=len(wave), u=np.column_stack([wave, np.clip(wave, low, high)]))
    (problem,) = find_problems(rec, ["u"])  # p is noise without relation to u, which is another problem
    assert (problem.signal, problem.channel, problem.kind) == ("u", "y", "saturated")
    share = np.mean((wave <= low) | (wave >= high))
    assert share > 0.02
    assert f"limit {at}" in problem.text
    assert problem.text.count(".") >= 1
    assert problem.text.endswith(".")


def test_short_or_rare_stays_are_no_saturation():
    wave = band_noise()
    rare = wave.copy()
    rare[100:140] = 50.0  # 0.8 % of the samples
    assert kinds(make(n=len(wave), u=np.column_stack([wave, rare])), ["u"]) == []
    rare[100:160] = 50.0
    assert kinds(make(n=len(wave), u=np.column_stack([wave, rare])), ["u"]) == [("u", "y", "saturated")]
    white = np.random.default_rng(4).standard_normal((5000, 2))  # above the limit for one sample at a time
    white[:, 1] = np.minimum(white[:, 1], 1.8)
    assert kinds(make(n=5000, u=white), ["u"]) == []


@pytest.mark.parametrize("levels", [10, 100, 1000, 1000.5, 1000.9])
def test_a_quantised_sine_is_not_saturated(levels):
    wave = np.round(levels * np.sin(2 * np.pi * 0.00113 * np.arange(20_000)))
    assert kinds(make(n=len(wave), force=wave[:, None]), ["force"]) == []
    clipped = np.minimum(wave, np.round(0.7 * levels))
    assert kinds(make(n=len(wave), force=clipped[:, None]), ["force"]) == [("force", "force", "saturated")]
