"""Calls of the compiled kernels on numpy arrays."""

from __future__ import annotations

import ctypes
from collections.abc import Mapping
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt

from gbid.arrays import ComplexArray, FloatArray
from gbid.compiling import CompilerMissingError, Library, load_library
from gbid.control.tuning.search.kernels.peaks_source import PEAKS
from gbid.control.tuning.search.kernels.slopes_source import SLOPES
from gbid.control.tuning.search.loop_family import Derivatives

SchurResponse = tuple[ComplexArray, ComplexArray, ComplexArray]
IntArray = npt.NDArray[np.intp]


@cache
def kernels() -> Library | None:
    """Return the library of the kernels; None without a C compiler. The same figures then come from numpy."""
    try:
        library = load_library(PEAKS + SLOPES)
    except CompilerMissingError:
        return None
    for name in ("peaks", "peak_slopes", "eigenvalue_slopes"):
        getattr(library, name).restype = ctypes.c_long
    return library


def compiled_peaks(
    library: Library,
    poles: ComplexArray,
    residues: ComplexArray,
    D: FloatArray,
    forms: Mapping[int, SchurResponse],
    base: FloatArray,
    extra: tuple[IntArray, FloatArray] | None,
    least: float,
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Return loop, frequency [rad/s] and height of the peaks of two by two responses.

    Parameters
    ----------
    library : Library
        The kernels.
    poles : (m, n) array
        Poles of m loops.
    residues : (m, n, 4) array
        Residues of the four entries.
    D : (m, 2, 2) array
        Responses at infinite frequency.
    forms : dict of int to arrays
        Schur forms (n, n), inputs (n, 2) and outputs (2, n) of loops that have no use of their modes.
    base : (f,) array
        Frequencies for all loops, ascending.
    extra : (loop, frequency), optional
        Additional frequencies.
    least : float
        Gain of which peaks must reach a share.
    """
    m, n = poles.shape
    loops, places = (np.zeros(0, np.intp), np.zeros(0)) if extra is None else extra
    most = m * (len(base) + 2 * n + len(places)) // 2 + m
    loop, place, height = np.empty(most, np.intp), np.empty(most), np.empty(most)
    form_of, every = np.full(m, -1), [np.zeros(0, complex)] * 3
    if forms:
        form_of[list(forms)] = np.arange(len(forms))
        every = [np.array(parts) for parts in zip(*forms.values(), strict=True)]
    given = [_flat(poles), _flat(residues), _flat(D), form_of, *every]
    loops, places = np.ascontiguousarray(loops, np.intp), np.ascontiguousarray(places)
    count = library.peaks(
        _long(m),
        _long(n),
        *map(_address, given),
        _long(len(base)),
        _address(base),
        _long(len(places)),
        _address(loops),
        _address(places),
        ctypes.c_double(least),
        _long(most),
        _address(loop),
        _address(place),
        _address(height),
    )
    _check(count)
    return loop[:count].copy(), place[:count].copy(), height[:count].copy()


def compiled_peak_slopes(
    library: Library, loops: Derivatives, first_row: int, loop: IntArray, frequency: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return gradients (k, d) of the largest singular values of two by two responses, and the values (k,)."""
    k, (_, d, n, _) = len(loop), loops.dA.shape
    value, slope = np.empty(k), np.empty((k, d))
    given = [loops.A, loops.B, loops.C, loops.D, loops.dA, loops.dB, loops.dC, loops.dD]
    kept = [np.ascontiguousarray(loop, np.intp), _flat(frequency), *map(_flat, given)]
    sizes = (k, n, d, loops.C.shape[1], first_row)
    _check(library.peak_slopes(*map(_long, sizes), *map(_address, kept), _address(value), _address(slope)))
    return slope, value


def compiled_eigenvalue_slopes(
    library: Library,
    A: FloatArray,
    dA: FloatArray,
    loop: IntArray,
    known: tuple[ComplexArray, ComplexArray, ComplexArray],
) -> tuple[ComplexArray, ComplexArray]:
    """Return eigenvalues (k,) near known ones of nearby matrices, and their gradients (k, d).

    Parameters
    ----------
    library : Library
        The kernels.
    A, dA : (m, n, n) and (m, d, n, n) arrays
        Matrices and their derivatives.
    loop : (k,) array
        Which matrix each eigenvalue is of.
    known : tuple of arrays
        Eigenvalues (k,) of the nearby matrices, with right and left eigenvectors (k, n).
    """
    k, (_, d, n, _) = len(loop), dA.shape
    values, right, left = (np.array(part, complex, order="C") for part in known)
    slope, A, dA, loop = np.empty((k, d), complex), _flat(A), _flat(dA), np.ascontiguousarray(loop, np.intp)
    given = map(_address, (loop, A, dA, values, right, left, slope))
    _check(library.eigenvalue_slopes(_long(k), _long(n), _long(d), *given))
    return values, slope


def _flat(array: npt.NDArray[Any]) -> npt.NDArray[Any]:
    return np.ascontiguousarray(array)


def _long(value: int) -> ctypes.c_long:
    return ctypes.c_long(value)


def _address(array: npt.NDArray[Any]) -> ctypes.c_void_p:
    return ctypes.c_void_p(array.ctypes.data)


def _check(ended: int) -> None:
    if ended < 0:
        raise MemoryError("the kernels of the tuner got no memory")
