"""Ring-down after impacts: two modes by separable least squares, with lags, offset and harmonics of the shaft angle."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from functools import cached_property, lru_cache
from math import ceil, log
from typing import Annotated, Literal

import numpy as np
import scipy
from annotated_types import Ge, Le

from gbid.control.impact.measured import MeasuredImpact, Pulse, find_impacts, force_of, pulse_forcing, pulses_of
from gbid.core.arrays import BoolArray, ComplexArray, FloatArray, oscillatory_modes
from gbid.core.brief import Brief
from gbid.core.errors import DataError, UsageError
from gbid.core.hdf5 import Stored
from gbid.core.notes import ControlNote
from gbid.core.option_types import CountOrZero, NotNegative
from gbid.discretise.exact import propagate
from gbid.prefilter.runout import shaft_motion
from gbid.recording import Recording
from gbid.recording.quality import stays_at_limits

N_MECHANICAL = 8
"""Parameters of K and D."""
_SHORTEST = 20  # smallest number of samples of a ring-down
_STRETCHES, _SUDDEN = 20, 5.0  # a free decay grows from one of so many stretches to the next by less than this factor


def _powers(F: FloatArray, n: int) -> FloatArray:
    """Return F^0, F^1, ... F^(n-1), by doubling."""
    powers = np.eye(len(F))[None]
    with np.errstate(over="ignore", invalid="ignore"):  # of unstable start values, which the fit leaves out
        while len(powers) < n:
            powers = np.concatenate([powers, powers @ (powers[-1] @ F)])
    return powers[:n]


@dataclass(frozen=True, eq=False)
class RingData:
    """Free responses, shaft angle and force of one recording, prepared for the ring-down fit.

    Attributes
    ----------
    name : str
        Name of the recording.
    position : (n_samples, 2) array
        Measured position; zero where not used.
    used : (n_samples,) bool array
        Samples that are fitted: all but those during an impact.
    pulses : tuple of Pulse
        Forces of the impacts.
    segments : tuple of (start, stop)
        Sample ranges of the free responses after the impacts.
    quiet : (n_samples, n_quiet) array
        Orthonormal basis of offset and harmonics of the shaft angle on the samples used.
    """

    name: str
    position: FloatArray
    used: BoolArray
    pulses: tuple[Pulse, ...]
    segments: tuple[tuple[int, int], ...]
    quiet: FloatArray

    @property
    def free_responses(self) -> list[FloatArray]:
        """Measured positions after each impact, with offset and harmonics of the shaft angle removed."""
        motion = self.position - self.quiet @ (self.quiet.T @ self.position)
        return [motion[start:stop] for start, stop in self.segments]


def ring_data(
    recording: Recording,
    position: str,
    impacts: Sequence[MeasuredImpact],
    pulses: tuple[Pulse, ...],
    harmonics: int,
    skip: int,
) -> RingData:
    """Return a recording cut into free responses, without the samples of the impacts and `skip` samples after each.

    Without impacts the whole recording is one free response; the first `skip` samples are left out.

    Raises
    ------
    DataError
        When the position does not have two channels, or when too few samples remain after an impact.
    """
    p = recording.signal(position)
    if p.shape[1] != 2:
        raise DataError(f"recording {recording.name!r}: {position!r} has {p.shape[1]} channels; a ring-down needs two")
    used = np.ones(len(p), dtype=bool)
    left_out = [(impact.start + 1, impact.stop + skip) for impact in impacts] or [(0, skip)]
    ends = [*(start for start, _ in left_out[1:]), len(p)]
    segments = tuple((first, end) for (_, first), end in zip(left_out, ends, strict=True))
    for (start, first), end in zip(left_out, ends, strict=True):
        used[start:first] = False
        if end - first < _SHORTEST:
            which = f"after the impact at {(start - 1) * recording.sample_time:.4f} s" if impacts else "of a free decay"
            remedy = "leave that impact out" if impacts else "skip less, or leave it out"
            raise DataError(
                f"recording {recording.name!r}: {max(end - first, 0)} samples {which}; a ring-down needs {_SHORTEST}: "
                + remedy
            )
    if not impacts:
        _refuse_hit(recording, p[skip:], skip)
    q, r = np.linalg.qr(quiet_basis(recording, harmonics) * used[:, None])
    size = np.abs(np.diag(r))
    if size.min() < 1e-8 * size.max():
        raise DataError(
            f"recording {recording.name!r}: too short for {harmonics} harmonics of the shaft angle; use fewer"
        )
    return RingData(recording.name, p * used[:, None], used, pulses, segments, q)


def _refuse_hit(recording: Recording, decay: FloatArray, skip: int) -> None:
    """Refuse a position with a sudden rise: no free decay rises, so that a force was not measured or is zero.

    Raises
    ------
    DataError
        When it does.
    """
    length = max(len(decay) // _STRETCHES, 1)
    motion = decay - np.median(decay, axis=0)
    size = np.array([np.sqrt(np.mean(motion[i : i + length] ** 2)) for i in range(0, len(motion) - length + 1, length)])
    rises = np.flatnonzero((size[1:] > _SUDDEN * size[:-1]) & (size[1:] > 0.2 * size.max()))
    if len(rises):
        first, last = ((skip + (int(rises[i]) + k) * length) * recording.sample_time for i, k in ((0, 1), (-1, 2)))
        raise DataError(
            f"recording {recording.name!r}: the position rises suddenly after {first:.2g} s, so this is no free decay; "
            f"give the measured force (it is missing or zero), or leave out what comes before: skip_s={last:.2g}"
        )


def quiet_basis(recording: Recording, harmonics: int) -> FloatArray:
    """Return offset, and sines and cosines of the shaft angle, as columns (n_samples, 1 + 2 harmonics)."""
    offset = np.ones((recording.n_samples, 1))
    if not harmonics:
        return offset
    angles = recording.signal("phi") * np.arange(1, harmonics + 1)
    return np.hstack([offset, np.cos(angles), np.sin(angles)])


def harmonics_for(recording: Recording, harmonics: int | None) -> int:
    """Return the number of harmonics to estimate: 10 by default when the shaft turns, none at rest."""
    if "phi" not in recording.signals:
        if harmonics:
            shaft_motion(recording)  # raises the error about the missing angle
        return 0
    turning = shaft_motion(recording).turns > 0
    return (10 if harmonics is None else harmonics) if turning else 0


def lagging_force(
    data: RingData, rates: Sequence[complex], directions: Sequence[int], sample_time: float
) -> FloatArray:
    """Return the force filtered by lags of real or complex rates, (n_samples, n_columns); zero for unused columns.

    A real rate is a lag of gain one. A complex one is a decay that oscillates, with a column for its sine and one for
    its cosine. Columns are in the order of the rates, with those of all directions for each.
    """
    columns = [np.zeros((len(data.position), 0))]
    for rate in rates:
        turning = rate.imag * np.array([[0.0, 1.0], [-1.0, 0.0]])
        A = -rate.real * np.eye(4) + np.kron(turning, np.eye(2))
        E = abs(rate) * np.eye(4, 2)
        if not rate.imag:
            A, E = A[:2, :2], E[:2]
        forcing = pulse_forcing(A, E, data.pulses, len(data.position), sample_time)
        states = propagate(scipy.linalg.expm(A * sample_time), forcing, np.zeros(len(A))) * data.used[:, None]
        columns += [states[:, [i + 2 * part for i in directions]] for part in range(len(A) // 2)]
    return np.hstack(columns)


# ---- Separable least squares of a ring-down by variable projection.
#
# Linear parameters are eliminated by projection; the others are iterated.

_DIED_OUT = 6 * log(10)
_SHORTEST_SEPARABLE = 50


@dataclass(frozen=True, eq=False)
class RingProblem:
    """Least-squares problem of free responses with common K, D and lags, and one initial state for each impact.

    The parameters are -K and -D row by row, scaled, then for each lag and each direction of force the gains to x and y.

    Attributes
    ----------
    data : tuple of RingData
        Recordings.
    rate : float
        Angular frequency near that of the modes, which scales K and D to order one [rad/s].
    sample_time : float
        Time between samples [s].
    directions : tuple of int
        Directions of force: 0 for x, 1 for y.
    weights : (2,) array
        Factors on the residuals of x and y.
    rates : tuple of complex
        Rates of the decays beside the modes [1/s]: lags, and with an imaginary part oscillations.
    """

    data: tuple[RingData, ...]
    rate: float
    sample_time: float
    directions: tuple[int, ...]
    weights: FloatArray = field(default_factory=lambda: np.ones(2))
    rates: tuple[complex, ...] = ()

    def matrix(self, theta: FloatArray) -> FloatArray:
        """Return the system matrix [0 I; K D] with time in units of 1/rate; theta has -K and -D row by row."""
        A = np.zeros((4, 4))
        A[:2, 2:] = np.eye(2)
        A[2:, :2], A[2:, 2:] = -theta[:4].reshape(2, 2), -theta[4:8].reshape(2, 2)
        return A

    def poles(self, theta: FloatArray) -> ComplexArray:
        """Return the eigenvalues of [0 I; K D] [rad/s]."""
        return np.asarray(self.rate * np.linalg.eigvals(self.matrix(theta)), complex)

    def modes(self, theta: FloatArray) -> FloatArray:
        """Return frequency 1 [Hz], damping 1, frequency 2, damping 2; nan when a pair of poles is real."""
        modes = oscillatory_modes(self.poles(theta))
        return modes.ravel() if len(modes) == 2 else np.full(4, np.nan)

    def free(self, theta: FloatArray, n: int) -> FloatArray:
        """Return the free responses, shape (n, 2, 4): one for each initial state."""
        return _powers(scipy.linalg.expm(self.matrix(theta) * self.rate * self.sample_time), n)[:, :2]

    def free_slopes(self, theta: FloatArray, n: int) -> FloatArray:
        """Return derivatives of the free responses with respect to stiffness and damping, shape (8, n, 2, 4)."""
        slopes = np.zeros((N_MECHANICAL, n, 2, 4))
        A, step = self.matrix(theta), self.rate * self.sample_time
        for i in range(N_MECHANICAL):
            both = np.zeros((8, 8))  # the upper right block of exp([A dA; 0 A]) is the derivative of exp(A)
            both[:4, :4] = both[4:, 4:] = A
            both[2 + (i % 4) // 2, 4 + i % 2 + 2 * (i // 4)] = -1.0
            slopes[i] = _powers(scipy.linalg.expm(both * step), n)[:, :2, 4:]
        return slopes

    @property
    def n_values(self) -> int:
        """Number of measured values that the fit uses."""
        return 2 * sum(int(d.used.sum()) for d in self.data)

    @property
    def n_linear(self) -> int:
        """Number of linear parameters: initial states, offsets and harmonics."""
        return sum(2 * d.quiet.shape[1] + 4 * len(d.segments) for d in self.data)

    @cached_property
    def lagging(self) -> tuple[FloatArray, ...]:
        """Force of each recording, filtered by the lags."""
        return tuple(lagging_force(d, self.rates, self.directions, self.sample_time) for d in self.data)

    def with_decays(self, theta: FloatArray, rates: Sequence[complex]) -> tuple[RingProblem, FloatArray, float]:
        """Return the problem with additional decays of given rates, its parameters, and its sum of squares.

        The gains of the decays come from linear least squares, with K and D as they are.
        """
        problem = replace(self, rates=tuple(rates))
        n_columns = len(self.directions) * sum(2 if rate.imag else 1 for rate in rates)
        longer = np.concatenate([theta[:N_MECHANICAL], np.zeros(2 * n_columns)])
        projected, changes = problem.at(longer, mechanical=False)
        slopes = np.concatenate([s.reshape(-1, 2 * n_columns) for s in changes])
        residuals = np.concatenate([r.ravel() for r in projected])
        gains = np.linalg.lstsq(slopes, -residuals, rcond=None)[0]
        longer[N_MECHANICAL:] = gains
        return problem, longer, float(((residuals + slopes @ gains) ** 2).sum())

    def at(
        self, theta: FloatArray, *, slopes: bool = True, mechanical: bool = True
    ) -> tuple[list[FloatArray], list[FloatArray]]:
        """Return for each recording the projected residuals (n, 2) and their derivatives (n, 2, n_parameters).

        The derivatives are those of Kaufman's approximation (1975), which leaves out terms proportional to the
        residuals: none without `slopes`, those by K and D only if `mechanical`.
        """
        alive = self._alive(theta)
        longest = max(min(stop - start, alive) for d in self.data for start, stop in d.segments)
        free = self.free(theta, longest) * self.weights[:, None]
        change = self.free_slopes(theta, longest) * self.weights[:, None] if slopes and mechanical else None
        residuals, derivatives = [], []
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
            residuals.append(residual[:, :, 0])
            if not slopes:
                continue
            first = 0 if change is None else N_MECHANICAL
            changes = np.zeros((len(residual), 2, first + gains.size))
            if change is not None:
                for (start, stop), (q, r) in zip(segments, bases, strict=True):
                    states = scipy.linalg.solve_triangular(r, q.T @ left[start:stop].reshape(-1))
                    changes[start:stop, :, :first] = np.moveaxis(change[:, : stop - start] @ states, 0, -1)
            for channel in range(2):
                changes[:, channel, first + channel :: 2] = lagging * self.weights[channel]
            derivatives.append(-projector.apply(changes)[0])
        return residuals, derivatives

    @property
    def oscillations(self) -> FloatArray:
        """Natural frequency [Hz] and damping factor of the additional oscillatory decays, shape (n, 2)."""
        rates = [(abs(rate) / (2 * np.pi), rate.real / abs(rate)) for rate in self.rates if rate.imag]
        return np.array(rates).reshape(-1, 2)

    def solve(self, theta: FloatArray) -> SeparableFit | None:
        """Return the least-squares fit from given start values (Levenberg-Marquardt); None if a response overflows.

        A response may overflow at the start values or during the iteration.
        """

        @lru_cache(maxsize=1)
        def evaluated(x: bytes) -> tuple[list[FloatArray], list[FloatArray]]:
            return self.at(np.frombuffer(x))

        def residuals(x: FloatArray) -> FloatArray:
            return np.concatenate([r.ravel() for r in evaluated(x.tobytes())[0]])

        def slopes(x: FloatArray) -> FloatArray:
            return np.concatenate([s.reshape(-1, len(x)) for s in evaluated(x.tobytes())[1]])

        tolerances = {"xtol": 1e-8, "ftol": 1e-10, "gtol": 1e-12, "max_nfev": 100}
        with contextlib.suppress(np.linalg.LinAlgError, ValueError):
            done = scipy.optimize.least_squares(residuals, theta, slopes, method="lm", x_scale="jac", **tolerances)
            return SeparableFit(self, done.x, *evaluated(done.x.tobytes()), done.status > 0, str(done.message))
        return None

    def _alive(self, theta: FloatArray) -> int:
        """Return the number of samples until the slowest free response is below 1e-6 of its start."""
        slowest = float(-self.poles(theta).real.max())
        if slowest <= 1e-3:
            return sys.maxsize
        return max(_SHORTEST_SEPARABLE, ceil(_DIED_OUT / (slowest * self.sample_time)))


@dataclass(frozen=True, eq=False)
class SeparableFit:
    """Result of the separable least-squares fit: nonlinear parameters, residuals and their derivatives.

    Attributes
    ----------
    problem : RingProblem
        Problem that was solved.
    theta : (n_parameters,) array
        Parameters.
    residuals, slopes : list of array
        Residuals and derivatives at these parameters, see `RingProblem.at`.
    converged : bool
        Whether the solver converged.
    message : str
        Message of the solver.
    """

    problem: RingProblem
    theta: FloatArray
    residuals: list[FloatArray]
    slopes: list[FloatArray]
    converged: bool
    message: str

    @property
    def mean_rate(self) -> float:
        """Mean magnitude of the eigenvalues of the two modes [rad/s]."""
        return float(np.abs(self.problem.poles(self.theta)).mean())

    @property
    def squares(self) -> float:
        """Sum of squared residuals."""
        return _squares(self.residuals)

    @property
    def criterion(self) -> float:
        """Schwarz's criterion (BIC) up to a constant; residuals below 1e-6 of the signal count as rounding."""
        n = self.problem.n_values
        parameters = len(self.theta) + self.problem.n_linear + 2 * len(self.problem.oscillations)
        return float(n * np.log(max(self.squares / n, 1e-12)) + np.log(n) * parameters)

    @property
    def channel_rms(self) -> FloatArray:
        """Rms residuals of x and y over all samples used."""
        squares = sum((r**2).sum(axis=0) for r in self.residuals)
        return np.asarray(np.sqrt(squares * 2 / self.problem.n_values) / self.problem.weights)

    @property
    def covariance(self) -> FloatArray:
        """Covariance of the parameters for correlated residuals."""
        stacked = np.concatenate([s.reshape(-1, s.shape[-1]) for s in self.slopes])
        bread = np.linalg.pinv(stacked.T @ stacked, hermitian=True)
        used = [d.used for d in self.problem.data]
        middle = covariance_of_sum(self.slopes, self.residuals, used, self.problem.sample_time)
        return np.asarray(bread @ middle @ bread)


