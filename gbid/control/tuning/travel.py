"""Piezo travel after an impact, as a limit of a design."""

from __future__ import annotations

from math import pi

import numpy as np

from gbid.arrays import ComplexArray, FloatArray
from gbid.control.impact.half_sine import HalfSine
from gbid.control.loop.force_entry import force_entry
from gbid.control.tuning.search.loop_family import LoopFamily
from gbid.control.tuning.search.measure import ExtraLimit
from gbid.control.tuning.search.spectrum import Eigensystem
from gbid.structure import LinearModel

UNSTABLE = 1e3
"""Travel that is assigned to an unstable loop, over the limit."""
_AFTER_S = 0.05
_STEP_S = 1e-4
_ZOOM = np.linspace(-1.0, 1.0, 17)


def travel_limit(plant: LinearModel, impact: HalfSine, piezo_travel_m: float) -> ExtraLimit:
    """Return the limit of the motion of every stack to half its travel, for an impact in x and in y, in every loop.

    Parameters
    ----------
    plant : LinearModel
        One of the plants; the entry of a force is the same for all.
    impact : HalfSine
        The impact.
    piezo_travel_m : float
        Whole travel of a stack [m].
    """
    entry = force_entry(plant) * (impact.peak_n / impact.mass_kg)
    limit = piezo_travel_m / 2

    def largest(family: LoopFamily, gains: FloatArray) -> FloatArray:
        # of sampled loops the continuous ones with the delay of sampling
        loops = (getattr(family, "companion", None) or family).matrices(gains)
        # the states of the plant come first in every loop; the force does not act on the controller
        E = np.vstack([entry, np.zeros((loops.A.shape[1] - len(entry), entry.shape[1]))])
        system = Eigensystem.of(loops.A)
        stable = (system.values.real < 0).all(axis=1)
        found = np.full(len(family), UNSTABLE * limit)
        if stable.any():
            to_r = loops.C[stable, family.n_outputs :] @ system.right[stable]
            peaks = _peaks(system.values[stable], to_r, system.left[stable] @ E, impact.duration_s)
            found[stable] = np.minimum(peaks, UNSTABLE * limit)
        return np.asarray(np.maximum(found, 1e-12))

    return ExtraLimit("piezo travel", largest, limit)


def _peaks(values: ComplexArray, outputs: ComplexArray, inputs: ComplexArray, length: float) -> FloatArray:
    """Return the largest ``|r|`` of each loop over both stacks and directions: (m,)."""
    m, n = values.shape
    weights = (outputs[:, None] * inputs.transpose(0, 2, 1)[:, :, None]).reshape(m, -1, n)  # (m, direction x stack, n)
    n_during = max(20, int(np.ceil(length / _STEP_S)))
    after = np.arange(_STEP_S, _AFTER_S, _STEP_S)
    time = np.concatenate([np.linspace(0.0, length, n_during + 1), length + after])
    r = np.abs((weights @ _modes(values[:, :, None], time, length)).real)
    best, place = r.max(axis=2), time[r.argmax(axis=2)]
    step = max(_STEP_S, length / n_during)
    for _ in range(3):
        at = np.clip(place[:, :, None] + step * _ZOOM, 0.0, time[-1])
        found = np.abs((weights[:, :, None] @ _modes(values[:, None, :, None], at[:, :, None], length)).real[:, :, 0])
        best, top = np.maximum(best, found.max(axis=2)), found.argmax(axis=2)
        place, step = np.take_along_axis(at, top[:, :, None], axis=2)[:, :, 0], step / 8
    return np.asarray(best.max(axis=1))


def _modes(values: ComplexArray, time: FloatArray, length: float) -> ComplexArray:
    r"""Return the solution of :math:`\dot z = \lambda z + \sin(\pi t / T)` up to T, then of the free motion."""
    w = pi / length
    during, later = np.minimum(time, length), np.maximum(time - length, 0.0)
    forced = w * (np.exp(values * during) - np.cos(w * during)) - values * np.sin(w * during)
    return np.asarray(np.exp(values * later) * forced / (values**2 + w**2))
