"""Two modes from ring-downs: known modes, coverage, and what a loop adds."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.stats import binom

import gbid
from gbid.control.impact.measured import find_impacts
from gbid.control.impact.ringdown import RingDownStatus, RingProblem
from gbid.core.errors import DataError, UsageError

H = 2e-4
K = np.array([[-6.4e5, 2.0e4], [-1.5e4, -6.9e5]])
D = np.array([[-55.0, 6.0], [-9.0, -48.0]])
POLES = np.linalg.eigvals(np.block([[np.zeros((2, 2)), np.eye(2)], [K, D]]))
TRUE = np.array([v for p in sorted(POLES[POLES.imag > 0], key=abs) for v in (abs(p) / 2 / np.pi, -p.real / abs(p))])


def half_sine(time: np.ndarray, start: float, peak: float = 10.0, length: float = 2e-3) -> np.ndarray:
    since = time - start
    return np.where((since > 0) & (since < length), peak * np.sin(np.pi * since / length), 0.0)


@cache
def motion(axis: int, starts: tuple[float, ...], n: int, peak: float) -> np.ndarray:
    """Impacts on a mass of 2 kg, in steps of a hundredth of a sample with scipy's exponential."""
    fine, time = 100, H * np.arange(n)
    A = np.block([[np.zeros((2, 2)), np.eye(2)], [K, D]])
    step = expm(np.block([[A, np.eye(4)[:, [2 + axis]]], [np.zeros((1, 5))]]) * (H / fine))
    F, G, complete = step[:4, :4], step[:4, 4], expm(A * H)
    x, p = np.zeros(4), np.zeros((n, 2))
    for k in range(n):
        p[k] = x[:2]
        if any(-H < time[k] - s < 2.2e-3 for s in starts):
            for j in range(fine):
                middle = np.array([time[k] + (j + 0.5) * H / fine])
                x = F @ x + G * sum(float(half_sine(middle, s, peak)[0]) for s in starts) / 2.0
        else:
            x = complete @ x
    return p


def recording(
    seed: int = 0,
    axis: int = 0,
    *,
    starts: tuple[float, ...] = (0.1, 0.35037),
    n: int = 3000,
    noise: float = 30e-9,
    noise_f: float = 0.02,
    pole: float = 0.0,
    rpm: float = 0.0,
    peak: float = 10.0,
) -> gbid.Recording:
    """Impacts, and a shaft that turns or not; noise white or not."""
    time = H * np.arange(n)
    random = np.random.default_rng([seed, axis])
    w = random.standard_normal((n, 2))
    for k in range(1, n):
        w[k] = pole * w[k - 1] + np.sqrt(1 - pole**2) * w[k]
    phi = rpm / 60 * 2 * np.pi * time + 0.3
    turning = np.column_stack([3 * np.cos(phi + 1) + np.cos(4 * phi), 2 * np.sin(phi) - np.sin(3 * phi)]) * 1e-6
    f = np.zeros((n, 2))
    f[:, axis] = sum(half_sine(time, s, peak) for s in starts)
    signals = {
        "p": motion(axis, starts, n, peak) + [2e-6, -3e-6] + (turning if rpm else 0.0) + noise * w,
        "f": f + noise_f * random.standard_normal((n, 2)),
        "phi": np.mod(phi, 2 * np.pi)[:, None],
    }
    return gbid.Recording(signals, H, {"pressure_bar": 6.0, "speed_rpm": rpm}, f"hit_{'xy'[axis]}{seed}")


def values(ring) -> np.ndarray:
    return np.column_stack([ring.frequency_hz, ring.damping]).ravel()


def test_known_modes_without_noise() -> None:
    for rpm in (0.0, 2050.0):
        ringdown = gbid.fit_ringdown([recording(axis=a, noise=0.0, noise_f=0.0, rpm=rpm) for a in (0, 1)], harmonics=5)
        np.testing.assert_allclose(values(ringdown), TRUE, rtol=1e-7)
        np.testing.assert_allclose(ringdown.stiffness, K, rtol=1e-5, atol=1e-5 * 7e5)
        np.testing.assert_allclose(ringdown.damping_matrix, D, rtol=1e-5, atol=1e-5 * 55)
        assert ringdown.success
        assert ringdown.n_impacts == 4
        assert ringdown.harmonics == (5 if rpm else 0)
        assert not ringdown.lag_rates.size


def test_one_impact_tells_both_modes_where_they_are_coupled() -> None:
    ringdown = gbid.fit_ringdown(recording(axis=0, starts=(0.1,)))
    assert (np.abs(values(ringdown) - TRUE) < 4 * np.sqrt(np.diag(ringdown.covariance))).all()


