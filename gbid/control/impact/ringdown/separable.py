"""Separable least squares of a ring-down by variable projection.

Linear parameters are eliminated by projection; the others are iterated.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from math import ceil, log
from typing import Any

import numpy as np
import scipy
from scipy.linalg import solve_triangular

from gbid.arrays import FloatArray
from gbid.control.impact.ringdown.basis import N_MECHANICAL, RingData, Scale, lagging_force

_DIED_OUT = 6 * log(10)
_SHORTEST = 50


@dataclass(frozen=True, eq=False)
class Projected:
    """Projected residuals and their derivatives at one set of parameters.

    Attributes
    ----------
    residuals : list of (n_samples, 2) array
        Weighted residuals, one array for each recording.
    slopes : list of (n_samples, 2, n_parameters) array
        Derivatives by Kaufman's approximation (1975), which leaves out terms proportional to the residuals.
    """

    residuals: list[FloatArray] = field(default_factory=list)
    slopes: list[FloatArray] = field(default_factory=list)

    @property
    def squares(self) -> float:
        """Sum of squared residuals."""
        return float(sum((r**2).sum() for r in self.residuals))


@dataclass(frozen=True, eq=False)
class SeparableFit:
    """Result of the fit of the nonlinear parameters.

    Attributes
    ----------
    theta : (n_parameters,) array
        Parameters.
    at : Projected
        Residuals and derivatives at these parameters.
    converged : bool
        Whether the solver converged.
    message : str
        Message of the solver.
    """

    theta: FloatArray
    at: Projected
    converged: bool
    message: str


@dataclass(frozen=True, eq=False)
class RingProblem:
    """Least-squares problem of free responses with common K, D and lags, and one initial state for each impact.

    The parameters are -K and -D row by row, scaled, then for each lag and each direction of force the gains to x and y.

    Attributes
    ----------
    data : tuple of RingData
        Recordings.
    scale : Scale
        Scaling of the parameters.
    directions : tuple of int
        Directions of force: 0 for x, 1 for y.
    weights : (2,) array
        Factors on the residuals of x and y.
    rates : tuple of complex
        Rates of the decays beside the modes [1/s]: lags, and with an imaginary part oscillations.
    """

    data: tuple[RingData, ...]
    scale: Scale
    directions: tuple[int, ...]
    weights: FloatArray = field(default_factory=lambda: np.ones(2))
    rates: tuple[complex, ...] = ()

    @property
    def n_values(self) -> int:
        """Number of fitted values."""
        return 2 * sum(int(d.used.sum()) for d in self.data)

    @property
    def n_linear(self) -> int:
        """Number of linear parameters: initial states, offsets and harmonics."""
        return sum(2 * d.quiet.shape[1] + 4 * len(d.segments) for d in self.data)

    @cached_property
    def lagging(self) -> tuple[FloatArray, ...]:
        """Force of each recording, filtered by the lags."""
        return tuple(lagging_force(d, self.rates, self.directions, self.scale.sample_time) for d in self.data)

    def with_decays(self, theta: FloatArray, rates: Sequence[complex]) -> tuple[RingProblem, FloatArray, float]:
        """Return the problem with decays of given rates, its parameters, and its sum of squares.

        The gains of the decays come from linear least squares, with K and D as they are.
        """
        problem = replace(self, rates=tuple(rates))
        n_columns = len(self.directions) * sum(2 if rate.imag else 1 for rate in rates)
        longer = np.concatenate([theta[:N_MECHANICAL], np.zeros(2 * n_columns)])
        at = problem.at(longer)
        slopes = np.concatenate([s.reshape(-1, len(longer))[:, N_MECHANICAL:] for s in at.slopes])
        residuals = np.concatenate([r.ravel() for r in at.residuals])
        gains = np.linalg.lstsq(slopes, -residuals, rcond=None)[0]
        longer[N_MECHANICAL:] = gains
        return problem, longer, float(((residuals + slopes @ gains) ** 2).sum())

    def at(self, theta: FloatArray, *, slopes: bool = True) -> Projected:
        """Return the residuals and, if `slopes` is set, their derivatives."""
        alive = self._alive(theta)
        longest = max(min(stop - start, alive) for d in self.data for start, stop in d.segments)
        free = self.scale.free(theta, longest) * self.weights[:, None]
        change = self.scale.free_slopes(theta, longest) * self.weights[:, None] if slopes else None
        found = Projected()
        factors: dict[int, tuple[FloatArray, FloatArray]] = {}
        for d, lagging in zip(self.data, self.lagging, strict=True):
            segments = tuple((start, min(stop, start + alive)) for start, stop in d.segments)
            for start, stop in segments:
                if stop - start not in factors:
                    factors[stop - start] = np.linalg.qr(free[: stop - start].reshape(2 * (stop - start), -1))
            bases = [factors[stop - start] for start, stop in segments]
            projector = _Projector(replace(d, segments=segments), [q for q, _ in bases])
            gains = theta[N_MECHANICAL:].reshape(-1, 2)
            residual, left = projector.apply(((d.position - lagging @ gains) * self.weights)[:, :, None])
            found.residuals.append(residual[:, :, 0])
            if change is None:
                continue
            moved = np.zeros((len(residual), 2, len(theta)))
            for (start, stop), (q, r) in zip(segments, bases, strict=True):
                states = solve_triangular(r, q.T @ left[start:stop].reshape(-1))
                moved[start:stop, :, :N_MECHANICAL] = np.moveaxis(change[:, : stop - start] @ states, 0, -1)
            for channel in range(2):
                moved[:, channel, N_MECHANICAL + channel :: 2] = lagging * self.weights[channel]
            found.slopes.append(-projector.apply(moved)[0])
        return found

    def solve(self, theta: FloatArray, max_evaluations: int = 100) -> SeparableFit:
        """Return the least-squares fit from given start values, by Levenberg-Marquardt."""
        last: dict[bytes, Projected] = {}

        def evaluated(x: FloatArray) -> Projected:
            key = x.tobytes()
            if key not in last:
                last.clear()
                last[key] = self.at(x)
            return last[key]

        def residuals(x: FloatArray) -> FloatArray:
            return np.concatenate([r.ravel() for r in evaluated(x).residuals])

        def slopes(x: FloatArray) -> FloatArray:
            return np.concatenate([s.reshape(-1, len(x)) for s in evaluated(x).slopes])

        settings: dict[str, Any] = {"method": "lm", "x_scale": "jac", "max_nfev": max_evaluations}
        done: Any = scipy.optimize.least_squares(
            residuals, theta, slopes, xtol=1e-8, ftol=1e-10, gtol=1e-12, **settings
        )
        return SeparableFit(done.x, evaluated(done.x), done.status > 0, str(done.message))

    def _alive(self, theta: FloatArray) -> int:
        """Return the number of samples until the slowest free response is below 1e-6 of its start."""
        slowest = self.scale.rate * float(-np.linalg.eigvals(self.scale.matrix(theta)).real.max())
        return max(_SHORTEST, ceil(_DIED_OUT / (slowest * self.scale.sample_time))) if slowest > 1e-3 else sys.maxsize


class _Projector:
    """Projection that removes offset, harmonics and free responses from signals of a recording."""

    def __init__(self, data: RingData, bases: Sequence[FloatArray]) -> None:
        self._data, self._bases = data, bases
        # offset and harmonics are orthonormal, and there once for x and once for y
        self._mixed = [
            self._quiet_part(q.reshape(stop - start, 2, -1), data.quiet[start:stop]).T
            for q, (start, stop) in zip(bases, data.segments, strict=True)
        ]
        n = 2 * data.quiet.shape[1]
        self._gram = np.eye(n) - sum((w.T @ w for w in self._mixed), np.zeros((n, n)))

    def apply(self, signals: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return projected (n_samples, 2, m) signals, and signals without offset and harmonics only."""
        d, m = self._data, signals.shape[2]
        right = self._quiet_part(signals, d.quiet)
        for q, w, (start, stop) in zip(self._bases, self._mixed, d.segments, strict=True):
            right -= w.T @ (q.T @ signals[start:stop].reshape(-1, m))
        quiet = np.linalg.solve(self._gram, right).reshape(-1, 2 * m)
        left = signals - (d.quiet @ quiet).reshape(signals.shape)
        rest = left.copy()
        for q, (start, stop) in zip(self._bases, d.segments, strict=True):
            flat = left[start:stop].reshape(-1, m)
            rest[start:stop] = (flat - q @ (q.T @ flat)).reshape(stop - start, 2, m)
        return rest, left

    @staticmethod
    def _quiet_part(signals: FloatArray, quiet: FloatArray) -> FloatArray:
        """Return the products of (n, 2, m) signals with offset and harmonics, shape (2 n_quiet, m)."""
        return np.asarray((quiet.T @ signals.reshape(len(signals), -1)).reshape(-1, signals.shape[2]))