def _squares(residuals: list[FloatArray]) -> float:
    return float(sum((r**2).sum() for r in residuals))


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
        """Return projected (n_samples, 2, m) signals, and the signals with only offset and harmonics removed."""
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
        """Return the products of (n, 2, m) signals with the offset and the harmonics, shape (2 n_quiet, m)."""
        return np.asarray((quiet.T @ signals.reshape(len(signals), -1)).reshape(-1, signals.shape[2]))


_BAND_HZ = 1000.0  # a higher sampling rate has little information on modes near 100 Hz
_ROWS = 12


def start_candidates(
    data: Sequence[RingData], sample_time: float, start: Sequence[tuple[float, float]] | None
) -> list[tuple[float, FloatArray]]:
    """Return several start values of K and D for the fit of two modes.

    Parameters
    ----------
    data : sequence of RingData
        Recordings.
    sample_time : float
        Time between samples [s].
    start : sequence of (frequency_hz, damping), optional
        Two modes that are tried as well.

    Returns
    -------
    list of (rate, theta)
        Angular frequency that scales K and D, and the eight parameters; see `RingProblem`.
    """
    candidates = []
    for step in dict.fromkeys(max(1, round(1 / (band * sample_time))) for band in (_BAND_HZ, 2 * _BAND_HZ)):
        for rows in (_ROWS, 3 * _ROWS):
            guess = _realised(data, step, rows, sample_time)
            if guess is not None:
                candidates.append(guess)
    rate = candidates[0][0] if candidates else 2 * np.pi * 120.0
    if start is not None:
        rate = 2 * np.pi * float(np.mean([f for f, _ in start]))
        (k_x, d_x), (k_y, d_y) = (((2 * np.pi * f / rate) ** 2, 2 * z * 2 * np.pi * f / rate) for f, z in start)
        candidates.insert(0, (rate, np.array([k_x, 0, 0, k_y, d_x, 0, 0, d_y])))
    for damping in (0.03, 0.4):
        candidates.append((rate, np.array([0.95, 0.0, 0.0, 1.05, 2 * damping, 0.0, 0.0, 2 * damping])))
    return candidates


