"""Quality checks of recordings: constant, saturated, dead and swapped channels, rub, encoder, clock and speed."""

from __future__ import annotations

import hashlib
import itertools
import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt
import scipy

from gbid.core.arrays import BoolArray, FloatArray, IntArray
from gbid.core.notes import FitNote
from gbid.recording.cause import lead_before
from gbid.recording.recording import Recording, without_gaps

ProblemKind = Literal[
    "constant",
    "saturated",
    "too_few_samples",
    "swapped",
    "dead",
    "rub",
    "sample_time",
    "encoder",
    "duplicate",
    "speed",
    "cause",
]


@dataclass(frozen=True)
class SignalProblem:
    """One quality problem of a recording.

    Attributes
    ----------
    signal, channel : str
        Place of the problem. Both are empty when it concerns the whole recording; `channel` is empty when it concerns
        all channels.
    kind : str
        ``"constant"``, ``"saturated"``, ``"too_few_samples"``, ``"swapped"`` (channels x and y), ``"dead"`` (a sensor
        that does not respond), ``"rub"`` (the rotor touched the bearing), ``"sample_time"``, ``"encoder"``,
        ``"duplicate"``, ``"speed"`` (a run-up) or ``"cause"`` (a signal answers before the one that drives it).
    text : str
        One sentence with the numbers and what to do.
    """

    signal: str
    channel: str
    kind: ProblemKind
    text: str


# ---- Response to the excitation: dead sensors and swapped channels.
#
# No model is used. The frequency response H from all moving inputs to all outputs is estimated from segments of the
# recording, at the frequencies where the inputs have power. The multiple coherence follows from it: the share of an
# output that the inputs explain.

SEGMENTS = (10, 20)
"""Smallest and largest number of segments over which the spectra are averaged."""
GOOD_SEGMENT, MIN_SEGMENT = 500, 50
"""Preferred and smallest number of samples in a segment."""
POWER = 0.9
"""Share of the input power that lies in the evaluated frequencies."""
CROSSED = 1.5
"""Channels are swapped when both cross gains are larger than the direct gains, by this factor in the geometric mean. At
the 15 operating points of the published machine the cross gains are at most 0.2 of the direct ones."""
CHANCE = 0.95
"""Quantile of the coherence of unrelated signals at one frequency; the median of several stays below it."""
SYNCHRONOUS = 2
"""Number of harmonics of the shaft angle that are removed first."""
_MOVES = 1e-3  # of the largest standard deviation of the inputs


class _Response(NamedTuple):
    """Response of outputs to inputs, averaged over the excited band."""

    gain: FloatArray  # rms of |H|, weighted by input power, (n_outputs, n_inputs); NaN for inputs that do not move
    coherence: FloatArray  # median of the multiple coherence, (n_outputs,)
    chance: float  # coherence of unrelated signals


def find_response_problems(rec: Recording) -> Iterator[SignalProblem]:
    """Return dead sensors of u and p, and swapped channels, in a recording with moving piezos.

    The signal chain is r to u to p. With r, both u and p are checked against it. Without r, p is checked against u, and
    then it stays open which of the two is swapped. A recording whose inputs do not move has no such problems. Signals
    with other channels than x and y are not checked.
    """
    chain = [name for name in ("r", "u", "p") if name in rec.signals and rec.channels[name] == ("x", "y")]
    if len(chain) < 2:
        return
    source = chain[0]
    swapped = []
    for name in chain[1:]:
        response = _response(rec.signal(source), _without_turning(rec, rec.signal(name)))
        if response is None:
            return
        yield from _dead(rec, source, name, response)
        if _crossed(response):
            swapped.append(name)
    if swapped:
        yield _swapped(rec, chain, swapped)


def _swapped(rec: Recording, chain: list[str], swapped: list[str]) -> SignalProblem:
    """Return the problem of swapped channels, naming the signal that the other signals indicate."""
    source, followers = chain[0], chain[1:]
    if swapped != followers:
        name, which, other = swapped[0], f"signal {swapped[0]!r}", source
    elif len(followers) > 1:  # all the others are crossed, so the source itself is swapped
        name, which, other = source, f"signal {source!r}", followers[-1]
    else:
        name, which, other = followers[0], f"either {source!r} or {followers[0]!r}", source
    text = (
        f"recording {rec.name!r}: {which} has x and y swapped: each channel of {name!r} goes with the other axis of "
        f"{other!r} more than with its own; exchange the columns in the mapping, or the cables."
    )
    return SignalProblem(name, "", "swapped", text)


def _dead(rec: Recording, source: str, name: str, response: _Response) -> Iterator[SignalProblem]:
    for j, channel in enumerate(rec.channels[name]):
        values = rec.signal(name)[:, j]
        if values.min() == values.max() or np.isnan(response.gain[0, j]):
            continue  # constant channels are reported elsewhere; an axis at rest cannot be tested
        if response.coherence[j] < response.chance:
            text = (
                f"recording {rec.name!r}: signal {name!r} channel {channel!r} is dead: it does not respond to "
                f"{source!r} (coherence {response.coherence[j]:.2f}; unrelated signals reach {response.chance:.2f}); "
                "check the sensor, its cable and the column of the mapping."
            )
            yield SignalProblem(name, channel, "dead", text)


