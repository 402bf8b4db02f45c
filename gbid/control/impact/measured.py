"""Measured hammer impacts: time and direction in a recording, force between samples, simulated response."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import atan2, degrees
from typing import Annotated

import numpy as np
import scipy

from gbid.control.loop.close import close_loop, force_entry, sample_plant
from gbid.core.arrays import FloatArray, IntArray
from gbid.core.errors import DataError, UsageError
from gbid.core.hdf5 import Stored
from gbid.discretise.exact import discretise, propagate
from gbid.recording import Recording
from gbid.structure import LinearModel

_NOISES = 8.0  # smallest force of an impact in standard deviations of the noise
_SHARE = 0.05  # smallest force of an impact over the largest force
_BOUNCE_S = 10e-3  # pulses closer than this are one impact, a double hit
_FINE = 20  # points per sample
_SPLINE = 4  # smallest number of samples inside a pulse for a cubic spline


@dataclass(frozen=True)
class MeasuredImpact:
    """Hammer impact found in a recording.

    Attributes
    ----------
    start, stop : int
        Last sample without force before the impact, and first sample without force after it.
    peak_n : float
        Largest measured force [N].
    direction_deg : float
        Direction of the largest force, from x to y [degrees].
    pulses : int
        Number of hits; more than 1 is a double hit.
    """

    start: Annotated[int, Stored("1", "last sample without force before the impact")]
    stop: Annotated[int, Stored("1", "first sample without force after it")]
    peak_n: Annotated[float, Stored("N", "largest measured force")]
    direction_deg: Annotated[float, Stored("deg", "from x to y, of the force at its largest")]
    pulses: Annotated[int, Stored("1", "how often the hammer hit")] = 1

    @property
    def axis(self) -> str:
        """Axis nearest to the direction of the force, ``"x"`` or ``"y"``."""
        folded = abs((self.direction_deg + 90) % 180 - 90)
        return "x" if folded <= 45 else "y"

    @property
    def along(self) -> FloatArray:
        """Unit vector of the direction of the force (2,)."""
        return np.array([np.cos(np.deg2rad(self.direction_deg)), np.sin(np.deg2rad(self.direction_deg))])


def force_of(recording: Recording, signal: str = "f", axis: str | None = None) -> FloatArray:
    """Return the measured force of a recording along x and y.

    Parameters
    ----------
    recording : Recording
        The recording.
    signal : str
        Name of the force, with two channels, or with one channel and `axis`.
    axis : {"x", "y"}, optional
        Direction of a force with one channel.

    Returns
    -------
    (n_samples, 2) array
        Force [N].

    Raises
    ------
    DataError
        When the signal is missing, has another number of channels, or its direction is not known.
    """
    force = recording.signal(signal)
    if force.shape[1] == 2:
        return np.asarray(force)
    where = f"recording {recording.name!r}: force {signal!r} has {force.shape[1]} channel(s)"
    if force.shape[1] != 1:
        raise DataError(f"{where}; give one along x and one along y, or a single one and its axis")
    if axis not in ("x", "y"):
        raise DataError(f"{where}; give its direction: axis='x' or axis='y'")
    both = np.zeros((len(force), 2))
    both[:, "xy".index(axis)] = force[:, 0]
    return both


def find_impacts(force: FloatArray, sample_time: float, name: str = "recording") -> tuple[MeasuredImpact, ...]:
    """Return the impacts in a measured force.

    Parameters
    ----------
    force : (n_samples, 2) array
        Force along x and y [N].
    sample_time : float
        Time between samples [s].
    name : str
        Name of the recording, for messages.

    Returns
    -------
    tuple of MeasuredImpact
        Impacts in the order of time.

    Raises
    ------
    DataError
        When there is no impact, or when one is not completely in the recording.
    """
    size = np.hypot(*force.T)
    # Impacts are rare, so the median of |f| gives the noise.
    noise = float(np.median(size)) / 1.1774
    threshold = max(_NOISES * noise, _SHARE * float(size.max()))
    above = np.flatnonzero(size > threshold)
    if not len(above) or threshold == 0:
        raise DataError(
            f"recording {name!r}: no impact in the force: at most {size.max():.3g} N over a noise of {noise:.2g} N; "
            "check the signal, or leave the recording out"
        )
    near = max(round(_BOUNCE_S / sample_time), 1)
    groups = np.split(above, np.flatnonzero(np.diff(above) > near) + 1)
    return tuple(_impact(force, size, group, noise, name) for group in groups)


def _impact(force: FloatArray, size: FloatArray, above: IntArray, noise: float, name: str) -> MeasuredImpact:
    """Return the impact whose force is large at the samples `above`, extended to the samples without force."""
    first, last = int(above[0]), int(above[-1])
    quiet = 3.0 * noise
    while first > 0 and size[first] > quiet:
        first -= 1
    while last < len(size) - 1 and size[last] > quiet:
        last += 1
    if size[first] > quiet or size[last] > quiet:
        raise DataError(
            f"recording {name!r}: the impact at sample {int(above[0])} is cut off at the end; leave the impact out"
        )
    top = first + int(size[first : last + 1].argmax())
    angle = degrees(atan2(float(force[top, 1]), float(force[top, 0])))
    return MeasuredImpact(first, last, float(size[top]), angle, 1 + int((np.diff(above) > 1).sum()))


@dataclass(frozen=True, eq=False)
class Pulse:
    """Force of one impact, interpolated between the samples.

    Attributes
    ----------
    start, stop : int
        As in `MeasuredImpact`.
    force : (20 (stop - start) + 1, 2) array
        Force [N] at 20 points per sample.
    """

    start: int
    stop: int
    force: FloatArray


def pulses_of(force: FloatArray, impacts: Sequence[MeasuredImpact]) -> tuple[Pulse, ...]:
    """Return the force of each impact as a `Pulse`, interpolated between its samples.

    A pulse has corners between samples, and outside of it the measured force is noise. Therefore a cubic spline is
    fitted to the samples inside the pulse only. It is continued beyond the first and last of these samples until it
    reaches zero. Sums over the samples would have errors up to 0.8 % for a half sine of ten samples, depending on the
    place of its corners.

    Parameters
    ----------
    force : (n_samples, 2) array
        Force along x and y [N].
    impacts : sequence of MeasuredImpact
        Impacts in this force.
    """
    return tuple(Pulse(impact.start, impact.stop, _between(force, impact)) for impact in impacts)


def _between(force: FloatArray, impact: MeasuredImpact) -> FloatArray:
    fine = np.linspace(impact.start, impact.stop, _FINE * (impact.stop - impact.start) + 1)
    inner = np.arange(impact.start + 1, impact.stop)
    if impact.pulses > 1 or len(inner) < _SPLINE:  # the force is zero between the hits, so the spline uses all samples
        samples = np.arange(impact.start, impact.stop + 1)
        values = np.array(force[samples])
        values[[0, -1]] = 0.0
        return np.asarray(scipy.interpolate.CubicSpline(samples, values)(fine))
    f = np.array(scipy.interpolate.CubicSpline(inner, force[inner])(fine))
    size = f @ impact.along
    first, last = _FINE, len(fine) - 1 - _FINE  # the outermost samples inside the pulse
    for corner, outward in ((first, np.arange(first, -1, -1)), (last, np.arange(last, len(fine)))):
        over = np.flatnonzero(size[outward] <= 0)
        if len(over):
            f[outward[over[0] :]] = 0.0
        else:  # the spline does not reach zero in time: use a straight line
            f[outward] = f[corner] * np.linspace(1, 0, len(outward))[:, None]
    return f


def pulse_forcing(
    A: FloatArray, E: FloatArray, pulses: Sequence[Pulse], n_samples: int, sample_time: float
) -> FloatArray:
    r"""Return the effect of the force on the state from sample to sample.

    .. math:: w_k = \int_0^h e^{A (h - s)} E f(t_k + s)\, ds

    Parameters
    ----------
    A : (n, n) array
        System matrix [1/s].
    E : (n, 2) array
        Input matrix of a force per mass.
    pulses : sequence of Pulse
        Forces of the impacts.
    n_samples : int
        Number of samples.
    sample_time : float
        Time between samples h [s].

    Returns
    -------
    (n_samples, n) array
        Row k is added to the state at sample k + 1, for a mass of 1 kg.
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