def _realised(data: Sequence[RingData], step: int, rows: int, sample_time: float) -> tuple[float, FloatArray] | None:
    """Return K and D of the four dominant states of the free responses (eigensystem realisation)."""
    blocks = []
    for d in data:
        for response in d.free_responses:
            y = response[::step]
            columns = min(len(y) - rows, 60 * rows)
            if columns > 4:
                blocks.append(np.vstack([y[i : i + columns].T for i in range(rows + 1)]))
    if not blocks:
        return None
    hankel = np.hstack(blocks)
    u, s, _ = np.linalg.svd(hankel, full_matrices=False)
    if len(s) < 4 or s[3] <= 1e-12 * s[0]:
        return None
    observed = u[:, :4]
    A_d = np.linalg.lstsq(observed[:-2], observed[2:], rcond=None)[0]
    eigenvalues = np.linalg.eigvals(A_d)
    if (np.abs(eigenvalues) < 1e-6).any() or (np.abs(eigenvalues.imag) < 1e-9 * np.abs(eigenvalues)).any():
        return None  # real poles: no two oscillations
    A = np.real(scipy.linalg.logm(A_d)) / (step * sample_time)
    C = observed[:2]
    change = np.vstack([C, C @ A])
    if np.linalg.cond(change / np.abs(change).max(axis=1, keepdims=True)) > 1e8:
        return None
    mechanical = (change @ A @ np.linalg.inv(change))[2:]
    rate = float(np.abs(np.log(eigenvalues)).mean()) / (step * sample_time)
    theta = np.concatenate([-mechanical[:, :2].ravel() / rate**2, -mechanical[:, 2:].ravel() / rate])
    return (rate, theta) if np.isfinite(theta).all() else None


