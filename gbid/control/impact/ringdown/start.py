"""Start values of a ring-down fit by a subspace method (eigensystem realisation, Juang and Pappa 1985)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.linalg import logm

from gbid.arrays import ComplexArray, FloatArray
from gbid.control.impact.ringdown.basis import RingData

_BAND_HZ = 1000.0  # a higher sampling rate has little information on modes near 100 Hz
_ROWS = 12


def start_candidates(
    data: Sequence[RingData], sample_time: float, rate: float | None
) -> list[tuple[float, FloatArray]]:
    """Return several start values.

    Parameters
    ----------
    data : sequence of RingData
        Recordings.
    sample_time : float
        Time between samples [s].
    rate : float, optional
        Angular frequency near the modes [rad/s]; estimated when not given.

    Returns
    -------
    list of (rate, theta)
        Angular frequency that scales K and D, and the eight parameters; see `Scale`.
    """
    found = []
    for step in dict.fromkeys(max(1, round(1 / (band * sample_time))) for band in (_BAND_HZ, 2 * _BAND_HZ)):
        for rows in (_ROWS, 3 * _ROWS):
            guess = _realised(data, step, rows, sample_time)
            if guess is not None:
                found.append(guess)
    if rate is None:
        rate = found[0][0] if found else 2 * np.pi * 120.0
    for damping in (0.03, 0.4):
        found.append((rate, np.array([0.95, 0.0, 0.0, 1.05, 2 * damping, 0.0, 0.0, 2 * damping])))
    return found


def _realised(data: Sequence[RingData], step: int, rows: int, sample_time: float) -> tuple[float, FloatArray] | None:
    """Return K and D of the four dominant states of the shifted free responses."""
    blocks = []
    for d in data:
        quiet = d.position - d.quiet @ (d.quiet.T @ d.position)
        for start, stop in d.segments:
            y = quiet[start:stop:step]
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
    A = np.real(logm(A_d)) / (step * sample_time)
    C = observed[:2]
    change = np.vstack([C, C @ A])
    if np.linalg.cond(change / np.abs(change).max(axis=1, keepdims=True)) > 1e8:
        return None
    mechanical = (change @ A @ np.linalg.inv(change))[2:]
    rate = float(np.abs(eigenvalues_of(mechanical)).mean())
    theta = np.concatenate([-mechanical[:, :2].ravel() / rate**2, -mechanical[:, 2:].ravel() / rate])
    return (rate, theta) if np.isfinite(theta).all() else None


def eigenvalues_of(mechanical: FloatArray) -> ComplexArray:
    """Return the eigenvalues of [0 I; K D], given [K D]."""
    return np.linalg.eigvals(np.vstack([np.hstack([np.zeros((2, 2)), np.eye(2)]), mechanical])).astype(complex)
