"""Frequency response measured from recordings: averaged spectra, coherence and standard deviations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from gbid.core.arrays import ComplexArray, FloatArray
from gbid.core.brief import Brief, Description, brief
from gbid.core.errors import DataError, UsageError
from gbid.core.option_types import Positive
from gbid.discretise.exact import check_holds, hold_response
from gbid.identify.data import same_columns, select
from gbid.identify.frequency_data import FrequencyData
from gbid.recording import Recording
from gbid.structure.linear import as_names

_SEGMENTS = 12  # usual number of segments of the shortest recording, which overlap by half
HANN = (4 / 9, 1 / 36)
"""Correlation of the errors of responses one and two frequencies apart: those of Hann spectra, (2/3)^2 and (1/6)^2."""
_CORRELATED = 1 / 18  # twice the squared correlation of the spectra of neighbouring Hann segments (Welch, 1967)


@dataclass(frozen=True, eq=False)
class MeasuredResponse(FrequencyData):
    """Frequency response that was estimated from recordings without a model; `gbid.fit` takes it as data.

    Attributes
    ----------
    frequency_hz : (n,) array
        Frequencies [Hz].
    response : (n, n_outputs, n_inputs) complex array
        Estimated frequency response.
    std : (n, n_outputs, n_inputs) array
        Standard deviation of its magnitude, and of its phase times the magnitude.
    coherence : (n, n_outputs) array
        Part of the power of each output that the inputs explain (multiple coherence), from 0 to 1.
    input_names, output_names : tuple of str
        Names of the channels.
    name : str
        Name of the first recording.
    correlation : tuple of float
        Correlation of the errors of neighbouring frequencies; see `FrequencyData`.
    of_loop : bool
        See `FrequencyData`.
    averages : float
        Equivalent number of independent segments.
    """

    _title: ClassVar[str] = "measured frequency response"
    coherence: FloatArray = field(kw_only=True)
    averages: float = field(kw_only=True)

    def _brief(self) -> Description:
        about = f"{len(self.frequency_hz)} frequencies, {self.averages:.1f} averages"
        return brief(self, about, input_names=self.input_names, output_names=self.output_names)

    def _numbers(self) -> dict[str, FloatArray]:
        return {**super()._numbers(), "coherence": np.broadcast_to(self.coherence[..., None], self.std.shape)}


def measured_response(
    recordings: Recording | Sequence[Recording],
    inputs: str | Sequence[str],
    outputs: str | Sequence[str],
    *,
    resolution_hz: Positive | None = None,
    intersample: str | Sequence[str] | None = "zoh",
    reference: str | Sequence[str] = (),
    period_s: float | None = None,
) -> MeasuredResponse:
    """Return the frequency response between signals of recordings, by averaged spectra (Welch).

    Parameters
    ----------
    recordings : Recording or sequence of Recording
        Recordings with the same channels and sample time; their spectra are averaged.
    inputs, outputs : str or sequence of str
        Signals (``"p"``) or channels (``"p.x"``).
    resolution_hz : float, optional
        Distance of the frequencies [Hz]; by default that of about twelve segments in the shortest recording. A
        resonance narrower than two such distances is shown too low and too wide.
    intersample : {"zoh", "foh"}, sequence of these, or None
        Behaviour of each input between samples. Its effect is divided out, so that the response is that of the
        continuous-time model, as far as this has rolled off at half the sampling frequency. None leaves the response of
        the samples as it is.
    reference : str or sequence of str
        Signals that excite a closed loop from outside, as many as inputs. In a loop the inputs contain the noise of
        the outputs; the reference does not, and removes this bias.
    period_s : float, optional
        Period of a periodic excitation, such as a multisine [s]. Whole periods after the first, which has the
        transient, are transformed without a window: there is no leakage, and a light resonance is not widened. Each
        line needs as many recordings as inputs move at it; where there are fewer, the response is nan. The reference
        has no use then.

    Returns
    -------
    MeasuredResponse

    Raises
    ------
    DataError
        When a recording lacks a signal, sample times differ, recordings are too short for the resolution, or the inputs
        do not excite independently.
    UsageError
        When there are not as many reference channels as inputs, or the resolution is not positive.

    Notes
    -----
    With the spectral matrices S of Hann segments that overlap by half, ``H = S_yu S_uu^-1``, or
    ``H = S_yr S_ur^-1`` with a reference (Ljung, System Identification, Sec. 6.4; Pintelon and Schoukens, 2012,
    Sec. 2.6). The variance of an entry is ``(1 - coherence) S_yy [S_uu^-1] / averages`` for the complex value; with a
    reference ``S_ee [S_ur^-H S_rr S_ur^-1] / averages``, with the power of ``e = y - H u``. For periodic excitation it
    is that of the mean over the periods, whose noise is smoothed over neighbouring lines (Sec. 2.5).
    """
    several = [recordings] if isinstance(recordings, Recording) else list(recordings)
    u, input_names, _ = same_columns(several, as_names(inputs))
    y, output_names, _ = same_columns(several, as_names(outputs))
    r = [select(rec, as_names(reference))[0] for rec in several] if reference else u
    n_u, h = u[0].shape[1], several[0].sample_time
    if r[0].shape[1] != n_u:
        raise UsageError(f"reference has {r[0].shape[1]} channels for {n_u} inputs; give as many")
    names = tuple(input_names), tuple(output_names)
    if period_s is not None:
        f, response, std, coherence, averages = _of_periods(several, u, y, period_s)
    else:
        f, response, std, coherence, averages = _of_segments(several, u, y, r, resolution_hz)
    hold: ComplexArray = np.ones((len(f), 1, n_u), complex)
    if intersample is not None:
        hold = hold_response(f * h, check_holds(intersample, n_u))[:, None, :]
    return MeasuredResponse(
        f,
        np.asarray(response / hold, complex),
        std / np.abs(hold),
        *names,
        several[0].name,
        () if period_s is not None else HANN,
        coherence=coherence,
        averages=averages,
    )


_Estimate = tuple[FloatArray, ComplexArray, FloatArray, FloatArray, float]
"""Frequencies, response, standard deviations, coherence, and number of averages."""


def _of_segments(
    recordings: Sequence[Recording],
    u: Sequence[FloatArray],
    y: Sequence[FloatArray],
    r: Sequence[FloatArray],
    resolution_hz: float | None,
) -> _Estimate:
    """Return the response from Hann segments that overlap by half."""
    n_u, n_y, closed = u[0].shape[1], y[0].shape[1], r is not u
    length = _segment_length(recordings, resolution_hz)
    joined = [np.hstack(parts) for parts in zip(u, y, r, strict=True)]
    S, count = _spectra(joined, length)
    at_u, at_y, at_r = slice(0, n_u), slice(n_u, n_u + n_y), slice(n_u + n_y, None)
    keep = slice(1, length // 2)
    f = np.asarray(np.fft.rfftfreq(length, recordings[0].sample_time)[keep], float)
    S = S[keep]
    averages = count / (1 + _CORRELATED * (count - 1) / count)
    try:
        to_reference = np.linalg.inv(S[:, at_u, at_r])
        inverse = np.linalg.inv(S[:, at_u, at_u])
    except np.linalg.LinAlgError:
        raise DataError(
            "the inputs do not excite independently at some frequency; record with independent inputs"
        ) from None
    response = S[:, at_y, at_r] @ to_reference
    explained = np.einsum("fyu,fuv,fyv->fy", S[:, at_y, at_u], inverse, S[:, at_y, at_u].conj()).real
    power = np.einsum("fyy->fy", S[:, at_y, at_y]).real
    with np.errstate(divide="ignore", invalid="ignore"):
        coherence = np.clip(explained / power, 0.0, 1.0)
    left, cost = power - np.clip(explained, 0.0, power), np.einsum("fuu->fu", inverse).real
    if closed:
        cross = response @ S[:, at_u, at_y]
        within = response @ S[:, at_u, at_u] @ response.conj().swapaxes(1, 2)
        left = np.maximum(power - 2 * np.einsum("fyy->fy", cross).real + np.einsum("fyy->fy", within).real, 0.0)
        cost = np.einsum("fru,frs,fsu->fu", to_reference.conj(), S[:, at_r, at_r], to_reference).real
    variance = left[:, :, None] * cost[:, None, :] / (2 * max(averages - n_u, 1.0))
    return f, response, np.sqrt(variance), coherence, averages


_PERIODS = 3  # fewest: the first has the transient, and one alone shows no noise
_MOVES = 5.0  # standard deviations of an input's amplitude, above which a line is excited
_OF_LARGEST = 1e-4  # part of the largest amplitude, below which a line is rounding
_FREEDOM = 40  # degrees of freedom of the power of the noise, for which neighbouring lines are taken together


def _of_periods(
    recordings: Sequence[Recording], u: Sequence[FloatArray], y: Sequence[FloatArray], period_s: float
) -> _Estimate:
    """Return the response at the excited lines of a periodic excitation."""
    from scipy.ndimage import uniform_filter1d

    h, n_u = recordings[0].sample_time, u[0].shape[1]
    n = round(period_s / h)
    if n < 2 or abs(n * h - period_s) > 1e-6 * period_s:
        raise UsageError(f"period_s = {period_s:g}: it must be a whole number of samples of {h:g} s")
    n_c = n_u + y[0].shape[1]
    means, noise, freedom, periods = list[ComplexArray](), np.zeros((n // 2 - 1, n_c, n_c), complex), 0, 0
    for recording, u_columns, y_columns in zip(recordings, u, y, strict=True):
        count = len(u_columns) // n
        if count < _PERIODS:
            raise DataError(f"recording {recording.name!r} has {count} periods; record at least {_PERIODS}")
        whole = np.hstack([u_columns, y_columns])[n : count * n].reshape(count - 1, n, -1)
        lines = np.fft.rfft(whole, axis=1)[:, 1 : n // 2]
        means.append(lines.mean(axis=0))
        off = lines - means[-1]
        noise = noise + np.einsum("pfa,pfb->fab", off, off.conj())
        freedom, periods = freedom + count - 2, periods + count - 1
    width = -(-_FREEDOM // (2 * freedom))
    S = uniform_filter1d(noise, 2 * width + 1, axis=0, mode="nearest") / (freedom * periods / len(recordings))
    mean = np.stack(means)  # recordings, lines, channels
    amplitude = np.abs(mean[:, :, :n_u]).max(axis=0)
    spread = np.sqrt(np.maximum(np.einsum("faa->fa", S[:, :n_u, :n_u]).real, 0.0))
    moving = amplitude > np.maximum(_MOVES * spread, _OF_LARGEST * amplitude.max(initial=0.0))
    chosen = np.flatnonzero(moving.any(axis=1))
    response = np.full((len(chosen), y[0].shape[1], n_u), np.nan, complex)
    variance = np.full(response.shape, np.nan)
    coherence = np.zeros((len(chosen), y[0].shape[1]))
    for place, line in enumerate(chosen):
        active = np.flatnonzero(moving[line])
        if len(active) > len(recordings):
            continue
        U, Y = mean[:, line, active].T, mean[:, line, n_u:].T
        H = Y @ np.linalg.pinv(U)
        onto = np.hstack([-H, np.eye(len(Y))])
        channels = np.ix_([*active, *range(n_u, mean.shape[2])], [*active, *range(n_u, mean.shape[2])])
        left = np.einsum("ya,ab,yb->y", onto, S[line][channels], onto.conj()).real
        response[place][:, active] = H
        variance[place][:, active] = np.outer(left, np.diag(np.linalg.pinv(U @ U.conj().T)).real) / 2
        power = (np.abs(Y) ** 2).sum(axis=1)
        coherence[place] = np.clip(1 - left * len(recordings) / np.maximum(power, np.finfo(float).tiny), 0.0, 1.0)
    if not np.isfinite(response).any():
        raise DataError(
            f"at no line do as few inputs move as there are recordings ({len(recordings)}): record as many as inputs, "
            "with different phases, or give each input lines of its own"
        )
    f = np.asarray((chosen + 1) / period_s, float)
    return f, response, np.sqrt(variance), coherence, float(periods)


def _segment_length(recordings: Sequence[Recording], resolution_hz: float | None) -> int:
    shortest = min(recordings, key=lambda recording: recording.n_samples)
    if resolution_hz is None:
        return max(16, 2 * (shortest.n_samples // (_SEGMENTS + 1)))
    length = max(8, round(1 / (resolution_hz * shortest.sample_time)))
    if length > shortest.n_samples:
        seconds = shortest.n_samples * shortest.sample_time
        raise DataError(
            f"recording {shortest.name!r} lasts {seconds:g} s, too short for resolution_hz = {resolution_hz:g}; "
            f"take at least {1 / seconds:.3g} Hz"
        )
    return length


def _spectra(records: Sequence[FloatArray], length: int) -> tuple[ComplexArray, int]:
    """Return the mean spectral matrices (n_f, n, n) of all segments, and the number of segments."""
    window = np.hanning(length + 1)[:-1, None]
    total = np.zeros((length // 2 + 1, records[0].shape[1], records[0].shape[1]), complex)
    count = 0
    for record in records:
        for first in range(0, len(record) - length + 1, max(1, length // 2)):
            piece = record[first : first + length]
            transform = np.fft.rfft((piece - piece.mean(0)) * window, axis=0)
            total += transform[:, :, None] * transform[:, None, :].conj()
            count += 1
    return np.asarray(total / max(count, 1), complex), count


# ---- Delay between two signals, from the correlation of the output with the whitened input.

_ORDER = 30  # largest order of the whitening filter
_LEVEL = 4.0  # smallest correlation that counts, in standard deviations: by chance one in 16 000 lags


@dataclass(frozen=True, eq=False)
class DelayEstimate(Brief):
    """Delay from an input to an output, by correlation.

    Attributes
    ----------
    delay_s : float
        Largest delay that the correlation allows [s]: the output has not begun to move before.
    lag : int
        First lag at which the output follows the input [samples]. An input that is held between samples reaches the
        next sample at the earliest, so that ``delay_s`` is ``lag - 1`` samples.
    lags : (n,) array
        Lags [samples].
    correlation : (n,) array
        Correlation of the whitened input with the output that was filtered in the same way. It has the shape of the
        impulse response.
    limit : float
        Absolute value above which a correlation counts.
    input_name, output_name : str
        Names of the channels.
    """

    delay_s: float
    lag: int
    lags: FloatArray
    correlation: FloatArray
    limit: float
    input_name: str
    output_name: str

    def _brief(self) -> Description:
        about = f"{self.input_name} to {self.output_name}, {self.delay_s:.6g} s ({self.lag - 1} samples)"
        return brief(self, about, lag=self.lag, limit=self.limit)


def estimate_delay(
    recording: Recording, input: str = "u", output: str = "y", *, longest_s: float | None = None
) -> DelayEstimate:
    """Return the delay from an input to an output, by the correlation of the output with the whitened input.

    Parameters
    ----------
    recording : Recording
        Recording in open loop, in which the input moves.
    input, output : str
        One signal or channel (``"p.x"``) each.
    longest_s : float, optional
        Longest delay that is looked for [s]; by default a tenth of the recording.

    Returns
    -------
    DelayEstimate
        Delay in whole samples. The delay lies in the sample that begins there, or earlier when the output begins so
        slowly that its beginning is lost in the noise. A fit with an exact delay (``B_delayed`` and ``delay``) gives
        the rest.

    Raises
    ------
    DataError
        When the recording lacks a signal or the output does not follow the input.
    UsageError
        When a name stands for several channels, or the longest delay is not positive.

    Notes
    -----
    An autoregression makes the input white, and the same filter is applied to the output. Their correlation is then the
    impulse response up to a factor (Box and Jenkins, Time Series Analysis, Sec. 11.2). Without a connection its
    standard deviation is one over the root of the number of samples.
    """
    (u, u_name), (y, y_name) = (_one_channel(recording, name) for name in (input, output))
    n = len(u)
    most = n // 10 if longest_s is None else round(longest_s / recording.sample_time)
    if most < 1 or most > n // 2:
        half = n * recording.sample_time / 2
        raise UsageError(f"longest_s = {longest_s}: choose between one sample and half of the recording, {half:g} s")
    order = min(_ORDER, n // 20)
    past = np.column_stack([u[order - i : n - i] for i in range(1, order + 1)])
    weights = np.linalg.lstsq(past, u[order:], rcond=1e-8)[0]
    white = u[order:] - past @ weights
    follow = y[order:] - np.column_stack([y[order - i : n - i] for i in range(1, order + 1)]) @ weights
    white, follow = white - white.mean(), follow - follow.mean()
    size = float(np.linalg.norm(white) * np.linalg.norm(follow))
    if size == 0:
        raise DataError(f"recording {recording.name!r}: {u_name!r} or {y_name!r} does not move")
    correlation = np.array([white[: len(white) - k] @ follow[k:] for k in range(most + 1)]) / size
    limit = _LEVEL / np.sqrt(len(white))
    above = np.flatnonzero(np.abs(correlation) > limit)
    if not len(above):
        raise DataError(
            f"recording {recording.name!r}: {y_name!r} does not follow {u_name!r} within "
            f"{most * recording.sample_time:g} s; look further (longest_s), or excite more"
        )
    lag = int(above[0])
    return DelayEstimate(
        delay_s=max(lag - 1, 0) * recording.sample_time,
        lag=lag,
        lags=np.arange(most + 1, dtype=float),
        correlation=correlation,
        limit=float(limit),
        input_name=u_name,
        output_name=y_name,
    )


def _one_channel(recording: Recording, name: str) -> tuple[FloatArray, str]:
    values, labels, _ = select(recording, (name,))
    if len(labels) != 1:
        raise UsageError(f"{name!r} has {len(labels)} channels, {', '.join(labels)}; name one, as '{name}.x'")
    return values[:, 0] - values[:, 0].mean(), labels[0]