_MOST = 2
"""Largest number of decays that oscillate."""
_RATIOS = (0.5, 0.7, 1.0, 1.4, 2.0, 3.0, 5.0)
"""Frequencies at which the search starts, over that of the modes."""
_START_DAMPING = 0.6
_DAMPING = (0.02, 0.98)
_EVALUATIONS = 40


def add_oscillations(solved: SeparableFit) -> SeparableFit:
    """Return the fit with at most two additional oscillatory decays; Schwarz's criterion selects their number.

    A loop with filters rings in more modes than two. If they are left out, the damping of the two modes can be a fifth
    too low. Frequency and damping of a further decay are those that reduce the residuals most with the two modes as
    they are. Then all other parameters are fitted together. Such a decay stands for all modes that are not fitted. It
    need not be one of them.
    """
    for _ in range(_MOST):
        larger, theta, _squares = solved.problem.with_decays(solved.theta, [*solved.problem.rates, _best_rate(solved)])
        more = larger.solve(theta)
        if more is None or solved.criterion <= more.criterion:
            break
        solved = more
    return solved


def _best_rate(solved: SeparableFit) -> complex:
    """Return the rate of the additional decay that reduces the residuals most, with the two modes fixed."""

    def rate_of(v: FloatArray) -> complex:
        size, damping = np.exp(v[0]), float(np.clip(v[1], *_DAMPING))
        return complex(size * damping, size * np.sqrt(1 - damping**2))

    def squares(v: FloatArray) -> float:
        outside = max(_DAMPING[0] - v[1], v[1] - _DAMPING[1], 0.0)
        left = solved.problem.with_decays(solved.theta, [*solved.problem.rates, rate_of(v)])[2]
        return left * (1.0 + float(outside))

    starts = [np.array([np.log(solved.mean_rate * ratio), _START_DAMPING]) for ratio in _RATIOS]
    start = min(starts, key=squares)
    corners = start + np.array([[0.0, 0.0], [0.3, 0.0], [0.0, -0.25]])
    options = {"maxfev": _EVALUATIONS, "initial_simplex": corners}
    return rate_of(scipy.optimize.minimize(squares, start, method="Nelder-Mead", options=options).x)


