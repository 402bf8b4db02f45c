"""Goals on the classical margins of each loop: gain and phase."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import radians

import numpy as np

from gbid.arrays import ComplexArray, FloatArray, is_finite
from gbid.control.tuning.goals.goal import DesignContext, Wanted
from gbid.control.tuning.search.loop_family import LoopFamily, Loops
from gbid.control.tuning.search.measure import ExtraLimit
from gbid.control.tuning.search.peaks import IntArray, ModalResponse, around, base_frequencies
from gbid.control.tuning.search.spectrum import Eigensystem
from gbid.errors import UsageError

_PER_DECADE = 80
_STEPS = np.linspace(0.0, 1.0, 9)
_NONE = 1e-6
"""Share of a margin that is used up where a loop has no crossing."""


@dataclass(frozen=True)
class MinGainMargin(Wanted):
    """Factors on the gain of each loop alone that it must tolerate: from ``1 / factor`` to ``factor``.

    Parameters
    ----------
    factor : float
        Gain margin, above 1.
    soft, weight
        See `Wanted`; the quantity is the share ``log(factor) / log(gain margin)``.
    """

    factor: float

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (is_finite(self.factor) and self.factor > 1):
            raise UsageError(f"MinGainMargin: factor = {self.factor!r}; give a number above 1")

    def measure(self, context: DesignContext) -> ExtraLimit:
        """Return the measure of this goal."""
        wanted = float(np.log(self.factor))

        def used(L: ComplexArray) -> FloatArray:
            tolerated = np.abs(np.log(np.maximum(np.abs(L), 1e-12)))
            return np.where(L.real > 0, wanted / np.maximum(tolerated, 1e-9), _NONE)

        return ExtraLimit("gain margin", _largest_share(lambda L: L.imag, used), 1 / self.weight)


@dataclass(frozen=True)
class MinPhaseMargin(Wanted):
    """Phase of either sign that each loop alone must tolerate.

    Parameters
    ----------
    degrees : float
        Phase margin [degrees], between 0 and 180.
    soft, weight
        See `Wanted`; the quantity is the share ``degrees / phase margin``.
    """

    degrees: float

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (is_finite(self.degrees) and 0 < self.degrees < 180):
            raise UsageError(f"MinPhaseMargin: degrees = {self.degrees!r}; give a number between 0 and 180")

    def measure(self, context: DesignContext) -> ExtraLimit:
        """Return the measure of this goal."""
        wanted = radians(self.degrees)

        def used(L: ComplexArray) -> FloatArray:
            return np.asarray(wanted / np.maximum(np.abs(np.angle(L)), 1e-9))

        return ExtraLimit("phase margin", _largest_share(lambda L: np.abs(L) - 1, used), 1 / self.weight)


def _largest_share(
    crossing: Callable[[ComplexArray], FloatArray], used: Callable[[ComplexArray], FloatArray]
) -> Callable[[LoopFamily, FloatArray], FloatArray]:
    """Return the largest share of a margin that is used at a crossing, as a function of loops and gains."""

    def largest(family: LoopFamily, gains: FloatArray) -> FloatArray:
        loops = family.matrices(gains)
        system = Eigensystem.of(loops.A)
        found = np.full(len(family), _NONE)
        for channel in range(family.n_outputs):
            np.maximum(found, _share(family, loops, system, channel, crossing, used), out=found)
        return found

    return largest


def _share(
    family: LoopFamily,
    loops: Loops,
    system: Eigensystem,
    channel: int,
    crossing: Callable[[ComplexArray], FloatArray],
    used: Callable[[ComplexArray], FloatArray],
) -> FloatArray:
    """Return the largest share of one channel, with crossings located by bisection (m,)."""
    response = ModalResponse(loops, system, slice(0, family.n_outputs))

    def gain(which: IntArray, w: FloatArray) -> ComplexArray:
        # opened at this channel, with the others closed: L = 1 - 1 / S_ii
        return np.asarray(1 - 1 / response(w, which)[..., channel, channel])

    m = len(family)
    base = base_frequencies(system.values, _PER_DECADE)
    # with modes of the loop opened at this channel, near which its gain has its peaks
    modes = np.concatenate([system.values, _opened(loops, channel)], axis=1)
    near = around(modes).reshape(m, -1)
    own = np.sort(np.concatenate([np.abs(modes), np.abs(modes.imag), near, np.tile(base[1:], (m, 1))], 1), axis=1)

    loop, low, high, sign = _intervals(own, lambda which, w: crossing(gain(which, w)))
    for _ in range(45 if len(loop) else 0):
        middle = (low + high) / 2
        before = np.sign(crossing(gain(loop, middle[:, None])[:, 0])) == sign
        low, high = np.where(before, middle, low), np.where(before, high, middle)
    found = np.full(m, _NONE)
    if len(loop):
        np.maximum.at(found, loop, used(gain(loop, ((low + high) / 2)[:, None])[:, 0]))
    # at zero frequency the loop gain is real, which limits the gain as well; rounding may give it an imaginary part
    rest = gain(np.arange(m), np.zeros((m, 1)))[:, 0].real.astype(complex)
    real = np.abs(crossing(rest)) <= 1e-9 * np.abs(rest)
    np.maximum(found, np.where(real, used(rest), _NONE), out=found)
    return np.asarray(found)


def _intervals(
    grid: FloatArray, value_at: Callable[[IntArray, FloatArray], FloatArray]
) -> tuple[IntArray, FloatArray, FloatArray, FloatArray]:
    """Return the intervals in which a function of frequency crosses zero: loop, ends, and sign at the lower end.

    Where it turns back between neighbours of the grid, beyond zero, it crosses twice.
    """
    value = value_at(np.arange(len(grid)), grid)
    side, size = np.sign(value), np.abs(value)
    loop, k = np.nonzero(side[:, 1:] * side[:, :-1] < 0)
    found = loop, grid[loop, k], grid[loop, k + 1], side[loop, k]
    turns = (size[:, 1:-1] <= size[:, :-2]) & (size[:, 1:-1] <= size[:, 2:])
    loop, k = np.nonzero(turns & (side[:, 1:-1] == side[:, :-2]) & (side[:, 1:-1] == side[:, 2:]))
    if not len(loop):
        return found
    first, last, before, row = grid[loop, k], grid[loop, k + 2], side[loop, k], np.arange(len(loop))
    low, high, top = first, last, first
    for _ in range(4):
        points = low[:, None] + (high - low)[:, None] * _STEPS
        at = np.clip((before[:, None] * value_at(loop, points)).argmin(axis=1), 1, len(_STEPS) - 2)
        low, top, high = points[row, at - 1], points[row, at], points[row, at + 1]
    beyond = before * value_at(loop, top[:, None])[:, 0] < 0
    first, top, last, before = first[beyond], top[beyond], last[beyond], before[beyond]
    return (
        np.concatenate([found[0], loop[beyond], loop[beyond]]),
        np.concatenate([found[1], first, top]),
        np.concatenate([found[2], top, last]),
        np.concatenate([found[3], before, -before]),
    )


def _opened(loops: Loops, channel: int) -> ComplexArray:
    """Return the eigenvalues of the loops opened at a channel (m, n): the zeros of its S_ii."""
    direct = loops.D[:, channel, channel][:, None, None]
    back = loops.B[:, :, channel, None] @ loops.C[:, None, channel]
    return np.asarray(np.linalg.eigvals(loops.A - back / np.where(np.abs(direct) > 1e-9, direct, np.inf)), complex)