# ---- Response of a model to a measured force, which acts on the rotor without delay and actuators (paper, Sec. 5.1).


def force_response(
    plant: LinearModel,
    controller: LinearModel | None,
    pulses: Sequence[Pulse],
    n_samples: int,
    sample_time: float,
    *,
    computation_s: float | None = None,
    entry: FloatArray | None = None,
) -> FloatArray:
    r"""Return the simulated disc position after impacts, for a mass of 1 kg.

    .. math:: p = G_b f \quad\text{(open loop, Eq. 8)}, \qquad p = S_o G_b f \quad\text{(closed loop, Eq. 22)}

    Parameters
    ----------
    plant : LinearModel
        Continuous plant, from r (or u) to p. In open loop its input has no effect.
    controller : LinearModel or None
        Controller from p to r. A continuous controller gives the loop of the paper and needs a plant without exact
        delays. A sampled controller gives the sampled loop: r is held over each sample, and exact delays are allowed.
    pulses : sequence of Pulse
        Forces of the impacts.
    n_samples : int
        Number of samples.
    sample_time : float
        Time between samples [s].
    computation_s : float, optional
        Time from the sample of p to the change of r, for sampled controllers only [s]; one sample when not given.
    entry : (n, 2) array, optional
        Input matrix of a force per mass; from `force_entry` when not given.

    Returns
    -------
    (n_samples, 2) array
        Disc position times mass [m kg].

    Raises
    ------
    UsageError
        When the models do not fit together, or when the loop is unstable.
    """
    E = force_entry(plant) if entry is None else np.asarray(entry, float)
    n = plant.n_states
    if E.shape != (n, 2):
        raise UsageError(f"impact: entry of the force on {plant.name!r} has shape {E.shape}, expected ({n}, 2)")
    loop = loop_of_impact(plant, controller, sample_time, computation_s)
    F, C = np.array(loop.A), np.array(loop.C)
    F = F if loop.dt is not None else scipy.linalg.expm(F * sample_time)
    # The states of the plant come first in every loop. Between samples of a sampled one the force acts on them only.
    A = np.array(plant.A if loop.dt is not None else loop.A)
    E = np.vstack([E, np.zeros((len(A) - n, 2))])
    if (np.abs(np.linalg.eigvals(F)) >= 1).any():
        what = plant.name if controller is None else f"{plant.name}, closed by {controller.name}"
        raise UsageError(f"impact: {what!r} is unstable, so there is no response to compare with")
    forcing = np.zeros((n_samples, len(F)))
    forcing[:, : len(A)] = pulse_forcing(A, E, pulses, n_samples, sample_time)
    return np.asarray(propagate(F, forcing, np.zeros(len(F))) @ C.T)


def loop_of_impact(
    plant: LinearModel, controller: LinearModel | None, sample_time: float, computation_s: float | None
) -> LinearModel:
    """Return the model that an impact excites: the plant, its continuous loop, or by default its sampled loop.

    Raises
    ------
    UsageError
        When the models do not fit together.
    """
    if controller is None:
        return plant
    if controller.dt is not None:
        computation = sample_time if computation_s is None else computation_s
        return close_loop(sample_plant(plant, sample_time, computation), controller)
    if plant.delay is not None:
        raise UsageError(
            f"model {plant.name!r} has exact delays and {controller.name!r} is continuous: give the sampled "
            "controller (sample_controller), or replace the delays: with_pade(plant, order)"
        )
    return close_loop(plant, controller)
