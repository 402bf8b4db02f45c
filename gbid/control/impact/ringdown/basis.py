"""Model of a ring-down with two degrees of freedom: free responses, offset and harmonics of the shaft angle."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import expm

from gbid.arrays import BoolArray, FloatArray
from gbid.control.impact.measured import MeasuredImpact, Pulse, pulse_forcing
from gbid.discretise import propagate
from gbid.errors import DataError
from gbid.prefilter.shaft import shaft_motion
from gbid.recording import Recording

N_MECHANICAL = 8
"""Parameters of K and D."""
_SHORTEST = 20  # smallest number of samples of a ring-down
_STRETCHES, _SUDDEN = 20, 5.0  # a free decay grows from one of so many stretches to the next by less than this factor


@dataclass(frozen=True)
class Scale:
    """Scaling that makes the parameters of order one.

    Attributes
    ----------
    rate : float
        Angular frequency near that of the modes [rad/s].
    sample_time : float
        Time between samples [s].
    """

    rate: float
    sample_time: float

    def matrix(self, theta: FloatArray) -> FloatArray:
        """Return the system matrix [0 I; K D] with time in units of 1/rate; theta has -K and -D row by row."""
        A = np.zeros((4, 4))
        A[:2, 2:] = np.eye(2)
        A[2:, :2], A[2:, 2:] = -theta[:4].reshape(2, 2), -theta[4:8].reshape(2, 2)
        return A

    def free(self, theta: FloatArray, n: int) -> FloatArray:
        """Return the free responses, shape (n, 2, 4): one for each initial state."""
        return _powers(expm(self.matrix(theta) * self.rate * self.sample_time), n)[:, :2]

    def free_slopes(self, theta: FloatArray, n: int) -> FloatArray:
        """Return the derivatives of `free` with respect to the parameters of K and D, shape (8, n, 2, 4)."""
        slopes = np.zeros((N_MECHANICAL, n, 2, 4))
        A, step = self.matrix(theta), self.rate * self.sample_time
        for i in range(N_MECHANICAL):
            both = np.zeros((8, 8))  # the upper right block of exp([A dA; 0 A]) is the derivative of exp(A)
            both[:4, :4] = both[4:, 4:] = A
            both[2 + (i % 4) // 2, 4 + i % 2 + 2 * (i // 4)] = -1.0
            slopes[i] = _powers(expm(both * step), n)[:, :2, 4:]
        return slopes


def _powers(F: FloatArray, n: int) -> FloatArray:
    """Return F^0, F^1, ... F^(n-1), by doubling."""
    powers = np.eye(len(F))[None]
    with np.errstate(over="ignore", invalid="ignore"):  # of unstable start values, which the fit leaves out
        while len(powers) < n:
            powers = np.concatenate([powers, powers @ (powers[-1] @ F)])
    return powers[:n]


@dataclass(frozen=True, eq=False)
class RingData:
    """One recording, prepared for the fit.

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
    segments = []
    ends = [*(impact.start + 1 for impact in impacts), len(p)][1:]
    for impact, end in zip(impacts, ends, strict=True):
        first = impact.stop + skip
        used[impact.start + 1 : first] = False
        if end - first < _SHORTEST:
            raise DataError(
                f"recording {recording.name!r}: {max(end - first, 0)} samples after the impact at "
                f"{impact.start * recording.sample_time:.4f} s; a ring-down needs {_SHORTEST}: leave that impact out"
            )
        segments.append((first, end))
    if not impacts:
        if len(p) - skip < _SHORTEST:
            raise DataError(
                f"recording {recording.name!r}: {max(len(p) - skip, 0)} samples of a free decay; a ring-down needs "
                f"{_SHORTEST}: skip less, or leave it out"
            )
        used[:skip] = False
        segments.append((skip, len(p)))
        _refuse_hit(recording, p[skip:], skip)
    q, r = np.linalg.qr(quiet_basis(recording, harmonics) * used[:, None])
    size = np.abs(np.diag(r))
    if size.min() < 1e-8 * size.max():
        raise DataError(
            f"recording {recording.name!r}: too short for {harmonics} harmonics of the shaft angle; use fewer"
        )
    return RingData(recording.name, p * used[:, None], used, pulses, tuple(segments), q)


def _refuse_hit(recording: Recording, decay: FloatArray, skip: int) -> None:
    """Refuse a position that rises suddenly, which no free decay does: a force was not measured, or is zero.

    Raises
    ------
    DataError
        When it does.
    """
    length = max(len(decay) // _STRETCHES, 1)
    moved = decay - np.median(decay, axis=0)
    size = np.array([np.sqrt(np.mean(moved[i : i + length] ** 2)) for i in range(0, len(moved) - length + 1, length)])
    rises = np.flatnonzero((size[1:] > _SUDDEN * size[:-1]) & (size[1:] > 0.2 * size.max()))
    if len(rises):
        first, last = ((skip + (int(rises[i]) + k) * length) * recording.sample_time for i, k in ((0, 1), (-1, 2)))
        raise DataError(
            f"recording {recording.name!r}: the position rises suddenly after {first:.2g} s, so this is no free decay; "
            f"give the measured force (it is missing or zero), or leave out what comes before: skip_s={last:.2g}"
        )


def quiet_basis(recording: Recording, harmonics: int) -> FloatArray:
    """Return offset, and sines and cosines of the shaft angle, shape (n_samples, 1 + 2 harmonics)."""
    columns = [np.ones(recording.n_samples)]
    if harmonics:
        angle = recording.signal("phi")[:, 0]
        for order in range(1, harmonics + 1):
            columns += [np.cos(order * angle), np.sin(order * angle)]
    return np.column_stack(columns)


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
    """Return the force filtered by decays of given rates, shape (n_samples, n_columns); zero where not used.

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
        states = propagate(expm(A * sample_time), forcing, np.zeros(len(A))) * data.used[:, None]
        columns += [states[:, [i + 2 * part for i in directions]] for part in range(len(A) // 2)]
    return np.hstack(columns)