def test_skipped_time_changes_the_samples_that_are_fitted() -> None:
    """What is wrong in the first 5 ms after an impact does not count with 6 ms skipped."""
    rec = recording(axis=0, starts=(0.1,), noise=0.0, noise_f=0.0)
    p = rec.signal("p").copy()
    p[512:535] += np.linspace(2e-5, 0.0, 23)[:, None]  # the pulse ends at sample 510
    skipped = gbid.fit_ringdown(rec.with_signals(p=p), lags=0, skip_s=6e-3)
    np.testing.assert_allclose(values(skipped), TRUE, rtol=1e-6)


@pytest.mark.parametrize("seeds", [8, pytest.param(40, marks=pytest.mark.slow)])
@pytest.mark.parametrize("pole", [0.0, 0.8])
def test_intervals_cover_the_truth(pole: float, seeds: int) -> None:
    """95 % intervals over seeds and four numbers, noise white and coloured."""
    hits = total = 0
    for seed in range(seeds):
        group = [recording(seed, a, starts=(0.06,), n=1100, pole=pole) for a in (0, 1)]
        ringdown = gbid.fit_ringdown(group, lags=0)
        low, high = ringdown.interval(0.95).T
        hits += int(((low < TRUE) & (high > TRUE)).sum())
        total += 4
    assert binom.cdf(hits, total, 0.95) > 1e-3  # the four of a seed are nearly independent
    assert hits < total


def test_impacts_are_found() -> None:
    time = H * np.arange(2000)
    f = 0.05 * np.random.default_rng(1).standard_normal((2000, 2))
    f[:, 1] += half_sine(time, 0.1) + half_sine(time, 0.2, 3.0, 1e-3) + half_sine(time, 0.205, 2.0, 1e-3)
    first, second = find_impacts(f, H)
    assert abs(first.start - 500) <= 1
    assert abs(first.stop - 510) <= 1
    assert first.axis == second.axis == "y"
    assert (first.pulses, second.pulses) == (1, 2)
    assert first.peak_n == pytest.approx(10.0, abs=0.2)
    assert second.stop >= 1030


def test_force_of_one_channel() -> None:
    rec = recording(axis=1)
    single = gbid.Recording({"p": rec.signal("p"), "force": rec.signal("f")[:, [1]]}, H, name="single")
    both = gbid.fit_ringdown(rec, lags=0)
    np.testing.assert_allclose(
        values(gbid.fit_ringdown(single, force="force", axis="y", lags=0)), values(both), rtol=1e-6
    )
    with pytest.raises(DataError, match="give its direction"):
        gbid.fit_ringdown(single, force="force")


def test_no_two_oscillations_is_a_status() -> None:
    time = H * np.arange(3000)
    f = np.column_stack([half_sine(time, 0.1), np.zeros(3000)])
    since = np.maximum(time - 0.102, 0)
    p = 1e-6 * np.column_stack([np.exp(-80 * since) - np.exp(-700 * since), np.exp(-50 * since) - np.exp(-900 * since)])
    p += 1e-9 * np.random.default_rng(0).standard_normal(p.shape)
    ringdown = gbid.fit_ringdown(gbid.Recording({"p": p, "f": f}, H, name="slow"), lags=0)
    assert not ringdown.success
    assert "no two oscillations" in ringdown.status
    assert np.isnan(ringdown.frequency_hz).all()


def test_a_third_mode_is_fitted_beside_the_two_and_told() -> None:
    heard, plain = [], [recording(axis=axis, starts=(0.1,), n=1200) for axis in (0, 1)]
    time, w, zeta = H * np.arange(1200), 2 * np.pi * 260.0, 0.5
    response = H * w * np.exp(-zeta * w * time) * np.sin(w * np.sqrt(1 - zeta**2) * time)
    for rec in plain:
        third = np.column_stack([np.convolve(f, response)[:1200] for f in rec.signal("f").T])
        heard.append(rec.with_signals(p=rec.signal("p") + 3e-6 * third / 10))
    computed, without = gbid.fit_ringdown(heard), gbid.fit_ringdown(heard, lags=3)
    off, before = (np.abs(one.damping / TRUE[1::2] - 1).max() for one in (computed, without))
    assert off < 0.02
    assert before > 2 * off
    assert len(computed.oscillations)
    assert "rings in more than two modes" in " ".join(computed.notes)
    assert not len(gbid.fit_ringdown(plain).oscillations)