LAGS = 3
"""Number of lags of ``"auto"`` when the data require lags."""
_SLOWEST, _FASTEST = 1.0, 3.0  # rates of the lags over the angular frequency of the modes
_GUESSES = 2  # number of start values from which a fit is made


def fit_lags(
    problem: RingProblem, guesses: Sequence[tuple[float, FloatArray]], lags: int | Literal["auto"]
) -> SeparableFit:
    """Return the fit of two modes, with lags if they are requested or if the data require them.

    Where ``"auto"`` chooses lags, it also chooses decays that oscillate, see `add_oscillations`.

    The rates of the lags are fixed around the frequency of the modes. Sums of such decays approximate any other decay
    in this range. Estimated rates would become equal, or would fit noise.

    Parameters
    ----------
    problem : RingProblem
        The problem without lags.
    guesses : sequence of (rate, theta)
        Rates [rad/s] that scale K and D, and start values.
    lags : int or "auto"
        Number of lags.

    Returns
    -------
    SeparableFit

    Raises
    ------
    DataError
        When two modes cannot be fitted.
    """
    tries = []
    for rate, theta in guesses:
        scaled = replace(problem, rate=rate)
        with contextlib.suppress(np.linalg.LinAlgError, ValueError):  # the response of an unstable guess can overflow
            tries.append((_squares(scaled.at(theta, slopes=False)[0]), scaled, theta))
    best = sorted((t for t in tries if np.isfinite(t[0])), key=lambda t: t[0])[:_GUESSES]
    fits = [fit for _, scaled, theta in best if (fit := scaled.solve(theta)) is not None]
    where = f"recording {problem.data[0].name!r}"
    if not fits:
        raise DataError(f"{where}: no two modes fit the ring-down; give start=[(f, zeta), ...]")
    solved = min(fits, key=lambda fit: fit.squares)
    count = LAGS if lags == "auto" else lags
    if count == 0:
        return solved
    steps = np.geomspace(_SLOWEST, _FASTEST, count) if count > 1 else np.array([np.sqrt(_SLOWEST * _FASTEST)])
    larger, theta, _ = solved.problem.with_decays(solved.theta, (solved.mean_rate * steps).tolist())
    more = larger.solve(theta)
    if lags == "auto":
        return solved if more is None or solved.criterion <= more.criterion else add_oscillations(more)
    if more is None:
        raise DataError(f"{where}: no fit with {lags} lags; use fewer, or lags='auto'")
    return more


