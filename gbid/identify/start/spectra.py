"""Spectra of records, and complex equations as real ones."""

from __future__ import annotations

import numpy as np

from gbid.arrays import ComplexArray, FloatArray
from gbid.identify.data import column_means


def spectrum_of(values: FloatArray, sample_time: float) -> tuple[FloatArray, ComplexArray]:
    """Return angular frequencies (n_f,) [rad/s] and transforms (n_f, n) of a record's samples without the mean."""
    transform = np.fft.rfft(values - column_means(values), axis=0) * sample_time
    return np.asarray(2 * np.pi * np.fft.rfftfreq(len(values), sample_time), float), transform


def as_real(values: ComplexArray) -> FloatArray:
    """Return real parts above imaginary parts, (2 n, n_columns), of complex equations (n, n_columns)."""
    return np.vstack([values.real, values.imag])
