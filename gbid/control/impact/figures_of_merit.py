"""Impact figures: largest motion of disc and piezos and decay time, measured and simulated."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields
from typing import Annotated

import numpy as np

from gbid.arrays import FloatArray
from gbid.control.impact.ringdown.basis import quiet_basis
from gbid.control.impact.validation import ImpactValidation
from gbid.discretise import discretise, propagate
from gbid.hdf5 import Stored
from gbid.recording import Recording
from gbid.structure import LinearModel

OVER = 0.95
"""A response has decayed when this share of its energy has passed."""
_QUIET = 50  # smallest number of samples between responses for an estimate of the noise


@dataclass(frozen=True)
class ImpactFigures:
    """Figures of the impacts of one recording: means over the impacts, and standard deviations of the measured values.

    Attributes
    ----------
    peak_m, peak_std_m, peak_simulated_m : float
        Largest distance of the disc from its position before the impact [m]. The measured value contains sensor noise.
    decay_s, decay_std_s, decay_simulated_s : float
        Time from the impact until 95 % of the energy of the response has passed, without the energy of the noise [s].
        An amplitude that decays as exp(-d t) has lost 78 % by then.
    piezo_m, piezo_std_m, piezo_simulated_m : float
        Largest motion of a stack from its middle, ``|u| / 2`` [m]. The measured value contains the response of the
        controller to sensor noise. It is nan without the signal `u`.
    """

    peak_m: Annotated[float, Stored("m", "largest distance of the disc from where it was, mean")]
    peak_std_m: Annotated[float, Stored("m", "largest distance of the disc from where it was, standard deviation")]
    peak_simulated_m: Annotated[float, Stored("m", "largest distance of the disc from where it was, simulated")]
    decay_s: Annotated[float, Stored("s", "time until the response is over, mean")]
    decay_std_s: Annotated[float, Stored("s", "time until the response is over, standard deviation")]
    decay_simulated_s: Annotated[float, Stored("s", "time until the response is over, simulated")]
    piezo_m: Annotated[float, Stored("m", "largest motion of a stack, mean")]
    piezo_std_m: Annotated[float, Stored("m", "largest motion of a stack, standard deviation")]
    piezo_simulated_m: Annotated[float, Stored("m", "largest motion of a stack, simulated")]


FIELDS = tuple(field.name for field in fields(ImpactFigures))


def impact_figures(
    recording: Recording,
    validation: ImpactValidation,
    actuators: LinearModel,
    controller: LinearModel | None = None,
) -> ImpactFigures:
    """Return the impact figures of a recording.

    Parameters
    ----------
    recording : Recording
        The validated recording.
    validation : ImpactValidation
        Its validation against the sampled loop.
    actuators : LinearModel
        Continuous actuators, from r to u.
    controller : LinearModel, optional
        Sampled controller, from p to r, with one sample of computation; open loop when not given.

    Returns
    -------
    ImpactFigures
    """
    v, h = validation, recording.sample_time
    moved = v.measured - v.stationary
    noise = _noise(moved, v)
    driven = _piezos(v.simulated, actuators, controller, h)
    peaks = [(float(a.max()), float(b.max())) for a, b in zip(_sizes(v, moved), _sizes(v, v.simulated), strict=True)]
    decays = [
        (_decay(a, noise) * h, _decay(b, 0.0) * h)
        for a, b in zip(_sizes(v, moved), _sizes(v, v.simulated), strict=True)
    ]
    stacks = [(float("nan"), float(np.abs(driven[a:b]).max()) / 2) for a, b in v.windows]
    if "u" in recording.signals:
        u = recording.signal("u")
        basis = quiet_basis(recording, v.harmonics)
        left = u - driven
        measured = u - basis @ np.linalg.lstsq(basis, left, rcond=None)[0]
        stacks = [(float(np.abs(measured[a:b]).max()) / 2, s) for (a, b), (_, s) in zip(v.windows, stacks, strict=True)]
    return ImpactFigures(*_statistics(peaks), *_statistics(decays), *_statistics(stacks))


def _statistics(pairs: list[tuple[float, float]]) -> tuple[float, float, float]:
    """Return mean and standard deviation of the measured values, and mean of the simulated values."""
    measured, simulated = np.array(pairs).T
    spread = float(measured.std(ddof=1)) if len(measured) > 1 else float("nan")
    return float(measured.mean()), spread, float(simulated.mean())


def _sizes(validation: ImpactValidation, position: FloatArray) -> Iterator[FloatArray]:
    """Yield the distance of the disc after each impact."""
    for start, stop in validation.windows:
        yield np.hypot(*position[start:stop].T)


def _noise(moved: FloatArray, validation: ImpactValidation) -> float:
    """Return the mean square of the distance outside the responses; nan when there is no such time."""
    quiet = np.ones(len(moved), dtype=bool)
    for start, stop in validation.windows:
        quiet[start:stop] = False
    return float((moved[quiet] ** 2).sum(axis=1).mean()) if quiet.sum() >= _QUIET else float("nan")


def _decay(distance: FloatArray, noise: float) -> float:
    """Return the number of samples until the share `OVER` of the energy has passed."""
    energy = np.concatenate([[0.0], np.cumsum(distance**2 - noise)])
    if not energy[-1] > 0:
        return float("nan")
    after = int(np.argmax(energy >= OVER * energy[-1]))
    before = energy[after - 1]
    return after - 1 + float((OVER * energy[-1] - before) / (energy[after] - before))


def _piezos(
    position: FloatArray, actuators: LinearModel, controller: LinearModel | None, sample_time: float
) -> FloatArray:
    """Return the difference of the piezo positions that a controller commands; zero without a controller."""
    if controller is None:
        return np.zeros_like(position)
    A, B, C, D = (np.array(m) for m in (controller.A, controller.B, controller.C, controller.D))
    output = propagate(A, position @ B.T, np.zeros(len(A))) @ C.T + position @ D.T
    reference = np.vstack([np.zeros((1, 2)), output[:-1]])  # the computation takes one sample
    held = discretise(np.array(actuators.A), np.array(actuators.B), sample_time, "zoh")
    states = propagate(np.asarray(held.F), reference @ np.asarray(held.G_now).T, np.zeros(len(held.F)))
    return np.asarray(states @ np.array(actuators.C).T)
