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
from gbid.control.tuning.search.kernels.clusters_source import CLUSTERS, EIGENSYSTEMS
from gbid.control.tuning.search.kernels.peaks_source import PEAKS
from gbid.control.tuning.search.kernels.schur_source import SCHUR
from gbid.control.tuning.search.kernels.slopes_source import SLOPES
from gbid.control.tuning.search.loop_family import Derivatives

SchurResponse = tuple[ComplexArray, ComplexArray, ComplexArray]
IntArray = npt.NDArray[np.intp]
_COUNT, _PLACE, _REAL = ctypes.c_long, ctypes.c_void_p, ctypes.c_double
_TYPES: dict[str, list[Any]] = {
    "near_sums": [_COUNT, _PLACE, _COUNT, _PLACE, _PLACE],
    "schur_form": [_COUNT, _PLACE, _PLACE],
    "eigensystems": [_COUNT, _COUNT, _PLACE, _REAL, *[_PLACE] * 3],
    "cluster": [*[_COUNT] * 3, *[_PLACE] * 2, *[_REAL] * 4, _PLACE],
}
"""Arguments of the kernels that are called so often that their conversion counts."""


@cache
def kernels() -> Library | None:
    """Return the library of the kernels; None without a C compiler. The same figures then come from numpy."""
    try:
        library = load_library(PEAKS + SLOPES + SCHUR + CLUSTERS + EIGENSYSTEMS)
    except CompilerMissingError:
        return None
    for name in ("peaks", "peak_slopes", "eigenvalue_slopes", *_TYPES):
        getattr(library, name).restype = ctypes.c_long
    for name, types in _TYPES.items():
        getattr(library, name).argtypes = types
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


def compiled_near_sums(
    library: Library, A: FloatArray, places: FloatArray, most: int
) -> tuple[ComplexArray, ComplexArray]:
    """Return the eigenvalues (n,) of a matrix, and means and power sums of those nearest to some places.

    Parameters
    ----------
    library : Library
        The kernels.
    A : (n, n) array
        The matrix.
    places : (c, 4) array
        Real and imaginary part of each place, unit of distances, and number k of eigenvalues.
    most : int
        Sum K of these numbers.

    Returns
    -------
    (n,) array
        Eigenvalues, NaN where they are not found.
    (K,) array
        For each place the mean and the k - 1 power sums, see `power_sums`.
    """
    n, A, places = len(A), _flat(A), _flat(places)
    found = np.empty(n + most, complex)
    ended = library.near_sums(n, A.ctypes.data, len(places), places.ctypes.data, found.ctypes.data)
    _check(ended)
    if not ended:
        found[:] = np.nan
    return found[:n], found[n:]


def compiled_eigensystems(
    library: Library, A: FloatArray, longest: float
) -> tuple[ComplexArray, ComplexArray, ComplexArray] | None:
    """Return eigenvalues (m, n), right eigenvectors as columns and left ones as rows; None when some are not found.

    Those of a defective matrix are no longer than `longest`, with right ones of length one.
    """
    m, n, A = len(A), A.shape[-1], _flat(A)
    values, right, left = np.empty((m, n), complex), np.empty((m, n, n), complex), np.empty((m, n, n), complex)
    addresses = values.ctypes.data, right.ctypes.data, left.ctypes.data
    ended = library.eigensystems(m, n, A.ctypes.data, longest, *addresses)
    _check(ended)
    return (values, right, left) if ended else None


def compiled_schur_form(library: Library, A: FloatArray) -> ComplexArray | None:
    """Return the complex Schur form of a balanced matrix as `SchurForm` has it; None when it is not found."""
    n, A = len(A), _flat(A)
    found = np.empty(2 * n * n + (n + 1) // 2 + n, complex)
    ended = library.schur_form(n, A.ctypes.data, found.ctypes.data)
    _check(ended)
    return found if ended else None


def compiled_cluster(
    library: Library, form: ComplexArray, dA: FloatArray, size: int, place: complex, rate: float, farthest: float
) -> tuple[ComplexArray, ...] | None:
    """Return eigenvalues, mean, power sums and the gradients of both for the cluster nearest to a place, see `Cluster`.

    Parameters
    ----------
    library : Library
        The kernels.
    form : complex array
        Schur form by `compiled_schur_form`.
    dA : (d, n, n) array
        Derivatives of the matrix.
    size : int
        Number k of eigenvalues, at most n.
    place : complex
        Place in the complex plane.
    rate : float
        Unit of distances.
    farthest : float
        Largest cotangent of the angle between the subspace and the others.

    Returns
    -------
    Arrays (k,), (1,), (k - 1,), (d,) and (k - 1, d); None when the subspace is not determined.
    """
    (d, n, _), dA = dA.shape, _flat(dA)
    found = np.empty(2 * size + size * d, complex)
    given = form.ctypes.data, dA.ctypes.data, place.real, place.imag, rate, farthest
    ended = library.cluster(n, d, size, *given, found.ctypes.data)
    _check(ended)
    if not ended:
        return None
    one, two = size + 1, 2 * size
    slopes = found[two:].reshape(size, d)
    return found[:size], found[size:one], found[one:two], slopes[0], slopes[1:]


def _flat(array: npt.NDArray[Any]) -> npt.NDArray[Any]:
    return np.ascontiguousarray(array)


def _long(value: int) -> ctypes.c_long:
    return ctypes.c_long(value)


def _address(array: npt.NDArray[Any]) -> ctypes.c_void_p:
    return ctypes.c_void_p(array.ctypes.data)


def _check(ended: int) -> None:
    if ended < 0:
        raise MemoryError("the kernels of the tuner got no memory")
