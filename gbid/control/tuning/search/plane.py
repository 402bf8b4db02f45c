"""Planes of eigenvalues: true rates and frequencies of loops that are given by their bilinear transform."""

from __future__ import annotations

import numpy as np

from gbid.arrays import ComplexArray, FloatArray

_FASTEST = 40.0
"""Largest decay of a mode in one sample, as an exponent; a dead-beat mode (z = 0) is given this rate."""
FADE = 0.25
"""Width of the fading in `brevity`, in units of the decay rate times the sample time."""


def true_rates(values: ComplexArray, sample_time: float | None) -> ComplexArray:
    r"""Return the continuous-time rates of eigenvalues [rad/s], of any shape.

    A sampled loop with eigenvalues z is searched in the plane of :math:`w = (2 / T) (z - 1) / (z + 1)`, in which the
    stable region is the left half-plane and all gains over frequency are the same. The rate of a mode is
    :math:`\lambda = \log(z) / T = (2 / T) \operatorname{artanh}(w T / 2)`.

    Parameters
    ----------
    values : complex array
        Eigenvalues in the plane of the search.
    sample_time : float or None
        T [s]; None for a continuous loop, whose eigenvalues are its rates.
    """
    if sample_time is None:
        return values
    z = _z(values, sample_time)
    size = np.maximum(np.abs(z), np.exp(-_FASTEST))
    return np.asarray((np.log(size) + 1j * np.angle(z)) / sample_time)


def rate_slopes(values: ComplexArray, sample_time: float | None) -> ComplexArray:
    """Return the derivative of `true_rates` by the eigenvalue in the plane of the search, of the same shape."""
    if sample_time is None:
        return np.ones_like(values)
    half = values * sample_time / 2
    return np.asarray(1.0 / np.where(np.abs(1 - half**2) > 1e-12, 1 - half**2, 1e-12))


def true_frequencies(frequency: FloatArray, sample_time: float | None) -> FloatArray:
    """Return true angular frequencies [rad/s] of angular frequencies in the plane of the search."""
    if sample_time is None:
        return frequency
    return np.asarray(2 / sample_time * np.arctan(frequency * sample_time / 2))


def searched_frequencies(frequency: FloatArray, sample_time: float | None) -> FloatArray:
    """Return angular frequencies in the plane of the search of true ones [rad/s]; the inverse of `true_frequencies`."""
    if sample_time is None:
        return frequency
    return np.asarray(2 / sample_time * np.tan(frequency * sample_time / 2))


def brevity(rates: ComplexArray, sample_time: float | None) -> FloatArray:
    """Return 0 for modes that last longer than a sample, rising to 1 for those shorter than 0.8 of a sample.

    Modes that last shorter than a sample do not count in `gbid.control.smallest_damping`, because they do not oscillate
    visibly. The objective of a search must be continuous, so they fade out.
    """
    if sample_time is None:
        return np.zeros(rates.shape)
    return np.clip((-rates.real * sample_time - 1.0) / FADE, 0.0, 1.0)


def _z(values: ComplexArray, sample_time: float) -> ComplexArray:
    half = values * sample_time / 2
    below = 1 - half
    return np.asarray((1 + half) / np.where(np.abs(below) > 1e-300, below, 1e-300))
