"""Check that the sensors respond to the excitation: dead sensors and swapped channels.

No model is used. The frequency response H from all moving inputs to all outputs is estimated from segments of the
recording, at the frequencies where the inputs have power. The multiple coherence follows from it: the share of an
output that the inputs explain.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from scipy.special import betaincinv

from gbid.arrays import FloatArray
from gbid.recording.quality_problem import SignalProblem
from gbid.recording.recording import Recording

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
    """Response of the outputs to the inputs, over the band of the inputs."""

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
    """Return the problem, with the signal whose channels are swapped as far as the other signals show it."""
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
    """Return estimated gain and coherence, or None when no input moves or the recording is too short."""
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
    chance = float(betaincinv(len(moving), n_segments - len(moving), CHANCE))
    return _Response(gain, np.median(coherence, axis=0), chance)


def _without_turning(rec: Recording, values: FloatArray) -> FloatArray:
    """Remove the part that follows the shaft angle; in short recordings it leaks into the band of the excitation."""
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