MEMORY_S = 20e-3
"""Longest correlation time of the residuals that is taken into account [s]: two periods of the slowest mode."""


def covariance_of_sum(
    influence: Sequence[FloatArray], residuals: Sequence[FloatArray], used: Sequence[BoolArray], sample_time: float
) -> FloatArray:
    r"""Return the covariance of :math:`\sum_t J(t)^T e(t)` for stationary e and independent recordings.

    The autocovariance of e up to `MEMORY_S` has the triangular weights of Bartlett: the matrix stays positive
    semidefinite (Newey and West 1987).

    Parameters
    ----------
    influence : sequence of (n_samples, n_channels, n_parameters) array
        J of each recording, zero where samples are not used.
    residuals : sequence of (n_samples, n_channels) array
        Residuals e, zero where not used.
    used : sequence of (n_samples,) bool array
        Samples that are used.
    sample_time : float
        Time between samples [s].

    Returns
    -------
    (n_parameters, n_parameters) array
        Covariance of the sum.
    """
    n_parameters, n_lags = influence[0].shape[2], round(MEMORY_S / sample_time)
    count = max(sum(int(mask.sum()) for mask in used), 1)
    total = np.zeros((n_parameters, n_parameters))
    for lag in range(n_lags + 1):
        products = sum(e[lag:].T @ e[: len(e) - lag] for e in residuals if len(e) > lag)
        gamma = np.atleast_2d(products) * (1 - lag / (n_lags + 1)) / count
        for J in influence:
            if len(J) > lag:
                shifted, weighted = J[lag:].reshape(-1, n_parameters), np.matmul(gamma, J[: len(J) - lag])
                part = shifted.T @ weighted.reshape(-1, n_parameters)
                total += part if lag == 0 else part + part.T
    return total


# ---- Result of a ring-down fit.


class RingDownStatus(StrEnum):
    """Reason why a ring-down fit ended."""

    CONVERGED = "converged"
    NOT_CONVERGED = "not converged"
    NO_OSCILLATIONS = "no two oscillations: at least one pair of poles is real"
    """The response is damped so much that it does not oscillate."""
    NO_DECAY = "no decay: a mode does not decay within its standard deviation"
    CLIPPED = "clipped: positions stay at the limit of their sensor"


@dataclass(frozen=True, eq=False)
class RingDown(Brief):
    """Frequency and damping of two modes from ring-downs, as `fit_ringdown` returns them.

    Attributes
    ----------
    frequency_hz, damping : (2,) array
        Natural frequencies [Hz] and damping factors, by rising frequency; nan when K and D have real poles.
    frequency_std, damping_std : (2,) array
        Standard deviations [Hz, 1], for residuals that are correlated in time and between x and y.
    covariance : (4, 4) array
        Covariance of frequency 1, damping 1, frequency 2, damping 2.
    stiffness, damping_matrix : (2, 2) array
        K [1/s^2] and D [1/s].
    lag_rates : (n_lags,) array
        Rates of the fitted lags [1/s].
    residual_rms : (2,) array
        Rms residuals of x and y [m].
    n_impacts : int
        Number of impacts.
    recordings : tuple of str
        Names of the recordings.
    harmonics : int
        Number of estimated harmonics of the shaft angle.
    status : RingDownStatus
        Why the fit ended.
    notes : tuple of str
        Remarks for the reader of the result.
    oscillations : (n, 2) array
        Natural frequency [Hz] and damping factor of decays that oscillate and were fitted beside the modes. They stand
        for all further modes of the loop and need not be one of them.
    """

    frequency_hz: Annotated[FloatArray, Stored("Hz", "natural frequencies from the ring-down", "2")]
    damping: Annotated[FloatArray, Stored("1", "damping factors from the ring-down", "2")]
    frequency_std: Annotated[FloatArray, Stored("Hz", "standard deviations of the frequencies", "2")]
    damping_std: Annotated[FloatArray, Stored("1", "standard deviations of the damping factors", "2")]
    covariance: Annotated[FloatArray, Stored("", "covariance of frequency 1, damping 1, frequency 2, damping 2", "4 4")]
    stiffness: Annotated[FloatArray, Stored("1/s^2", "K of the free response", "2 2")]
    damping_matrix: Annotated[FloatArray, Stored("1/s", "D of the free response", "2 2")]
    lag_rates: Annotated[FloatArray, Stored("1/s", "rates of the decays beside the modes", "lags")]
    residual_rms: Annotated[FloatArray, Stored("m", "what the fit leaves of x and y", "2")]
    n_impacts: int
    recordings: tuple[str, ...]
    harmonics: int
    status: RingDownStatus
    notes: tuple[str, ...] = ()
    oscillations: Annotated[FloatArray, Stored("Hz, 1", "decays that oscillate, beside the modes", "n 2")] = field(
        default_factory=lambda: np.zeros((0, 2))
    )

    def modes(self) -> list[tuple[float, float]]:
        """Return natural frequency [Hz] and damping factor of each mode, as `LinearModel.modes` does."""
        return [(float(f), float(z)) for f, z in zip(self.frequency_hz, self.damping, strict=True)]

    @property
    def success(self) -> bool:
        """Whether the status is ``CONVERGED``."""
        return self.status is RingDownStatus.CONVERGED

    @property
    def aperiodic(self) -> bool:
        """Whether the damping is so strong that two oscillations cannot be found; the fit then cannot succeed."""
        return self.status is RingDownStatus.NO_OSCILLATIONS

    def interval(self, level: float = 0.95) -> FloatArray:
        """Return confidence intervals, shape (4, 2): frequency 1, damping 1, frequency 2, damping 2.

        Parameters
        ----------
        level : float
            Confidence level between 0 and 1.
        """
        if not 0 < level < 1:
            raise UsageError(f"level = {level}; give a number between 0 and 1")
        centre = np.column_stack([self.frequency_hz, self.damping]).ravel()
        half = scipy.special.ndtri(0.5 + level / 2) * np.sqrt(np.diag(self.covariance))
        return np.column_stack([centre - half, centre + half])


