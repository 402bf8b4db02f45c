"""Impacts of a hammer in a recording: where they are, which way they go, and the force between the samples."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import atan2, degrees

import numpy as np
from scipy.interpolate import CubicSpline

from gbid.arrays import FloatArray, IntArray
from gbid.discretise import discretise
from gbid.errors import DataError
from gbid.recording import Recording

_NOISES = 8.0  # an impact stands so many noise deviations out
_SHARE = 0.05  # and reaches this share of the largest force
_BOUNCE_S = 10e-3  # pulses closer than this are one impact: the hammer hit twice
_FINE = 20  # points to a sample
_SPLINE = 4  # samples inside a pulse that a cubic spline needs


@dataclass(frozen=True)
class MeasuredImpact:
    """An impact in a recording.

    Attributes
    ----------
    start, stop : int
        The samples in between are all that the force may act on: the last without force before it, the first
        without force after it.
    peak_n : float
        Largest measured force [N].
    direction_deg : float
        From x to y, of the force at its largest [degrees].
    pulses : int
        How often the hammer hit; more than 1 is a double hit.
    """

    start: int
    stop: int
    peak_n: float
    direction_deg: float
    pulses: int = 1

    @property
    def axis(self) -> str:
        """``"x"`` or ``"y"``, whichever is nearer."""
        folded = abs((self.direction_deg + 90) % 180 - 90)
        return "x" if folded <= 45 else "y"


def force_of(recording: Recording, signal: str = "f", axis: str | None = None) -> FloatArray:
    """Force along x and y.

    Parameters
    ----------
    recording : Recording
    signal : str
        Of two channels, or of one with an `axis`.
    axis : {"x", "y"}, optional
        Direction of a force of one channel.

    Returns
    -------
    (n_samples, 2) array
        [N].

    Raises
    ------
    DataError
        When the signal is not there, has another number of channels, or its direction is not known.
    """
    force = recording.signal(signal)
    if force.shape[1] == 2:
        return np.asarray(force)
    where = f"recording {recording.name!r}: force {signal!r} has {force.shape[1]} channel(s)"
    if force.shape[1] != 1:
        raise DataError(f"{where}; give one along x and one along y, or a single one and its axis")
    if axis not in ("x", "y"):
        raise DataError(f"{where}; say along which axis: axis='x' or axis='y'")
    both = np.zeros((len(force), 2))
    both[:, "xy".index(axis)] = force[:, 0]
    return both


def find_impacts(force: FloatArray, sample_time: float, name: str = "recording") -> tuple[MeasuredImpact, ...]:
    """Find the impacts in a measured force.

    Parameters
    ----------
    force : (n_samples, 2) array
        [N].
    sample_time : float
        [s].
    name : str
        Of the recording, for messages.

    Returns
    -------
    tuple of MeasuredImpact
        In the order of time.

    Raises
    ------
    DataError
        When there is none, or one is not whole in the recording.
    """
    size = np.hypot(*force.T)
    # the median of |f| is the noise as long as impacts are rare, as they are
    noise = float(np.median(size)) / 1.1774
    threshold = max(_NOISES * noise, _SHARE * float(size.max()))
    above = np.flatnonzero(size > threshold)
    if not len(above) or threshold == 0:
        raise DataError(
            f"recording {name!r}: no impact in the force: at most {size.max():.3g} N over a noise of {noise:.2g} N; "
            "check the signal, or leave the recording out"
        )
    pulses = np.split(above, np.flatnonzero(np.diff(above) > 1) + 1)
    near = round(_BOUNCE_S / sample_time)
    groups: list[list[IntArray]] = []
    for pulse in pulses:
        if groups and pulse[0] - groups[-1][-1][-1] <= near:
            groups[-1].append(pulse)
        else:
            groups.append([pulse])
    return tuple(_impact(force, size, group, noise, name) for group in groups)


def _impact(force: FloatArray, size: FloatArray, group: list[IntArray], noise: float, name: str) -> MeasuredImpact:
    """Widen a group of pulses to the samples that are without force."""
    first, last = int(group[0][0]), int(group[-1][-1])
    quiet = 3.0 * noise
    while first > 0 and size[first] > quiet:
        first -= 1
    while last < len(size) - 1 and size[last] > quiet:
        last += 1
    if size[first] > quiet or size[last] > quiet:
        raise DataError(
            f"recording {name!r}: the impact at sample {int(group[0][0])} is cut off by its end; leave it out"
        )
    top = first + int(size[first : last + 1].argmax())
    angle = degrees(atan2(float(force[top, 1]), float(force[top, 0])))
    return MeasuredImpact(first, last, float(size[top]), angle, len(group))


@dataclass(frozen=True, eq=False)
class Pulse:
    """Force of one impact between the samples.

    Attributes
    ----------
    start, stop : int
        As of the impact.
    force : (20 (stop - start) + 1, 2) array
        [N], 20 points to a sample.
    """

    start: int
    stop: int
    force: FloatArray


def pulses_of(force: FloatArray, impacts: Sequence[MeasuredImpact]) -> tuple[Pulse, ...]:
    """Draw the force of each impact through its samples.

    A pulse has corners between samples, and outside of it the measured force is noise. So a cubic spline goes through
    the samples inside the pulse alone, and beyond the first and last of these as far as zero. Sums over the samples
    would miss or add up to 0.8 % of a half-sine of ten samples, by where its corners happen to lie.

    Parameters
    ----------
    force : (n_samples, 2) array
        [N].
    impacts : sequence of MeasuredImpact
    """
    return tuple(Pulse(impact.start, impact.stop, _between(force, impact)) for impact in impacts)


def _between(force: FloatArray, impact: MeasuredImpact) -> FloatArray:
    fine = np.linspace(impact.start, impact.stop, _FINE * (impact.stop - impact.start) + 1)
    along = np.array([np.cos(np.deg2rad(impact.direction_deg)), np.sin(np.deg2rad(impact.direction_deg))])
    inner = np.arange(impact.start + 1, impact.stop)
    if impact.pulses > 1 or len(inner) < _SPLINE:  # between hits the force is zero as well: through all samples
        samples = np.arange(impact.start, impact.stop + 1)
        values = np.array(force[samples])
        values[[0, -1]] = 0.0
        return np.asarray(CubicSpline(samples, values)(fine))
    f = np.array(CubicSpline(inner, force[inner])(fine))
    size = f @ along
    first, last = _FINE, len(fine) - 1 - _FINE  # the outermost samples inside the pulse
    for corner, outward in ((first, np.arange(first, -1, -1)), (last, np.arange(last, len(fine)))):
        over = np.flatnonzero(size[outward] <= 0)
        if len(over):
            f[outward[over[0] :]] = 0.0
        else:  # no zero before the sample without force: a straight line to that one
            f[outward] = f[corner] * np.linspace(1, 0, len(outward))[:, None]
    return f


def pulse_forcing(
    A: FloatArray, E: FloatArray, pulses: Sequence[Pulse], n_samples: int, sample_time: float
) -> FloatArray:
    r"""Integrate what the force adds to the state from sample to sample.

    .. math:: w_k = \int_0^h e^{A (h - s)} E f(t_k + s)\, ds

    Parameters
    ----------
    A : (n, n) array
    E : (n, 2) array
        Where a force per mass enters.
    pulses : sequence of Pulse
    n_samples : int
    sample_time : float
        h [s].

    Returns
    -------
    (n_samples, n) array
        Row k is what sample k + 1 gets, for a mass of 1 kg.
    """
    fine = discretise(A, E, sample_time / _FINE, "foh")
    forcing = np.zeros((n_samples, len(A)))
    for pulse in pulses:
        f = pulse.force
        state = np.zeros((pulse.stop - pulse.start, len(A)))
        for j in range(_FINE):
            state = state @ fine.F.T + f[j:-1:_FINE] @ fine.G_now.T + f[j + 1 :: _FINE] @ fine.G_next.T
        forcing[pulse.start : pulse.stop] += state
    return forcing
