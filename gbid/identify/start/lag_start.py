"""Start values of an actuator of second order from data, by least squares in the frequency domain."""

from __future__ import annotations

import numpy as np

from gbid.arrays import ComplexArray
from gbid.identify.data import Record
from gbid.identify.start.spectra import as_real, spectrum_of


def lag_start(records: tuple[Record, ...], channel: int, sample_time: float) -> tuple[float, float, float]:
    """Return poles [rad/s] and gain of ``u + a1 ud + a2 udd = kappa r`` with r constant between samples."""
    rows: list[ComplexArray] = []
    targets: list[ComplexArray] = []
    laplace: list[ComplexArray] = []
    n_records = len(records)
    for i, record in enumerate(records):
        omega, R = spectrum_of(record.inputs[:, [channel]], sample_time)
        _, U = spectrum_of(record.outputs[:, [channel]], sample_time)
        keep = (omega > 0) & (omega < 0.4 * np.pi / sample_time)
        s = 1j * omega[keep, None]
        held = R[keep] * (1 - np.exp(-s * sample_time)) / (s * sample_time)
        ends = np.zeros((len(s), 2 * n_records), complex)
        ends[:, 2 * i : 2 * i + 2] = np.hstack([np.ones_like(s), s])
        rows.append(np.hstack([held, -s * U[keep], -(s**2) * U[keep], ends]))
        targets.append(U[keep])
        laplace.append(np.asarray(s, complex))
    base, target, s = (np.concatenate(parts) for parts in (rows, targets, laplace))
    a1 = a2 = gain = 0.0
    for _ in range(4):  # Sanathanan-Koerner: weights 1 / last denominator, for the output error
        weight = 1 / (1 + a1 * s + a2 * s**2)
        columns = as_real(base * weight)
        size = np.linalg.norm(columns, axis=0)
        gain, a1, a2 = (np.linalg.lstsq(columns / size, as_real(target * weight)[:, 0], rcond=None)[0] / size)[:3]
    return (*_real_poles(a1, a2, sample_time), float(gain))


def _real_poles(a1: float, a2: float, sample_time: float) -> tuple[float, float]:
    """Return slow and fast pole of ``1 + a1 s + a2 s^2``; the nearest real stable pair for other poles."""
    fastest = 10 / sample_time
    a1 = max(a1, 2 / fastest)
    if a2 <= 0:
        return float(np.clip(1 / a1, 1.0, fastest)), fastest
    root = a1**2 - 4 * a2
    if root <= 0:
        middle = 1 / np.sqrt(a2)
        return float(0.8 * middle), float(1.25 * middle)
    slow, fast = 2 / (a1 + np.sqrt(root)), (a1 + np.sqrt(root)) / (2 * a2)
    return float(min(slow, fastest)), float(min(fast, fastest))