# ---- Modes of a rotor identified from its ring-down after impacts ("obtained experimentally" in Tables 3 and 4).
#
# After an impact the disc moves freely. The model has two degrees of freedom, and decays without oscillation:
#
# .. math::
#
#     p(t) = q(t) + \sum_l R_l \int_{-\infty}^t \rho_l e^{-\rho_l (t - s)} f(s)\, ds
#            + p_0 + \sum_n c_n \cos n\phi + s_n \sin n\phi, \quad \ddot q = K q + D \dot q
#
# K, D and the lags are common to all impacts. Each impact has an initial state. Each recording has an offset and, when
# the shaft turns, harmonics of the shaft angle. So unbalance and run-out are estimated together with the modes and are
# not filtered out before (Figs. 26, 27).


def fit_ringdown(
    recordings: Recording | Sequence[Recording],
    *,
    position: str = "p",
    force: str | tuple[()] = "f",
    axis: str | None = None,
    lags: Annotated[int, Ge(0), Le(6)] | Literal["auto"] = "auto",
    harmonics: CountOrZero | None = None,
    skip_s: NotNegative = 0.0,
    start: Sequence[tuple[float, float]] | None = None,
) -> RingDown:
    """Return two modes fitted to the free responses after impacts (paper, Sec. 5.1, Tables 3 and 4).

    A recording without a force, or with one that is zero throughout, is one free response from its first sample.

    Parameters
    ----------
    recordings : Recording or sequence of Recording
        Recordings of one machine at one operating point. Impacts along x and along y together give the best accuracy.
    position, force : str
        Names of the signals: disc position of two channels [m], force of the hammer [N]. ``force=()`` for recordings of
        free decays, as ``inputs=()`` of `gbid.fit`.
    axis : {"x", "y"}, optional
        Direction of a force with one channel.
    lags : int or "auto"
        Number of decays without oscillation to fit besides the modes. In open loop there are none. A closed loop has
        those of actuators, low-pass and delays; a fit without them would overestimate the damping. ``"auto"`` chooses
        none or 3 by Schwarz's criterion (BIC), and with them up to two decays that oscillate: a loop with filters has
        more modes that ring than two. Free decays without a measured force have none.
    harmonics : int, optional
        Number of harmonics of the shaft angle `phi` to estimate; by default 10 when the shaft turns.
    skip_s : float
        Time after the end of an impact, or from the first sample of a free decay, that is left out [s].
    start : two of (frequency_hz, damping), optional
        Two modes as an additional start value.

    Returns
    -------
    RingDown
        When the fit does not converge, or when there are no two oscillations, `success` and `status` show it.

    Raises
    ------
    DataError
        When a force has no impact, too few samples follow one, or a signal is missing.
    UsageError
        When an argument is out of range.
    """
    group = [recordings] if isinstance(recordings, Recording) else list(recordings)
    _check_arguments(group, start)
    h = group[0].sample_time
    forces = [force_of(rec, force, axis) if force and rec.signal(force).any() else None for rec in group]
    impacts = [() if f is None else find_impacts(f, h, rec.name) for rec, f in zip(group, forces, strict=True)]
    if not any(impacts):
        if lags not in ("auto", 0):
            raise UsageError(f"fit_ringdown: lags = {lags}; free decays have no force that acts through lags: give 0")
        lags = 0
    counts = [harmonics_for(rec, harmonics) for rec in group]
    data = tuple(
        ring_data(rec, position, hits, () if f is None else pulses_of(f, hits), count, round(skip_s / h))
        for rec, f, hits, count in zip(group, forces, impacts, counts, strict=True)
    )
    unit = float(np.sqrt(np.mean([np.mean(np.vstack(d.free_responses) ** 2) for d in data])))
    if unit == 0:
        raise DataError(f"recording {group[0].name!r}: {position!r} does not move after the impacts; check the signal")
    data = tuple(replace(d, position=d.position / unit) for d in data)

    directions = tuple(i for i, word in enumerate("xy") if any(hit.axis == word for hits in impacts for hit in hits))
    solved = fit_lags(RingProblem(data, 1.0, h, directions), start_candidates(data, h, start), lags)
    rms = solved.channel_rms
    if (rms > 0).all():  # the noise of the channels differs: fit again with weights from the residuals
        weighted = replace(solved.problem, weights=float(np.sqrt(np.mean(rms**2))) / rms).solve(solved.theta)
        solved = weighted or replace(solved, converged=False, message="a response overflows")
    return _result(solved, group, unit, impacts, max(counts))


