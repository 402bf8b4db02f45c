"""Disturbance of the position: the spectrum that a recording shows, and lines such as unbalance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from gbid.arrays import ComplexArray, FloatArray, is_finite
from gbid.brief import Brief
from gbid.errors import UsageError
from gbid.recording import Recording


@dataclass(frozen=True, eq=False)
class DisturbanceSpectrum(Brief):
    """Disturbance d of the measured position in the open loop, as a one-sided spectrum.

    Parameters
    ----------
    frequency_hz : (k,) array
        Frequencies, rising [Hz].
    density : (k, n, n) array
        Hermitian spectral density matrices of d [m^2/Hz], straight between the frequencies and zero beyond them. The
        variance of d is the integral of its diagonal over frequency. A line (unbalance at the speed) is a narrow peak
        of it.
    name : str
        Name.
    """

    frequency_hz: FloatArray
    density: ComplexArray
    name: str = "disturbance"

    def __post_init__(self) -> None:
        try:
            f, S = np.atleast_1d(np.asarray(self.frequency_hz, float)), np.asarray(self.density, complex)
        except (TypeError, ValueError):
            raise UsageError("disturbance: frequency_hz and density must be numbers") from None
        if S.ndim != 3 or S.shape[0] != len(f) or S.shape[1] != S.shape[2] or len(f) < 2:
            raise UsageError(f"disturbance: density has shape {S.shape}; give (k, n, n) for {len(f)} frequencies")
        if not (np.isfinite(f).all() and np.isfinite(S).all() and (np.diff(f) > 0).all() and f[0] >= 0):
            raise UsageError("disturbance: frequencies must rise from 0 or more, and all numbers must be finite")
        size = float(np.abs(S).max())
        hermitian = np.abs(S - S.conj().transpose(0, 2, 1)).max() <= 1e-9 * size
        if not hermitian or np.linalg.eigvalsh(S).min() < -1e-9 * size:
            raise UsageError("disturbance: density must be Hermitian, without negative eigenvalues, at each frequency")
        object.__setattr__(self, "frequency_hz", f)
        object.__setattr__(self, "density", S)

    @property
    def widths(self) -> FloatArray:
        """Widths of the intervals around each frequency, for sums over frequency by the trapezoidal rule (k,) [Hz]."""
        steps = np.diff(self.frequency_hz)
        return np.asarray((np.append(steps, 0.0) + np.append(0.0, steps)) / 2)

    @property
    def rms(self) -> FloatArray:
        """Rms of each channel (n,) [m]."""
        return np.asarray(np.sqrt(np.einsum("k,kii->i", self.widths, self.density).real))


def recorded_disturbance(
    recordings: Recording | Sequence[Recording], signal: str = "p", *, segment_s: float = 0.5
) -> DisturbanceSpectrum:
    """Return the disturbance that recordings without excitation show: noise, unbalance and run-out.

    Parameters
    ----------
    recordings : Recording or sequence of these
        Recordings of the open loop at rest, at the operating points of the design.
    signal : str
        Name of the measured position.
    segment_s : float
        Length of the segments of Welch's estimate [s].

    Returns
    -------
    DisturbanceSpectrum
        Mean of the recordings' spectra.

    Raises
    ------
    UsageError
        When a recording has no such signal or is shorter than a segment, or when sample times differ.
    """
    every = [recordings] if isinstance(recordings, Recording) else list(() if recordings is None else recordings)
    if not every or not all(isinstance(one, Recording) for one in every):
        raise UsageError("recorded_disturbance: give a gbid.Recording or a list of these")
    if not (is_finite(segment_s) and segment_s > 0):
        raise UsageError(f"recorded_disturbance: segment_s = {segment_s!r}; give a positive number of seconds")
    found = []
    for recording in every:
        if signal not in recording.signals:
            raise UsageError(
                f"recording {recording.name!r}: no signal {signal!r}; there are {', '.join(recording.signals)}"
            )
        p, length = np.asarray(recording.signals[signal]), round(segment_s / recording.sample_time)
        if recording.sample_time != every[0].sample_time:
            raise UsageError("recorded_disturbance: the recordings have different sample times")
        if length < 8 or len(p) < length:
            raise UsageError(f"recording {recording.name!r}: {len(p)} samples; segment_s = {segment_s} does not fit")
        parts = {"fs": 1 / recording.sample_time, "nperseg": length}
        f, S = scipy.signal.csd(p.T[:, None], p.T[None], **parts)
        found.append(np.moveaxis(S, -1, 0).transpose(0, 2, 1))
    return DisturbanceSpectrum(f, np.mean(found, axis=0), signal)