def _crossed(response: _Response) -> bool:
    g = response.gain
    moving = np.flatnonzero(~np.isnan(g[0]))
    alive = response.coherence >= response.chance
    if len(moving) == 2:
        crossed, direct = np.array([g[0, 1], g[1, 0]]), np.diag(g)
        return bool(alive.all() and (crossed > direct).all() and crossed.prod() > CROSSED**2 * direct.prod())
    (j,) = moving
    return bool(alive[1 - j] and g[1 - j, j] > CROSSED * g[j, j])


def _response(inputs: FloatArray, outputs: FloatArray) -> _Response | None:
    """Return estimated gain and coherence; None if no input moves or the recording is too short."""
    n_segments = int(np.clip(len(inputs) // GOOD_SEGMENT, *SEGMENTS))
    std = inputs.std(axis=0)
    if len(inputs) < n_segments * MIN_SEGMENT or std.max() == 0:
        return None
    moving = np.flatnonzero(std > _MOVES * std.max())
    u, y = _spectra(inputs[:, moving], n_segments), _spectra(outputs, n_segments)
    s_uu = np.einsum("kfi,kfj->fij", u, u.conj())
    s_yu = np.einsum("kfi,kfj->fij", y, u.conj())
    s_yy = np.sum(np.abs(y) ** 2, axis=0)
    power = np.einsum("fii->f", s_uu).real
    order = np.argsort(power)[::-1]
    band = order[: max(3, int(np.searchsorted(np.cumsum(power[order]), POWER * power.sum())) + 1)]
    s_uu, s_yu, s_yy = s_uu[band], s_yu[band], s_yy[band]
    ridge = 1e-9 * power[band].max() * np.eye(len(moving))  # for inputs that are identical signals
    h = np.linalg.solve((s_uu + ridge).transpose(0, 2, 1), s_yu.transpose(0, 2, 1)).transpose(0, 2, 1)
    explained = np.einsum("fij,fij->fi", h, s_yu.conj()).real
    coherence = np.divide(explained, s_yy, out=np.zeros_like(s_yy), where=s_yy > 0)
    gain = np.full((outputs.shape[1], inputs.shape[1]), np.nan)
    own_power = np.einsum("fjj->fj", s_uu).real
    gain[:, moving] = np.sqrt(np.einsum("fij,fj->ij", np.abs(h) ** 2, own_power) / own_power.sum(axis=0))
    chance = float(scipy.special.betaincinv(len(moving), n_segments - len(moving), CHANCE))
    return _Response(gain, np.median(coherence, axis=0), chance)


def _without_turning(rec: Recording, values: FloatArray) -> FloatArray:
    """Remove the part that follows the shaft angle, which leaks into the excited band of short recordings."""
    if "phi" not in rec.signals:
        return values
    phi = rec.signal("phi")[:, 0]
    turned = np.exp(1j * phi)
    if abs(turned.mean()) > 0.1:  # at rest, or only a few turns
        return values
    rest = values - values.mean(axis=0)
    for order in range(1, SYNCHRONOUS + 1):
        wave = turned**order
        rest = rest - 2 * np.outer(wave, wave.conj() @ rest / len(rest)).real
    return np.asarray(rest)


def _spectra(values: FloatArray, n_segments: int) -> FloatArray:
    """Return Fourier coefficients of Hann-windowed segments without zero frequency, (n_segments, n_frequencies, n)."""
    length = len(values) // n_segments
    parts = values[: length * n_segments].reshape(n_segments, length, -1)
    parts = parts - parts.mean(axis=1, keepdims=True)
    return np.asarray(np.fft.rfft(parts * np.hanning(length)[None, :, None], axis=1)[:, 1:])


def find_early_answers(rec: Recording) -> Iterator[SignalProblem]:
    """Return signals of the chain r, u, p that respond more than a sample before steps of their source.

    Channels with clocks of their own, or a wrong start of one, make such a recording. An excitation w that is recorded
    stands for r, which follows p in a loop.
    """
    driver = "w" if "w" in rec.signals else "r"
    chain = [name for name in (driver, "u", "p") if name in rec.signals]
    angle = rec.signal("phi")[:, 0] if "phi" in rec.signals else None
    for i, name in enumerate(chain):
        leads = {source: lead_before(rec.signal(source), rec.signal(name), angle) for source in chain[:i]}
        source, lead = next(((each, found) for each, found in leads.items() if found), ("", None))
        if lead:
            text = (
                f"recording {rec.name!r}: signal {name!r} channel {rec.channels[name][lead.channel]!r} answers before "
                f"its cause: it moves about {lead.samples} samples ({lead.samples * rec.sample_time:.2g} s) before the "
                f"steps of {source!r}; the two have clocks of their own, or one begins later: record them with one "
                "clock, or cut the early samples away."
            )
            yield SignalProblem(name, "", "cause", FitNote.BEFORE_CAUSE(text))


# ---- Rub: contact of rotor and bearing, seen as sudden changes of velocity far from the centre.

OUTSIDE = 0.7
"""Impacts are searched beyond this share of the largest radius."""
SIGMAS = 6.0
"""Smallest inward change of velocity by an impact, in robust standard deviations."""
LEAST = 0.25
"""Smallest inward change of velocity by an impact, over the rms of the velocity."""
MIN_IMPACTS = 2
"""Smallest number of impacts. A rotor that rubs bounces; a single jump may be a disturbed sample."""
OVER_OUTWARD = 1.5
"""An impact is larger than any outward change by this factor, because a wall cannot push outwards."""
HALF_WINDOW_S = 2e-3
"""Half the length of the window when u or r is recorded [s]: a quarter of a period of the modes of the rotor."""
SHORT_S = 0.6e-3
"""Half the length of the window without u and r [s]. The effect of the piezos grows with it, that of an impact does
not."""
SHARP = 2 / 3
"""Smallest median of the change in half the window over that in the window, when u or r is recorded. An impact gives
1, a contact of 1.5 ms 0.73; what the equation of motion leaves out for longer than the window, as gas does, gives 0.5.
"""
_HARMONICS = 6  # of the shaft angle, for run-out and unbalance
_LAGS = (-2, 0, 2, 4, 6, 8)  # delays of the piezos in samples
_EVERY = 3  # every third sample in motion is used for the regression
_MIN_SAMPLES = 500
_CHANGE = 0.02  # of speed or pressure, over its largest value
_PART_S = 0.25  # of a recording in which they change [s]
_ROUNDS, _TRIM = 3, 4.0  # of the regression; larger residuals (in standard deviations) are left out of the next round


def find_rub(rec: Recording) -> Iterator[SignalProblem]:
    r"""Return impacts of the rotor on the bearing, found in the disc position p.

    On its gas film the disc follows an equation of motion. A wall changes its velocity at once, always inwards and
    always far from the centre. Differentiation would amplify the noise. Therefore the equation is multiplied by a
    smooth window :math:`\psi` of 4 ms and integrated (weak form). Integration by parts gives, around each sample,

    .. math:: \int \ddot\psi p = K \int \psi p - D \int \dot\psi p + B \int \psi u_\tau
              + \int \psi f + \psi(0) \Delta v,

    so noise enters with :math:`\ddot\psi`, 13 times less than with second differences over 1 ms. The left side is
    regressed on the integrals of p, of u (or r) at several delays, of a cubic film, and on the harmonics of the shaft
    angle. The residual is projected inwards and evaluated beyond 0.7 of the largest radius. Residuals above six robust
    standard deviations are impacts, when there are at least two and when no outward residual nearby is almost as large.
    With u or r, most of them must be as large in half the window: an error of the equation that lasts gives half.
    Single wrong samples are removed before by a median of three. Times with a measured impact force are left out.
    Where speed or pressure are recorded and change, the equation is another one on the way: each 0.25 s have their own.
    """
    known = "u" in rec.signals or "r" in rec.signals
    half = max(3, round((HALF_WINDOW_S if known else SHORT_S) / rec.sample_time))
    if "p" not in rec.signals or rec.channels["p"] != ("x", "y") or rec.n_samples < _MIN_SAMPLES + 2 * half:
        return
    p = scipy.ndimage.median_filter(rec.signal("p"), size=(3, 1), mode="nearest")
    p = p - p.mean(axis=0)
    k, residual, sigma = _unexplained(rec, p, half)
    if len(k) < _MIN_SAMPLES // 2:
        return
    speed = float(np.sqrt(np.mean(np.sum(np.diff(p, axis=0) ** 2, axis=1))))
    limit = np.maximum(SIGMAS * sigma, LEAST * speed)
    radius = np.hypot(*p[k].T)
    far = radius > OUTSIDE * radius.max()
    inward = -np.sum(p[k[far]] * residual[far], axis=1) / radius[far]
    at, limit, sigma = k[far], limit[far], sigma[far]
    outward = inward[_apart(at, at[inward > limit], 2 * half)].min(initial=0.0)
    hit = at[inward > np.maximum(limit, -OVER_OUTWARD * outward)]
    impacts = np.split(hit, np.flatnonzero(np.diff(hit) > 2 * half) + 1) if hit.size else []
    if len(impacts) < MIN_IMPACTS or (known and not _sharp(rec, p, half, dict(zip(at, inward, strict=True)), impacts)):
        return
    reached = np.hypot(*p[hit].T)
    size = float((inward / np.maximum(sigma, 1e-300)).max())
    text = (
        f"recording {rec.name!r}: signal 'p' shows a rub: {len(impacts)} impacts at {reached.min() * 1e6:.1f} to "
        f"{reached.max() * 1e6:.1f} um from the mean position, the first at {hit[0] * rec.sample_time:.4f} s, push "
        f"the disc back by up to {size:.0f} standard deviations more than a film does; "
        "lower the excitation and record again, or cut that part away."
    )
    yield SignalProblem("p", "", "rub", text)


def _unexplained(rec: Recording, p: FloatArray, half: int) -> tuple[npt.NDArray[np.int_], FloatArray, FloatArray]:
    """Return samples, velocity changes (n, 2) not explained by the equation of motion, and their deviation (n,)."""
    k = np.arange(half - 1, rec.n_samples - half + 1)
    weighted, basis = _weak_form(rec, p, half)
    sound = (k >= max(_LAGS) + half) & (k < rec.n_samples - half + min(_LAGS)) & ~_struck(rec, half)[k]
    k, weighted, basis = k[sound], weighted[sound], basis[sound]
    residual, sigma = np.empty_like(weighted), np.empty(len(k))
    for part in _parts(rec, k) if len(k) >= _MIN_SAMPLES // 2 else ():
        some = _in_motion(weighted[part])[::_EVERY]
        residual[part], sigma[part] = _robust_residual(weighted[part], basis[part], some)
    return k, residual, sigma


def _sharp(
    rec: Recording,
    p: FloatArray,
    half: int,
    inward: dict[int, float],
    impacts: Sequence[npt.NDArray[np.int_]],
) -> bool:
    """Return whether most impacts change the velocity equally within half the window: so they are sudden."""
    short = max(3, half // 2)
    k, residual, _ = _unexplained(rec, p, short)
    within = -np.sum(p[k] * residual, axis=1) / np.hypot(*p[k].T)
    shares = []
    for samples in impacts:
        largest = max(samples, key=lambda sample: inward[sample])
        near = np.abs(k - largest) <= short // 2
        shares.append(within[near].max(initial=0.0) / inward[largest])
    return float(np.median(shares)) >= SHARP


def _parts(rec: Recording, k: npt.NDArray[np.int_]) -> list[slice]:
    """Return parts of the samples with a constant equation of motion."""
    ways = [rec.signal(name) for name in ("pressure_bar", "speed_rpm") if name in rec.signals]
    if not any(np.ptp(way) > _CHANGE * np.abs(way).max() for way in ways):
        return [slice(None)]
    count = max(1, len(k) // max(_MIN_SAMPLES, round(_PART_S / rec.sample_time)))
    edges = np.linspace(0, len(k), count + 1).astype(int)
    return [slice(a, b) for a, b in itertools.pairwise(edges.tolist())]


def _weak_form(rec: Recording, p: FloatArray, half: int) -> tuple[FloatArray, FloatArray]:
    """Return both sides of the weak form of the equation of motion around each sample."""
    t = np.arange(1 - half, half) / half
    window = (1 + np.cos(np.pi * t)) / 2
    slope, bend = -np.pi / 2 * np.sin(np.pi * t) / half, -(np.pi**2) / 2 * np.cos(np.pi * t) / half**2
    n = len(p) - 2 * half + 2
    columns = [np.ones((n, 1)), _correlate(p, window), _correlate(p, slope)]
    columns.append(_correlate(_film(p), window))
    source = next((name for name in ("u", "r") if name in rec.signals), None)
    if source:
        source_values = rec.signal(source)
        weighted = _correlate(source_values - source_values.mean(axis=0), window)
        columns += [np.roll(weighted, lag, axis=0) for lag in _LAGS]  # np.roll wraps at the ends, which are left out
    if "phi" in rec.signals and np.ptp(rec.signal("phi")) > 0:
        turned = np.exp(1j * rec.signal("phi")[half - 1 : half - 1 + n, :1])
        for order in range(1, _HARMONICS + 1):
            wave = turned**order
            columns += [wave.real, wave.imag]
    return _correlate(p, bend), np.hstack(columns)


def _robust_residual(weighted: FloatArray, basis: FloatArray, some: npt.NDArray[np.int_]) -> tuple[FloatArray, float]:
    """Return the residual of a robust regression (on selected samples) at all samples, and its deviation."""
    for _ in range(_ROUNDS):
        regressors, wanted = basis[some], weighted[some]
        coefficients = _least_squares(regressors, wanted)
        left = wanted - regressors @ coefficients
        size = np.abs(left - np.median(left, axis=0))
        sigma = 1.4826 * float(np.median(size, axis=0).max())
        some = some[(size < _TRIM * sigma).all(axis=1)] if sigma else some
    return weighted - basis @ coefficients, sigma


def _film(p: FloatArray) -> FloatArray:
    """Return the regressors of a stiffening film with unknown centre."""
    x, y = np.ascontiguousarray(p.T)
    xx, yy = x * x, y * y  # products: powers of numpy call a function for each sample
    return np.stack([xx, x * y, yy, x * xx, xx * y, x * yy, y * yy]).T


def _apart(at: npt.NDArray[np.int_], hit: npt.NDArray[np.int_], gap: int) -> BoolArray:
    """Mark the samples without an impact nearby: an impact changes the motion on both sides."""
    if not hit.size:
        return np.ones(len(at), dtype=bool)
    after = np.searchsorted(hit, at)
    before, behind = hit[np.maximum(after - 1, 0)], hit[np.minimum(after, hit.size - 1)]
    return np.asarray(np.minimum(np.abs(at - before), np.abs(behind - at)) > gap, dtype=bool)


def _correlate(values: FloatArray, window: FloatArray) -> FloatArray:
    return np.stack([np.correlate(column, window, mode="valid") for column in values.T]).T


def _in_motion(weighted: FloatArray) -> npt.NDArray[np.int_]:
    """Return the samples with a moving disc: at rest, noise would dominate the regression."""
    energy = np.sum(weighted**2, axis=1)
    return np.flatnonzero(energy > 0.1 * energy.mean())


def _least_squares(basis: FloatArray, change: FloatArray) -> FloatArray:
    """Return regression coefficients from normal equations with a small ridge, for equal or zero columns."""
    size = np.sqrt(np.mean(basis**2, axis=0))
    size[size == 0] = 1.0
    scaled = basis / size
    gram = scaled.T @ scaled + 1e-9 * len(basis) * np.eye(basis.shape[1])
    return np.asarray(np.linalg.solve(gram, scaled.T @ change) / size[:, None])


def _struck(rec: Recording, half: int) -> BoolArray:
    """Mark the samples with a measured force in their window."""
    struck = np.zeros(rec.n_samples, dtype=bool)
    for name in ("f", "force"):
        if name in rec.signals:
            size = np.abs(rec.signal(name)).max(axis=1)
            struck |= size > 0.05 * size.max()
    return np.asarray(np.convolve(struck, np.ones(2 * half + 5), mode="same") > 0, dtype=bool)


# ---- Sample time, shaft encoder and speed.

SPEED_TOLERANCE = 0.02
"""Largest relative difference between the speed of the encoder and the stated speed."""
SLIP = np.deg2rad(2.0)
"""Smallest jump of the angle that is reported [rad]."""
SLIP_SIGMAS = 10.0
"""Smallest jump that is reported, in robust standard deviations of the angle increments."""
_SMOOTH = 25  # samples of the running median that gives the present speed
_TURN = 2 * np.pi


def find_encoder_faults(rec: Recording) -> Iterator[SignalProblem]:
    """Return jumps and stops of the shaft angle phi: lost counts, a lost index, a blocked encoder.

    The increments of the angle from sample to sample, wrapped to half a turn, follow the speed. A single increment
    far from the median of its neighbours is a jump. A stretch without increments while the rest turns is a stop. At the
    begin or the end of a recording it is a shaft at rest (`gbid.recording.quality`). The step from a full turn to
    zero is neither.
    """
    increments = turning_increments(rec)
    if increments is None or (increments.min() > 0 and np.ptp(increments) <= SLIP):  # no increment can be off by a slip
        return
    speed = scipy.ndimage.median_filter(increments, size=_SMOOTH, mode="nearest")
    off = np.abs(increments - speed)
    sigma = 1.4826 * float(np.median(np.abs(off - np.median(off)))) + float(np.median(off))
    turning = np.median(np.abs(increments)) > 0
    stopped = _long_runs(increments == 0, 2 * _SMOOTH) if turning else np.zeros(0, int)
    if stopped.size:
        share = stopped.size / len(increments)
        text = (
            f"recording {rec.name!r}: signal 'phi' stops: it stays at one angle for {stopped.size} samples "
            f"({share:.1%}), the first at {stopped[0] * rec.sample_time:.4f} s, while the shaft turns; check the "
            "encoder, or cut that away."
        )
        yield SignalProblem("phi", "phi", "encoder", text)
    jumps = np.flatnonzero(off > max(SLIP, SLIP_SIGMAS * sigma))
    jumps = np.setdiff1d(jumps, np.concatenate([stopped, stopped + 1, stopped - 1]))
    if jumps.size and turning:
        size = np.rad2deg(increments[jumps[0]] - speed[jumps[0]])
        text = (
            f"recording {rec.name!r}: signal 'phi' jumps {jumps.size} times, the first by {size:+.1f} degrees at "
            f"{jumps[0] * rec.sample_time:.4f} s: the encoder lost counts or its index; check its cable and "
            "speed limit, or cut those samples away."
        )
        yield SignalProblem("phi", "phi", "encoder", text)


def find_clock_problems(rec: Recording) -> Iterator[SignalProblem]:
    """Return a wrong sample time: the turns of phi must match ``speed_rpm`` within 2 %.

    The data cannot show whether the sample time or the speed is wrong. The text gives the sample time that would fit.
    For a recording with changing speed see `gbid.recording.quality`.
    """
    claimed = rec.conditions.get("speed_rpm")
    increments = turning_increments(rec)
    if not claimed or increments is None:
        return
    quarter = len(increments) // 4
    first, last = abs(increments[:quarter].mean()), abs(increments[-quarter:].mean())
    if abs(first - last) > SPEED_TOLERANCE * max(first, last):
        return
    measured = 60 * abs(float(increments.mean())) / _TURN / rec.sample_time
    if measured > 0 and abs(measured - abs(claimed)) > SPEED_TOLERANCE * abs(claimed):
        text = (
            f"recording {rec.name!r}: sample_time_s = {rec.sample_time:g} s cannot be right: phi turns at "
            f"{measured:.1f} rpm, but speed_rpm = {claimed:g}; a sample time of "
            f"{rec.sample_time * measured / abs(claimed):.4g} s would fit, or another speed."
        )
        yield SignalProblem("", "", "sample_time", text)


def turning_increments(rec: Recording) -> FloatArray | None:
    """Return the angle increments wrapped to half a turn; None without an angle or for a shaft at rest."""
    if "phi" not in rec.signals or rec.signal("phi").shape[1] != 1 or rec.n_samples < 4 * _SMOOTH:
        return None
    steps = np.diff(rec.signal("phi")[:, 0])
    if not steps.any():
        return None
    return np.asarray(np.mod(steps + np.pi, _TURN) - np.pi)


def runs(at: BoolArray) -> list[tuple[int, int]]:
    """Return for each run of true entries its first index and the index after its last."""
    edges = np.flatnonzero(np.diff(at, prepend=False, append=False)).tolist()
    return list(zip(edges[::2], edges[1::2], strict=True))


def _long_runs(at: BoolArray, least: int) -> FloatArray:
    """Return the indices of true entries in long runs that touch neither end."""
    long = [np.arange(a, b) for a, b in runs(at) if b - a >= least and a > 0 and b < len(at)]
    return np.concatenate(long) if long else np.zeros(0, int)


BLOCK = 0.05
"""Shortest block over which a speed is averaged [s]; it is at least a turn long."""


MARGIN = 0.05
"""Share of a run-up that is cut away in addition, because its end is slow."""


@dataclass(frozen=True)
class SpeedChange:
    """Change of the shaft speed within a recording.

    Attributes
    ----------
    share : float
        Share of the recording in which the shaft does not turn at the stated speed.
    low, high : float
        Lowest and highest speed there [rpm].
    from_s, to_s : float or None
        Longest part at the stated speed [s]; None where it begins or ends with the recording.
    steady : bool
        Whether there is such a part.
    """

    share: float
    low: float
    high: float
    from_s: float | None = None
    to_s: float | None = None
    steady: bool = True


def find_speed_changes(rec: Recording) -> Iterator[SignalProblem]:
    """Return a problem if phi turns at ``speed_rpm`` in a part of a recording only; see `speed_change`."""
    change = speed_change(rec)
    if change is None:
        return
    text = (
        f"recording {rec.name!r}: the speed changes: phi turns at {change.low:.0f} to {change.high:.0f} rpm in "
        f"{change.share:.0%} of it, but speed_rpm = {rec.conditions['speed_rpm']:g}; "
    )
    if change.steady:
        parts = {"from_s": change.from_s, "to_s": change.to_s}
        keys = " and ".join(f"{key}: {value:.4g}" for key, value in parts.items() if value is not None)
        what = "a run-up before it" if change.to_s is None else "a change of speed beside it"
        text += f"{what}: cut to the part at this speed with {keys} (seconds after its present first sample)."
    else:
        text += "correct speed_rpm, or record at a constant speed."
    yield SignalProblem("", "", "speed", text)


def speed_change(rec: Recording) -> SpeedChange | None:
    """Return a change of speed relative to ``speed_rpm``; None for a constant speed.

    The speed is averaged over blocks of a turn or more. A block is off when it differs from ``speed_rpm`` by more than
    2 %. A steady other speed is a matter of the sample time, which has a check of its own.
    """
    claimed = rec.conditions.get("speed_rpm")
    increments = turning_increments(rec)
    if claimed is None or increments is None or any(find_encoder_faults(rec)):
        return None
    turn = 60 / abs(claimed) if claimed else 0.0
    size = max(25, math.ceil(max(BLOCK, turn) / rec.sample_time))
    count = len(increments) // size
    if count < 2:
        return None
    seconds = size * rec.sample_time
    speeds = 60 * np.abs(increments[: count * size].reshape(count, size).mean(axis=1)) / (2 * np.pi * rec.sample_time)
    off = np.abs(speeds - abs(claimed)) > SPEED_TOLERANCE * max(abs(claimed), 60 / seconds)
    if not off.any() or (off.all() and np.ptp(speeds) <= SPEED_TOLERANCE * speeds.max()):
        return None
    change = SpeedChange(float(off.mean()), float(speeds[off].min()), float(speeds[off].max()), steady=False)
    if off.all():
        return change
    first, last = max(runs(~off), key=lambda run: run[1] - run[0])
    spare = max(seconds, MARGIN * seconds * max(first, count - last))
    from_s = float(first * seconds + spare) if first else None
    to_s = float(last * seconds - spare) if last < count else None
    steady = (to_s or rec.duration) > (from_s or 0.0)
    return replace(change, from_s=from_s, to_s=to_s, steady=steady)


MIN_SAMPLES = 100
"""Smallest number of samples that can be used for identification."""
MIN_RUN = 5
"""Number of consecutive samples at the extreme value that make a run."""
MAX_STAY = 0.01
"""A channel is called saturated when a larger share of its samples lies in such runs."""
FEW_LEVELS = 16
"""A channel with at most this number of distinct values is a test signal with levels (PRBS), not a clipped signal."""
PILE = 5.0
"""A clipped level occurs at least this many times as often as the level next to it. The crest of a sine that is read
by a coarse converter occurs at most 1 / (sqrt(2) - 1) = 2.4 times as often, at any amplitude."""


def find_problems(
    rec: Recording, signals: Iterable[str] | None = None, kinds: Sequence[ProblemKind] | None = None
) -> list[SignalProblem]:
    """Return the quality problems of a recording.

    A channel is constant when all its samples are equal. It is saturated when three conditions hold: more than 1 % of
    the samples are exactly at its largest or smallest value in runs of at least five; this value is much more
    frequent than the next one; and the channel takes more than 16 distinct values.

    Recordings of r, u and p with moving piezos get further checks. u and p must respond to the reference, and each
    axis more to its own reference than to the other (`gbid.recording.quality`). p must not show impacts on the
    bearing (`gbid.recording.quality`). phi must turn without jumps and at the stated speed
    (`gbid.recording.quality`), which must not change (`gbid.recording.quality`). No check needs a model.

    Parameters
    ----------
    rec : Recording
        The recording.
    signals : iterable of str, optional
        Names of the signals to check; all by default. A shaft angle may be constant at standstill.
    kinds : collection of str, optional
        Kinds of problems to look for; all by default.

    Returns
    -------
    list of SignalProblem
        Empty when there are no problems.

    Raises
    ------
    DataError
        When the recording has no signal of a given name.
    """
    problems: list[SignalProblem] = []
    has_gaps, rec = bool(rec.missing), _bridged(rec)
    looked_at = list(rec.signals if signals is None else signals)
    if rec.n_samples < MIN_SAMPLES:
        text = (
            f"recording {rec.name!r} has {rec.n_samples} samples, at least {MIN_SAMPLES} are needed; "
            "record longer or cut less away."
        )
        problems.append(SignalProblem("", "", "too_few_samples", text))
    for signal in looked_at:
        values, unit = rec.signal(signal), rec.units[signal]
        for channel, column in zip(rec.channels[signal], values.T, strict=True):
            where = f"recording {rec.name!r}: signal {signal!r} channel {channel!r}"
            if column.min() == column.max():
                text = (
                    f"{where} is constant: all {rec.n_samples} samples are {_with_unit(column[0], unit)}; a dead "
                    "sensor, a loose cable or the wrong column of the mapping: correct it, or leave the signal out."
                )
                problems.append(SignalProblem(signal, channel, "constant", text))
            elif stays := stays_at_limits(column):
                count = sum(stays.values())
                at = " and ".join(_with_unit(value, unit) for value in stays)
                text = (
                    f"{where} is saturated: {count} of {rec.n_samples} samples ({count / rec.n_samples:.1%}) "
                    f"stay at its limit {at} for {MIN_RUN} samples or more; lower the excitation or widen "
                    "the range and record again, or cut those samples away."
                )
                problems.append(SignalProblem(signal, channel, "saturated", text))
    for about, kinds_of_check, find in _FINDERS:
        if (kinds is None or set(kinds_of_check) & set(kinds)) and (not about or set(about) & set(looked_at)):
            problems += [problem for problem in find(rec) if not problem.signal or problem.signal in looked_at]
    if has_gaps or any(problem.kind == "rub" for problem in problems):  # lines across gaps, and walls, are no answers
        problems = [problem for problem in problems if problem.kind != "cause"]
    return [problem for problem in problems if kinds is None or problem.kind in kinds]


def _bridged(rec: Recording) -> Recording:
    """Return a recording with missing samples interpolated and without irregular times, for the checks."""
    whole = {name: without_gaps(rec.signals[name])[0] for name in rec.missing}
    return replace(rec, signals={**rec.signals, **whole}, stamps=None) if whole or rec.stamps is not None else rec


def _find_rub(rec: Recording) -> Iterator[SignalProblem]:
    """Return a rub, searched without the shaft angle if the encoder has faults."""
    if "phi" in rec.signals and any(find_encoder_faults(rec)):
        rec = replace(rec, signals={name: values for name, values in rec.signals.items() if name != "phi"})
    return find_rub(rec)


_Finder = tuple[tuple[str, ...], tuple[ProblemKind, ...], Callable[[Recording], Iterator[SignalProblem]]]
# For each check: the signals it concerns (none: the whole recording), the kinds of problems, and the function.
_FINDERS: tuple[_Finder, ...] = (
    (("r", "u", "p"), ("dead", "swapped"), find_response_problems),
    (("p",), ("rub",), _find_rub),
    (("phi",), ("encoder",), find_encoder_faults),
    ((), ("sample_time",), find_clock_problems),
    ((), ("speed",), find_speed_changes),
    (("w", "r", "u", "p"), ("cause",), find_early_answers),
)


def _with_unit(value: float, unit: str) -> str:
    return f"{value:g} {unit}".rstrip()


def stays_at_limits(column: FloatArray) -> dict[float, int]:
    """Return the number of samples in long runs at each extreme value; empty when the channel is not saturated.

    A step response that settles at its largest value is not saturated.
    """
    if np.count_nonzero((column == column.min()) | (column == column.max())) <= MAX_STAY * len(column):
        return {}  # without a sort
    levels, counts = np.unique(column, return_counts=True)
    if len(levels) <= FEW_LEVELS:
        return {}
    stays = {}
    for levels_inwards, counts_inwards in ((levels, counts), (levels[::-1], counts[::-1])):
        limit = levels_inwards[0]
        long = [(a, b) for a, b in runs(column == limit) if b - a >= MIN_RUN]
        arrivals = [abs(column[a - 1] - limit) for a, _ in long if a]
        piled = counts_inwards[0] > PILE * counts_inwards[1]
        if long and piled and not (arrivals and _settles(arrivals, levels_inwards, counts_inwards)):
            stays[float(limit)] = sum(b - a for a, b in long)
    return stays if sum(stays.values()) > MAX_STAY * len(column) else {}


def _settles(arrivals: list[float], levels: FloatArray, counts: IntArray) -> bool:
    """Return whether a signal slows down before its limit ``levels[0]``, as a step response does.

    A signal that its sensor clips arrives there at its usual speed, which is in steps much larger than the spacing of
    the levels, or, when it is slow, after as much time at one level as at the next. Steps of the size of rounding
    belong to a signal without noise that has settled.
    """
    if np.median(arrivals) <= 1e-9 * abs(levels[-1] - levels[0]):
        return True
    spacing = np.abs(np.diff(levels[:6]))
    speed = spacing[1:] / counts[1:5]
    return bool(np.median(arrivals) <= 1.5 * np.median(spacing) and speed[:2].mean() < 0.6 * speed[2:].mean())


# ---- Checks across recordings: equal content under two names, and a sample time unlike the others.

MAX_LEVELS = 4
"""A command with at most this number of distinct values is a test signal with held levels (PRBS)."""


def content_digest(rec: Recording) -> str:
    """Return the sha256 of all signals, independent of the recording's name."""
    digest = hashlib.sha256()
    for name in sorted(rec.signals):
        digest.update(f"{name}{rec.signals[name].shape}".encode())
        digest.update(np.ascontiguousarray(rec.signals[name]).tobytes())
    return digest.hexdigest()


def find_group_problems(recordings: Iterable[Recording]) -> dict[str, list[SignalProblem]]:
    """Return problems that appear only in a comparison of an experiment's recordings.

    Two recordings with equal samples are duplicates; the second one is reported. When most recordings hold their
    command r for the same time, a recording that holds it for the same number of samples but another time has a wrong
    sample time.

    Parameters
    ----------
    recordings : iterable of Recording
        They are read one after the other, so a generator saves memory.

    Returns
    -------
    dict of str to list of SignalProblem
        By name of the recording; only recordings with problems are listed.
    """
    first: dict[str, str] = {}
    holds: dict[str, tuple[int, float]] = {}
    problems: dict[str, list[SignalProblem]] = {}
    for rec in recordings:
        digest = content_digest(rec)
        if digest in first:
            text = (
                f"recording {rec.name!r} holds the same samples as {first[digest]!r}; leave one of them out, or "
                "correct its file."
            )
            problems.setdefault(rec.name, []).append(SignalProblem("", "", "duplicate", text))
        first.setdefault(digest, rec.name)
        hold = 0 if rec.stamps is not None or "r" in rec.missing else _hold(rec)
        if hold:
            holds[rec.name] = hold, rec.sample_time
    for name, text in _odd_clocks(holds):
        problems.setdefault(name, []).append(SignalProblem("", "", "sample_time", text))
    return problems


def _hold(rec: Recording) -> int:
    """Return the smallest hold of a command with few levels, in samples; 0 without such a command."""
    if "r" not in rec.signals:
        return 0
    shortest = []
    for column in rec.signal("r").T:
        changes = np.flatnonzero(np.diff(column))
        if len(changes) >= 10 and len(np.unique(column)) <= MAX_LEVELS:
            shortest.append(int(np.gcd.reduce(np.diff(changes))))
    return min(shortest, default=0)


def _odd_clocks(holds: dict[str, tuple[int, float]]) -> list[tuple[str, str]]:
    """Return recordings whose sample time seems wrong: usual hold in samples, unusual hold in seconds."""
    times = Counter(f"{samples * step:.6g}" for samples, step in holds.values())
    if not times:
        return []
    usual, count = times.most_common(1)[0]
    samples_of_usual = {samples for samples, step in holds.values() if f"{samples * step:.6g}" == usual}
    odd = []
    for name, (samples, step) in holds.items():
        if count >= 2 and f"{samples * step:.6g}" != usual and samples in samples_of_usual:
            text = (
                f"recording {name!r}: sample_time_s = {step:g} s is unlike the others': r is held for {samples} "
                f"samples as theirs, which is {samples * step:g} s and not {usual} s; a sample time of "
                f"{float(usual) / samples:.4g} s would fit."
            )
            odd.append((name, text))
    return odd
