"""Frequency response measured from recordings: averaged spectra, coherence and standard deviations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from gbid.arrays import ComplexArray, FloatArray
from gbid.brief import Brief, Description, brief
from gbid.discretise import check_holds, hold_response
from gbid.errors import DataError, UsageError
from gbid.extras import Pictured
from gbid.identify.data import select
from gbid.recording import Recording
from gbid.structure import as_names
from gbid.tables.table import Column, Entry, Table

_SEGMENTS = 12  # usual number of segments of the shortest recording, which overlap by half
_CORRELATED = 1 / 18  # twice the squared correlation of the spectra of neighbouring Hann segments (Welch, 1967)
_NUMBERS = ("frequency_hz", "magnitude", "magnitude_std", "phase_deg", "coherence")


@dataclass(frozen=True, eq=False)
class MeasuredResponse(Brief, Pictured):
    """Frequency response that was estimated from recordings without a model.

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
    averages : float
        Equivalent number of independent segments.
    """

    frequency_hz: FloatArray
    response: ComplexArray
    std: FloatArray
    coherence: FloatArray
    input_names: tuple[str, ...]
    output_names: tuple[str, ...]
    averages: float

    def _brief(self) -> Description:
        about = f"{len(self.frequency_hz)} frequencies, {self.averages:.1f} averages"
        return brief(self, about, input_names=self.input_names, output_names=self.output_names)

    def table(self) -> Table:
        """Return the numbers as a table, with a row for each output, input and frequency."""
        columns = [Column("output"), Column("input"), *(Column(name, format=8) for name in _NUMBERS)]
        rows: list[list[Entry]] = [
            [output, source, *(float(value) for value in (f, abs(h), std, np.degrees(np.angle(h)), coherence))]
            for i, output in enumerate(self.output_names)
            for j, source in enumerate(self.input_names)
            for f, h, std, coherence in zip(
                self.frequency_hz, self.response[:, i, j], self.std[:, i, j], self.coherence[:, i], strict=True
            )
        ]
        return Table("measured frequency response", columns, rows)

    def to_frame(self) -> Any:
        """Return the table as a data frame.

        Returns
        -------
        pandas.DataFrame

        Raises
        ------
        UsageError
            When pandas is not installed.
        """
        return self.table().to_frame()


def measured_response(
    recordings: Recording | Sequence[Recording],
    inputs: str | Sequence[str],
    outputs: str | Sequence[str],
    *,
    resolution_hz: float | None = None,
    intersample: str | Sequence[str] | None = "zoh",
    reference: str | Sequence[str] = (),
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
    Sec. 2.6). The variance of an entry is ``(1 - coherence) S_yy [S_uu^-1] / averages`` for the complex value.
    """
    several = [recordings] if isinstance(recordings, Recording) else list(recordings)
    u, y, names = _channels(several, inputs, outputs)
    r = [select(rec, as_names(reference))[0] for rec in several] if reference else u
    n_u, n_y, h = u[0].shape[1], y[0].shape[1], several[0].sample_time
    if r[0].shape[1] != n_u:
        raise UsageError(f"reference has {r[0].shape[1]} channels for {n_u} inputs; give as many")
    length = _segment_length(several, resolution_hz)
    joined = [np.hstack(parts) for parts in zip(u, y, r, strict=True)]
    S, count = _spectra(joined, length)
    at_u, at_y, at_r = slice(0, n_u), slice(n_u, n_u + n_y), slice(n_u + n_y, None)
    keep = slice(1, length // 2)
    f = np.asarray(np.fft.rfftfreq(length, h)[keep], float)
    S = S[keep]
    averages = count / (1 + _CORRELATED * (count - 1) / count)
    try:
        response = S[:, at_y, at_r] @ np.linalg.inv(S[:, at_u, at_r])
        inverse = np.linalg.inv(S[:, at_u, at_u])
    except np.linalg.LinAlgError:
        raise DataError(
            "the inputs do not excite independently at some frequency; record with independent inputs"
        ) from None
    explained = np.einsum("fyu,fuv,fyv->fy", S[:, at_y, at_u], inverse, S[:, at_y, at_u].conj()).real
    power = np.einsum("fyy->fy", S[:, at_y, at_y]).real
    with np.errstate(divide="ignore", invalid="ignore"):
        coherence = np.clip(explained / power, 0.0, 1.0)
    left = power - np.clip(explained, 0.0, power)
    cost = np.einsum("fuu->fu", inverse).real
    variance = left[:, :, None] * cost[:, None, :] / (2 * max(averages - n_u, 1.0))
    hold: ComplexArray = np.ones((len(f), 1, n_u), complex)
    if intersample is not None:
        hold = hold_response(f * h, check_holds(intersample, n_u))[:, None, :]
    return MeasuredResponse(
        frequency_hz=f,
        response=np.asarray(response / hold, complex),
        std=np.sqrt(variance) / np.abs(hold),
        coherence=coherence,
        input_names=tuple(names[0]),
        output_names=tuple(names[1]),
        averages=averages,
    )


def _channels(
    recordings: Sequence[Recording], inputs: str | Sequence[str], outputs: str | Sequence[str]
) -> tuple[list[FloatArray], list[FloatArray], tuple[list[str], list[str]]]:
    if not recordings:
        raise DataError("no recordings; give at least one")
    first, u, y = recordings[0], [], []
    names: tuple[list[str], list[str]] = ([], [])
    for recording in recordings:
        if not np.isclose(recording.sample_time, first.sample_time, rtol=1e-6, atol=0):
            raise DataError(
                f"recordings {first.name!r} and {recording.name!r} have different sample times: "
                f"{first.sample_time:g} s and {recording.sample_time:g} s; resample one"
            )
        values, u_names, _ = select(recording, as_names(inputs))
        u.append(values)
        values, y_names, _ = select(recording, as_names(outputs))
        y.append(values)
        if names[1] and names != (u_names, y_names):
            raise DataError(f"recordings {first.name!r} and {recording.name!r} have different channels")
        names = (u_names, y_names)
    return u, y, names


def _segment_length(recordings: Sequence[Recording], resolution_hz: float | None) -> int:
    shortest = min(recordings, key=lambda recording: recording.n_samples)
    if resolution_hz is None:
        return max(16, 2 * (shortest.n_samples // (_SEGMENTS + 1)))
    if not resolution_hz > 0:
        raise UsageError(f"resolution_hz = {resolution_hz}; it must be a positive number")
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