def _check_arguments(group: list[Recording], start: Sequence[tuple[float, float]] | None) -> None:
    if not group:
        raise UsageError("fit_ringdown: no recording given; give at least one with an impact")
    if start is not None and (len(start) != 2 or any(f <= 0 or not abs(z) < 1 for f, z in start)):
        raise UsageError(f"fit_ringdown: start = {start}; give two modes (frequency in Hz, damping factor below 1)")
    for rec in group[1:]:
        if rec.sample_time != group[0].sample_time:
            raise UsageError(
                f"recordings {group[0].name!r} and {rec.name!r} are sampled at {group[0].sample_time} s and "
                f"{rec.sample_time} s; fit them separately"
            )


_SURE = 2.0  # standard deviations by which a damping factor must be positive


def _limits_in_words(data: RingData, unit: float) -> list[str]:
    """Return a text with the channels whose free responses stay at a limit, and the limit."""
    free = np.vstack([data.position[start:stop] for start, stop in data.segments])
    return [
        f"recording {data.name!r}: position {axis} stays at {', '.join(f'{unit * limit:.3g} m' for limit in limits)}"
        for axis, column in zip("xy", free.T, strict=True)
        if (limits := stays_at_limits(column))
    ]


def _result(
    solved: SeparableFit,
    group: list[Recording],
    unit: float,
    impacts: Sequence[Sequence[MeasuredImpact]],
    harmonics: int,
) -> RingDown:
    """Return the modes of a ring-down fit with their covariance; positions are in multiples of `unit` metres."""
    theta, problem = solved.theta, solved.problem
    K, D = -theta[:4].reshape(2, 2) * problem.rate**2, -theta[4:8].reshape(2, 2) * problem.rate
    modes = problem.modes(theta)
    spread = np.full((4, 4), np.nan)
    status = RingDownStatus.CONVERGED if solved.converged else RingDownStatus.NOT_CONVERGED
    if np.isnan(modes).any():
        status = RingDownStatus.NO_OSCILLATIONS
    else:
        steps = 1e-6 * np.eye(len(theta))
        slope = np.column_stack([(problem.modes(theta + s) - problem.modes(theta - s)) / 2e-6 for s in steps])
        spread = slope @ solved.covariance @ slope.T
    std = np.sqrt(np.diag(spread))
    doubles = sum(impact.pulses > 1 for each in impacts for impact in each)
    further = problem.oscillations
    names = ", ".join(f"{f:.0f} Hz with damping {z:.2f}" for f, z in further)
    notes = []
    if not solved.converged:
        notes.append(
            ControlNote.SOLVER_STOPPED(
                f"the solver stopped before it converged ({solved.message}); give start=, or use a longer decay"
            )
        )
    if doubles:
        text = f"{doubles} double hit(s); the free response is taken from the end of the last pulse"
        notes.append(ControlNote.DOUBLE_HIT(text))
    if names:
        text = f"the response rings in more than two modes; the further modes are fitted as decays at {names}"
        notes.append(ControlNote.FURTHER_MODES(text))
    if status is RingDownStatus.CONVERGED and (modes[1::2] <= _SURE * std[1::2]).any():
        status = RingDownStatus.NO_DECAY
    if clipped := [text for data in problem.data for text in _limits_in_words(data, unit)]:
        status = RingDownStatus.CLIPPED
        notes.append(ControlNote.CLIPPED(f"{'; '.join(clipped)}: widen its range, or use the later part of the decay"))
    if status is RingDownStatus.CONVERGED and std[0] + std[2] > modes[2] - modes[0]:
        text = "the frequencies differ by less than their uncertainty: which mode is which is not certain"
        notes.append(ControlNote.MODES_ALIKE(text))
    return RingDown(
        modes[::2],
        modes[1::2],
        std[::2],
        std[1::2],
        spread,
        K,
        D,
        np.array([rate.real for rate in problem.rates if not rate.imag]),
        solved.channel_rms * unit,
        sum(map(len, impacts)),
        tuple(rec.name for rec in group),
        harmonics,
        status,
        tuple(notes),
        further,
    )
