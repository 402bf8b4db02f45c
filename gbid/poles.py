"""Poles: which of them oscillate, and their natural frequencies and damping factors."""

from __future__ import annotations

import numpy as np

from gbid.arrays import BoolArray, ComplexArray, FloatArray

REAL = 1e-9
"""A pole with a smaller imaginary part, relative to its magnitude, counts as real."""


def is_real(poles: ComplexArray) -> BoolArray:
    """Return which poles do not oscillate (any shape).

    Parameters
    ----------
    poles : complex array
        Continuous time [rad/s].
    """
    return np.abs(poles.imag) <= REAL * np.abs(poles)


def one_of_each_pair(poles: ComplexArray) -> BoolArray:
    """Return which poles stand for an oscillatory mode: of each complex pair the one in the upper half-plane.

    Parameters
    ----------
    poles : complex array
        Continuous time [rad/s].
    """
    return ~is_real(poles) & (poles.imag > 0)


def poles_of_samples(eigenvalues: ComplexArray, dt: float) -> ComplexArray:
    """Return the poles ``log(eigenvalue) / dt`` in continuous time [rad/s] of a sampled model (any shape).

    Parameters
    ----------
    eigenvalues : complex array
        Eigenvalues of its state matrix.
    dt : float
        Sample time [s].
    """
    values = np.asarray(eigenvalues, complex)
    with np.errstate(divide="ignore"):  # an eigenvalue at zero, as of a shift register
        return np.asarray(np.log(np.abs(values)) / dt + 1j * np.angle(values) / dt)


def frequencies_and_dampings(poles: ComplexArray) -> FloatArray:
    """Return natural frequency ``|p| / 2 pi`` [Hz] and damping factor ``-Re(p) / |p|`` of each pole (n, 2).

    Parameters
    ----------
    poles : (n,) complex array
        Continuous time [rad/s]; none at zero.
    """
    size = np.abs(poles)
    return np.column_stack([size / (2 * np.pi), -poles.real / size])


def oscillatory_modes(poles: ComplexArray) -> FloatArray:
    """Return natural frequency [Hz] and damping factor of each oscillatory mode, by rising frequency (n_modes, 2).

    Parameters
    ----------
    poles : (n,) complex array
        Continuous time [rad/s]. Real poles are no modes.
    """
    pairs = poles[one_of_each_pair(poles)]
    return frequencies_and_dampings(pairs[np.argsort(np.abs(pairs), kind="stable")])