def test_double_hits_are_told() -> None:
    ringdown = gbid.fit_ringdown(recording(axis=0, starts=(0.1, 0.1065)), lags=0)
    assert "1 double hit" in " ".join(ringdown.notes)
    assert (np.abs(values(ringdown) - TRUE) < 4 * np.sqrt(np.diag(ringdown.covariance))).all()


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (lambda r: r.with_signals(f=0 * r.signal("f") + 0.01), "no impact in the force"),  # all zero: a free decay
        (lambda r: r.with_signals(f=0 * r.signal("f")), "rises suddenly after 0.09 s, so this is no free decay"),
        (lambda r: r.slice(505, 3000), "cut off at the end"),
        (lambda r: r.slice(0, 520), "samples after the impact"),
        (lambda r: gbid.Recording({"p": r.signal("p")[:, :1], "f": r.signal("f")}, H), "a ring-down needs two"),
        (lambda r: gbid.Recording({"p": r.signal("p")}, H, name="bare"), "has no signal 'f'"),
    ],
)
def test_bad_recordings(change, text: str) -> None:
    with pytest.raises(DataError, match=text):
        gbid.fit_ringdown(change(recording()))


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"lags": "many"}, "lags = 'many'"),
        ({"harmonics": -1}, "harmonics = -1"),
        ({"skip_s": -1.0}, "skip_s = -1.0; give a number of at least 0"),
        ({"start": [(120.0, 0.1)]}, "give two modes"),
    ],
)
def test_bad_arguments(options, text: str) -> None:
    with pytest.raises(UsageError, match=text):
        gbid.fit_ringdown(recording(), **options)
    with pytest.raises(UsageError, match="no recording given"):
        gbid.fit_ringdown([])


def test_an_overflow_on_the_way_to_the_weighted_fit_is_no_crash(monkeypatch: pytest.MonkeyPatch) -> None:
    """A loop that rings in no two modes ended in a ValueError of scipy; the fit of equal weights is told of."""

    def overflowing(self: RingProblem, theta: np.ndarray, **parts: bool) -> object:
        if np.ptp(self.weights):
            raise ValueError("array must not contain infs or NaNs")
        return at(self, theta, **parts)

    at = RingProblem.at
    monkeypatch.setattr(RingProblem, "at", overflowing)
    ringdown = gbid.fit_ringdown(recording(axis=0, starts=(0.1,)), lags=0)
    assert not ringdown.success
    assert "overflows" in " ".join(ringdown.notes)


def test_free_decays_beside_impacts_leave_the_lags_free():
    """A recording without a force has no lags of its own; those of the others stay."""
    rec = recording()
    part = rec.slice(540, 1700)
    decay = gbid.Recording({"p": part.signal("p"), "f": 0 * part.signal("f")}, H, name="decay")
    both = gbid.fit_ringdown([rec, decay], lags=3)
    assert (len(both.lag_rates), both.n_impacts) == (3, 2)
    assert np.abs(values(both) / TRUE - 1).max() < 0.05


def decays(damping, amplitude=10e-6, noise=1e-7, limit=np.inf):
    """Free motion of two modes at 100 and 130 Hz, sampled for half a second, between the limits of its sensor."""
    t = 2e-4 * np.arange(2500)[:, None]
    shapes, phases = np.array([[1.0, 0.3], [0.4, 1.0]]), np.array([[0.3, 2.0], [1.0, 0.2]])
    modes = zip((100.0, 130.0), damping, shapes, phases, strict=True)
    p = sum(
        a * np.exp(-z * 2 * np.pi * f * t) * np.cos(2 * np.pi * f * np.sqrt(1 - z * z) * t + ph)
        for f, z, a, ph in modes
    )
    p = amplitude * p + noise * np.random.default_rng(5).standard_normal(p.shape)
    return gbid.Recording({"p": np.clip(p, -limit, limit)}, 2e-4, name="decay", units={"p": "m"})


def test_a_clipped_decay_is_named_and_no_success():
    assert gbid.fit_ringdown(decays((0.02, 0.03)), force=()).success
    clipped = gbid.fit_ringdown(decays((0.02, 0.03), limit=6e-6), force=())
    assert clipped.status is RingDownStatus.CLIPPED
    assert not clipped.success
    assert "position x stays at -6e-06 m, 6e-06 m" in clipped.notes[0]


@pytest.mark.parametrize("damping", [(-0.005, 0.02), (0.0, 0.0), (0.0, 0.02)])
def test_what_does_not_decay_is_no_success(damping):
    result = gbid.fit_ringdown(decays(damping, amplitude=1e-6), force=())
    assert result.status is RingDownStatus.NO_DECAY
