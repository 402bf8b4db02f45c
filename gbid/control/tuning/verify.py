"""Verification of a design: eigenvalues, exact norms, and distance to instability."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from gbid.arrays import FloatArray
from gbid.control.loop.norm import largest_singular_values, peak_gain
from gbid.control.tuning.gain_result import WorstMode
from gbid.control.tuning.search.loop_family import LoopFamily
from gbid.control.tuning.search.plane import true_rates
from gbid.control.tuning.search.problem import GainProblem, rows_of
from gbid.control.tuning.search.spectrum import damping_factors, eigenvalues
from gbid.structure import LinearModel


class Norm(NamedTuple):
    """Largest gain over frequency of one loop, and its angular frequency [rad/s]."""

    value: float
    frequency: float


def exact_norms(family: LoopFamily, x: FloatArray, kind: str, least: float = 0.0) -> list[Norm]:
    """Return the H-infinity norms of S_o (``"sensitivity"``) or K S_o (``"control"``) of every loop.

    Those below `least` may be too small, but take less time.
    """
    found = (peak_gain(model, least=least) for model in _models(family, x, kind))
    return [Norm(peak.value, 2 * np.pi * peak.frequency_hz) for peak in found]


def largest_norm(family: LoopFamily, x: FloatArray, kind: str) -> float:
    """Return the largest of the H-infinity norms of all loops."""
    largest = 0.0
    for model in _models(family, x, kind):
        largest = max(largest, peak_gain(model, least=largest).value)
    return largest


def _models(family: LoopFamily, x: FloatArray, kind: str) -> list[LinearModel]:
    loops, rows = family.matrices(x), rows_of(family, kind)
    parts = zip(loops.A, loops.B, loops.C[:, rows], loops.D[:, rows], strict=True)
    return [LinearModel(A, B, C, D) for A, B, C, D in parts]


def static_gains(family: LoopFamily, x: FloatArray) -> FloatArray:
    """Return the largest gain of S_o at zero frequency of every loop, (m,)."""
    loops, rows = family.matrices(x), rows_of(family, "static")
    response = loops.C[:, rows] @ np.linalg.solve(-loops.A, loops.B) + loops.D[:, rows]
    return np.asarray(largest_singular_values(response.astype(complex)))


def worst_mode(problem: GainProblem, x: FloatArray) -> WorstMode:
    """Return the mode that limits a design: an unstable pole, otherwise that of smallest damping or slowest decay."""
    worst: tuple[float, str, complex] | None = None
    for family in problem.families:
        values = true_rates(eigenvalues(family.states(x)), family.sample_time)
        aim = problem.aim(values, family.sample_time) if problem.limits.weight else damping_factors(values)
        # a pole that grows is worse than any that does not
        rank = np.where(values.real > 0, -2.0 - values.real / problem.scale, aim)
        rank = np.where(np.isnan(values), -np.inf, rank)
        i, j = np.unravel_index(rank.argmin(), rank.shape)
        if worst is None or rank[i, j] < worst[0]:
            worst = (float(rank[i, j]), family.labels[i], complex(values[i, j]))
    assert worst is not None
    _, where, value = worst
    return WorstMode(where, abs(value) / (2 * np.pi), -value.real / abs(value) if value else 0.0)


@dataclass(frozen=True)
class Edge:
    """Smallest change of a single gain that makes a loop unstable; infinite when it exceeds the width of the bounds."""

    gain: str
    change: float


def distance_to_edge(problem: GainProblem, x: FloatArray, names: tuple[str, ...]) -> Edge:
    """Return the smallest destabilising change of a single gain of either sign, with a tolerance of 1 %."""
    nearest = Edge("", np.inf)
    for i, name in enumerate(names):
        width = problem.upper[i] - problem.lower[i]
        for sign in (1.0, -1.0):

            def stable(change: float, i: int = i, sign: float = sign) -> bool:
                moved = x.copy()
                moved[i] += sign * change
                return problem.stable(moved)

            last = 0.0
            for change in width * np.geomspace(1e-7, 1.0, 22):
                if change >= abs(nearest.change):
                    break
                if not stable(change):
                    low, high = last, float(change)
                    while high - low > 0.01 * high:
                        middle = (low + high) / 2
                        low, high = (middle, high) if stable(middle) else (low, middle)
                    nearest = Edge(name, sign * high)
                    break
                last = float(change)
    return nearest
