"""Two P gains by brute force, with nothing of gbid's tuner: a grid of 0.01 and Nelder-Mead from its best points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import minimize

import gbid
from gbid.control import p_controller
from gbid.core.arrays import FloatArray

COARSE = np.concatenate([[0.0], np.geomspace(3.0, 2000.0, 60)])
FINE = np.concatenate([[0.0], np.geomspace(0.5, 5000.0, 1500)])


@dataclass(frozen=True)
class Brute:
    """Best value and gains of the grid and of the polish of its best points, and of all that was tried."""

    grid_value: float
    value: float
    gains: tuple[float, float]


class Loops:
    """Closed loops of the published model under P gains: matrices by superposition, responses by complex arithmetic."""

    def __init__(self, model: gbid.LPVModel, points: Sequence[tuple[float, float]]) -> None:
        self.plants = [model.plant_at(*point) for point in points]
        loops = [
            [gbid.close_loop(plant, p_controller(*gains)).A for gains in ((0, 0), (1, 0), (0, 1))]
            for plant in self.plants
        ]
        self.A = np.array([zero for zero, _, _ in loops])
        self.by_gain = np.array([[x - zero, y - zero] for zero, x, y in loops])
        self._responses: dict[int, tuple[FloatArray, Any]] = {}

    def damping(self, gains: FloatArray, i: int) -> FloatArray:
        """Smallest damping factor of loop i under many pairs of gains (N, 2); -1 where it is unstable."""
        values = np.linalg.eigvals(self.A[i] + np.tensordot(gains, self.by_gain[i], axes=1))
        oscillates = np.abs(values.imag) > 1e-9 * np.abs(values)
        factors = np.where(oscillates, -values.real / np.abs(values), 1.0).min(axis=1)
        return np.where((values.real >= 0).any(axis=1), -1.0, factors)

    def peak(self, gains: FloatArray, i: int, frequencies: FloatArray) -> float:
        """Largest singular value of S_o of loop i at given frequencies [Hz]."""
        G, lag = self._at(i, frequencies)
        S = np.linalg.inv(np.eye(2) - G * (gains * lag[:, None])[:, None, :])
        return float(np.linalg.svd(S, compute_uv=False)[:, 0].max())

    def _at(self, i: int, frequencies: FloatArray) -> tuple[Any, Any]:
        key = i * 10_000 + len(frequencies)
        if key not in self._responses:
            lag = 1 / (1 + 1j * frequencies / 1000.0)
            self._responses[key] = (self.plants[i].frequency_response(frequencies), lag)
        return self._responses[key]

    def value(self, gains: FloatArray, cap: float | None, frequencies: FloatArray, floor: float = -1.0) -> float:
        """Smallest damping over all loops, -1 where the cap is not kept; stops early below a floor."""
        worst = 1.0
        for i in range(len(self.plants)):
            worst = min(worst, float(self.damping(gains[None], i)[0]))
            if worst <= floor:
                return worst
        if cap is not None and any(self.peak(gains, i, frequencies) > cap for i in range(len(self.plants))):
            return -1.0
        return worst


def survivors(loops: Loops, cap: float | None, floor: float, step: float = 0.01) -> tuple[FloatArray, FloatArray]:
    """Points of the grid over [0, 3]^2 whose value lies above a floor, and their values, best first."""
    axis = np.arange(0.0, 3.0 + step / 2, step)
    grid = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 2)
    values = np.ones(len(grid))
    order = np.argsort([loops.damping(np.array([[1.0, 1.0]]), i)[0] for i in range(len(loops.plants))])
    for i in order:  # the loops that damp least first: they leave little for the others
        values = np.minimum(values, loops.damping(grid, int(i)))
        keep = values > floor
        grid, values = grid[keep], values[keep]
    if cap is not None:
        kept = np.array([all(loops.peak(g, i, COARSE) <= cap for i in range(len(loops.plants))) for g in grid], bool)
        grid, values = grid[kept.astype(bool)], values[kept.astype(bool)]
    best = np.argsort(-values)
    return grid[best], values[best]


def brute_force(loops: Loops, cap: float | None, floor: float, polish: int = 20) -> Brute:
    """Best of the grid above a floor, and Nelder-Mead from its best points."""
    grid, values = survivors(loops, cap, floor)
    best, gains = (float(values[0]), grid[0]) if len(grid) else (-1.0, np.zeros(2))
    grid_value = best
    for start in grid[:polish]:
        found = minimize(
            lambda g: -loops.value(g, cap, FINE if cap else COARSE),
            start,
            method="Nelder-Mead",
            options={
                "xatol": 1e-9,
                "fatol": 1e-10,
                "maxfev": 250,
                "initial_simplex": start + np.array([[0, 0], [0.01, 0], [0, 0.01]]),
            },
        )
        if -found.fun > best:
            best, gains = float(-found.fun), found.x
    return Brute(grid_value, best, (float(gains[0]), float(gains[1])))
