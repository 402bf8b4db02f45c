"""Reach of the gains: modes that no gain moves and gains that move no mode, found by eigenvalue derivatives."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gbid.control.tuning.loops import LoopFamily, Unmoved
from gbid.control.tuning.plane import Eigensystem, true_rates
from gbid.control.tuning.problem import STABLE, Limits, LoopState
from gbid.core.arrays import REAL, FloatArray

UNREACHED = 1e-5
"""Movement of an eigenvalue over all bounds, to first order and in its magnitude, below which no gain moves it."""
IDLE = 1e-9
"""Such a movement below which a gain moves nothing."""
_SAMPLES, _BLOCK, _NEAR = 3, 2_000_000, 1e-5


def with_unmoved(family: LoopFamily, lower: FloatArray, upper: FloatArray, limits: Limits, scale: float) -> LoopFamily:
    """Return a family without the stable modes that no gain moves; `unmoved` lists these modes.

    Such a mode is no part of any transfer function between the controller's signals, so that a change of its eigenvalue
    changes nothing else: it becomes two fast real poles. A mode stays if it breaks a limit by itself, and all stay if
    no gain moves any.

    Parameters
    ----------
    family : LoopFamily
        Loops.
    lower, upper : (d,) array
        Bounds of the gains.
    limits : Limits
        Objective and limits.
    scale : float
        Typical rate of the loops [rad/s].
    """
    random, T = np.random.default_rng(0), family.sample_time
    width, slowest = upper - lower, max(limits.slowest_pole, STABLE * scale)
    counts = fixed = np.zeros((0, 0), bool)
    idle, first, start = np.ones(len(width), bool), np.zeros((0, 0), complex), lower
    system = Eigensystem(np.zeros((0, 0, 0)), first, first[None])
    for k in range(_SAMPLES):
        gains = lower + width * random.uniform(0.25, 0.75, len(width))
        derivatives = family.derivatives(gains)
        here = Eigensystem.of(derivatives.A)
        m, n = here.values.shape
        reach = np.zeros((m, n, len(width)))
        each = max(1, _BLOCK // (n * derivatives.core[0].size))
        for rows in (np.arange(i, min(i + each, m)) for i in range(0, m, each)):
            loop, which = (part.ravel() for part in np.meshgrid(rows, np.arange(n), indexing="ij"))
            reach[rows] = np.abs(here.slopes(loop, which, derivatives)).reshape(len(rows), n, -1) * width
        reach = np.where(np.isfinite(reach), reach, np.inf) / np.maximum(np.abs(here.values), 1e-9 * scale)[..., None]
        still = reach.sum(axis=2) < UNREACHED
        if k == 0:
            system, first, start = here, here.values, gains
            upper_half = first.imag >= -REAL * np.abs(first)
            counts = upper_half & ((first.imag > REAL * np.abs(first)) | (limits.objective == "decay"))
            fixed = counts & still
        else:
            distance = np.abs(first[:, :, None] - here.values[:, None, :])
            nearest = distance.argmin(axis=2)
            near = np.take_along_axis(distance, nearest[..., None], axis=2)[..., 0] < _NEAR * np.abs(first)
            fixed &= near & np.take_along_axis(still, nearest, axis=1)
        idle &= reach.max(axis=(0, 1)) < IDLE
        if not (fixed.any() or idle.any()):
            return family
    modes = [(int(i), complex(true_rates(first[i, j], T))) for i, j in zip(*np.nonzero(fixed), strict=True)]
    result = replace(family, unmoved=Unmoved(np.zeros_like(system.A), tuple(modes), idle))
    if (counts & ~fixed).sum() == 0:
        return result
    fixed &= -true_rates(first, T).real > slowest
    moved = replace(family, unmoved=Unmoved(_shift(system, fixed, T), tuple(modes), idle))
    states = [LoopState(each, start, each.matrices(start), 1e-5 * width) for each in (family, moved)]
    for measure in limits.extra:  # a mode that breaks a limit by itself stays
        before, after = (measure.excess(state) for state in states)
        fixed &= (before <= np.maximum(after, 0.0) + 1e-12)[:, None]
    return replace(result, unmoved=Unmoved(_shift(system, fixed, T), tuple(modes), idle))


def _shift(system: Eigensystem, fixed: np.ndarray, sample_time: float | None) -> FloatArray:
    """Return matrices (m, n, n) that, added to A, make given modes fast and real."""
    shift = np.zeros_like(system.A)
    for i in np.unique(np.nonzero(fixed)[0]):
        fastest, count = 4 * np.abs(system.values[i]).max(), 0
        for j in np.flatnonzero(fixed[i]):
            value, v, w = system.values[i, j], system.right[i, :, j], system.left[i, j]
            pair = abs(value.imag) > REAL * abs(value)
            columns = np.stack([v.real, v.imag], axis=1) if pair else v.real[:, None]
            rows = np.stack([2 * w.real, -2 * w.imag]) if pair else w.real[None]
            now = np.array([[value.real, value.imag], [-value.imag, value.real]]) if pair else np.array([[value.real]])
            spare = 1 + 0.1 * np.arange(count, count + len(now))
            z = 0.02 * spare
            fast = -fastest * spare if sample_time is None else 2 / sample_time * (z - 1) / (z + 1)
            shift[i] += columns @ (np.diag(fast) - now) @ rows
            count += len(now)
    return shift
