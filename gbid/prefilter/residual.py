"""Residual of a run-out map on a recording with piezos at rest, and its part beyond sensor noise."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from gbid.arrays import FloatArray
from gbid.brief import Brief
from gbid.prefilter.runout import RunoutMap
from gbid.prefilter.shaft import shaft_motion
from gbid.recording import Recording

SHARE = 0.3
"""A line is named when its rms is above this share of the sensor noise."""
_WHOLE = 0.02  # an order is a harmonic of the shaft within this distance
_UPPER = 0.5  # upper part of the spectrum that contains sensor noise only


@dataclass(frozen=True, eq=False)
class RunoutResidual(Brief):
    """Residual of one stationary recording after a run-out map.

    On a stable orbit the residual is the sensor noise. At 4000 rpm the orbit of the paper (Sec. 4) is not stable: it
    moves slowly, and no function of the shaft angle describes that.

    Attributes
    ----------
    name : str
        Name of the recording.
    conditions : dict of str to float
        Its operating point.
    rms_before : (n_channels,) array
        Root mean square about the mean before the map [m].
    rms : (n_channels,) array
        Root mean square about the mean after the map [m].
    noise : (n_channels,) array
        Sensor noise, from the level of the upper half of the spectrum [m].
    non_synchronous : (n_channels,) array
        Root mean square of the residual beyond the noise [m].
    frequency_hz : (n_channels,) array
        Frequency of the strongest spectral line in the residual.
    order : (n_channels,) array
        This frequency over the shaft frequency. A value that is not an integer means motion that does not follow the
        shaft. NaN for a shaft at rest.
    line_rms : (n_channels,) array
        Root mean square of the residual within 5 Hz of this line [m].
    """

    name: str
    conditions: Mapping[str, float]
    rms_before: FloatArray
    rms: FloatArray
    noise: FloatArray
    non_synchronous: FloatArray
    frequency_hz: FloatArray
    order: FloatArray
    line_rms: FloatArray

    @property
    def over_noise(self) -> FloatArray:
        """Residual over sensor noise, (n_channels,); 1 for a perfect map."""
        return np.asarray(self.rms / self.noise)


def runout_residual(runout_map: RunoutMap, rec: Recording) -> RunoutResidual:
    """Return the residual of a run-out map on a recording with piezos at rest.

    Parameters
    ----------
    runout_map : RunoutMap
        Map made from this recording or, better, from another one.
    rec : Recording
        Recording with p and phi.

    Returns
    -------
    RunoutResidual

    Raises
    ------
    DataError
        When p or phi is missing, or when phi does not fit the speed.
    """
    p, motion = rec.signal("p"), shaft_motion(rec)
    rest = p - runout_map.evaluate(motion.angle) if runout_map.needs_angle else p - runout_map.mean
    rest = rest - rest.mean(axis=0)
    power, frequency = power_of(rest, rec.sample_time)
    upper = power[int(len(power) * (1 - _UPPER)) :]
    # A periodogram is chi-square distributed with two degrees of freedom: its median is ln 2 times its mean. Single
    # spectral lines do not change the median.
    noise = np.sqrt(np.median(upper, axis=0) / np.log(2) * len(power))
    rms = np.sqrt(np.mean(rest**2, axis=0))
    strongest = power.argmax(axis=0)
    near = np.abs(frequency[:, None] - frequency[strongest]) <= 5.0
    turns_per_s = motion.turns / ((rec.n_samples - 1) * rec.sample_time)
    return RunoutResidual(
        name=rec.name,
        conditions=dict(rec.conditions),
        rms_before=p.std(axis=0),
        rms=rms,
        noise=noise,
        non_synchronous=np.sqrt(np.maximum(rms**2 - noise**2, 0.0)),
        frequency_hz=frequency[strongest],
        order=frequency[strongest] / turns_per_s if turns_per_s else np.full(len(rms), np.nan),
        line_rms=np.sqrt(np.where(near, power, 0.0).sum(axis=0)),
    )


def power_of(values: FloatArray, sample_time: float) -> tuple[FloatArray, FloatArray]:
    """Return the mean square per frequency, without the mean; its sum over the frequencies is the variance.

    Returns
    -------
    (n_frequencies, n_channels) array
        Mean squares.
    (n_frequencies,) array
        Frequencies [Hz], from the first above zero.
    """
    n = len(values)
    power = 2 * np.abs(np.fft.rfft(values, axis=0)[1:] / n) ** 2
    if n % 2 == 0:
        power[-1] /= 2  # the Nyquist frequency occurs only once
    return power, np.asarray(np.fft.rfftfreq(n, sample_time)[1:], dtype=float)


def leftover_words(runout_map: RunoutMap, recordings: Sequence[Recording]) -> tuple[str, ...]:
    """Return a remark on each strongest line that a map leaves in stationary recordings, above a share of the noise.

    Parameters
    ----------
    runout_map : RunoutMap
        The map.
    recordings : sequence of Recording
        Recordings with piezos at rest, as for `identify_runout`.

    Returns
    -------
    tuple of str
        Empty when nothing is left over, or for a shaft at rest.
    """
    if not runout_map.needs_angle:
        return ()
    return tuple(words for rec in recordings for words in _words(runout_map, runout_residual(runout_map, rec)))


def _words(runout_map: RunoutMap, left: RunoutResidual) -> list[str]:
    found = []
    for i, channel in enumerate(runout_map.channels):
        if left.line_rms[i] <= SHARE * left.noise[i]:
            continue
        order, nearest = left.order[i], round(left.order[i])
        size = f"{left.name}: left over in p_{channel}: {1e9 * left.line_rms[i]:.0f} nm rms"
        at = f"{left.frequency_hz[i]:.1f} Hz, noise {1e9 * left.noise[i]:.0f} nm"
        if nearest < 1 or abs(order - nearest) > _WHOLE:
            found.append(f"{size} of order {order:.2f} ({at}): it does not follow the shaft, so no map removes it")
        elif nearest > runout_map.orders.max(initial=0):
            found.append(f"{size} of order {nearest} ({at}): harmonics: {nearest} or auto removes it")
        else:
            found.append(f"{size} of order {nearest} ({at}): the run-out changes within the recording")
    return found
