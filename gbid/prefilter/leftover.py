"""What a run-out map leaves of a recording with still piezos, and how much of it is no sensor noise."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from gbid.arrays import FloatArray
from gbid.prefilter.runout import RunoutMap
from gbid.prefilter.shaft import shaft_motion
from gbid.recording import Recording

_UPPER = 0.5  # part of the spectrum, from its end, that shows the sensor noise alone


@dataclass(frozen=True, eq=False)
class Leftover:
    """What is left of one stationary recording after a map.

    A shaft that runs on a well defined orbit leaves the sensor noise. At 4000 rpm the paper's (Sec. 4) does not:
    the orbit wanders, a motion that no function of the angle describes.

    Attributes
    ----------
    name : str
        Name of the recording.
    conditions : dict of str to float
        Its operating point.
    rms_before : (n_channels,) array
        Root mean square about the mean before the map [m].
    rms : (n_channels,) array
        The same after the map [m].
    noise : (n_channels,) array
        Sensor noise, from the level of the upper half of the spectrum [m].
    non_synchronous : (n_channels,) array
        Root mean square of what is more than noise [m].
    frequency_hz : (n_channels,) array
        Frequency of the strongest line that is left.
    order : (n_channels,) array
        That frequency over the shaft's; a number that is not whole is a motion that does not follow the shaft. NaN
        for a shaft at rest.
    line_rms : (n_channels,) array
        Root mean square of what is left within 5 Hz of that line [m].
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
        """What is left over the sensor noise, (n_channels,): 1 for a perfect map."""
        return np.asarray(self.rms / self.noise)


def runout_leftover(runout_map: RunoutMap, rec: Recording) -> Leftover:
    """Look at what a map leaves of a recording with still piezos.

    Parameters
    ----------
    runout_map : RunoutMap
        Made from this or, better, from another recording.
    rec : Recording
        With p and phi.

    Returns
    -------
    Leftover

    Raises
    ------
    DataError
        When p or phi is missing, or phi does not fit the speed.
    """
    p, motion = rec.signal("p"), shaft_motion(rec)
    rest = p - runout_map.evaluate(motion.angle) if runout_map.needs_angle else p - runout_map.mean
    rest = rest - rest.mean(axis=0)
    power, frequency = power_of(rest, rec.sample_time)
    upper = power[int(len(power) * (1 - _UPPER)) :]
    # The median of a periodogram's chi-square with two degrees of freedom is ln 2 of its mean; lines do not move it.
    noise = np.sqrt(np.median(upper, axis=0) / np.log(2) * len(power))
    rms = np.sqrt(np.mean(rest**2, axis=0))
    strongest = power.argmax(axis=0)
    near = np.abs(frequency[:, None] - frequency[strongest]) <= 5.0
    turns_per_s = motion.turns / ((rec.n_samples - 1) * rec.sample_time)
    return Leftover(
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
    """Mean square per frequency, without the mean: its sum over the frequencies is the variance.

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
        power[-1] /= 2  # the highest frequency stands for itself alone
    return power, np.asarray(np.fft.rfftfreq(n, sample_time)[1:], dtype=float)
