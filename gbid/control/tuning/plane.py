"""Planes of eigenvalues: true rates and frequencies of loops that are given by their bilinear transform."""

from __future__ import annotations

import ctypes
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.linalg import eig
from scipy.linalg.lapack import dgebal, zgees

from gbid.control.tuning.c_source import CLUSTERS, EIGENSYSTEMS, PEAKS, SCHUR, SLOPES
from gbid.control.tuning.loops import Derivatives
from gbid.core.arrays import REAL, BoolArray, ComplexArray, FloatArray
from gbid.core.compiled import CompilerMissingError, Library, load_library

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


# ---- Calls of the compiled kernels on numpy arrays.

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


# ---- Eigenvalues of many loops, their damping, and the derivatives of both by the gains.
#
# Matrices may hold numbers that are not finite, or so large that their eigenvalues are not computed. Their eigenvalues
# are NaN, so that a search steps back from such gains.

LARGEST = 1e60
"""Entries of a matrix from which on it counts as not finite: powers of its eigenvalues would overflow."""
_DEFECTIVE = 1e13
"""Entry of a left eigenvector, with right ones of length one, from which on a matrix counts as defective."""
_LONGEST = 1e18
"""Largest length of a left eigenvector of a defective matrix, with right ones of length one."""


def damping_factors(rates: ComplexArray, sample_time: float | None = None) -> FloatArray:
    """Return the damping factors ``-Re/|.|`` of oscillatory modes; 1 for real ones.

    Parameters
    ----------
    rates : complex array
        Eigenvalues in continuous time [rad/s].
    sample_time : float, optional
        Sample time of a sampled loop [s], in which modes shorter than a sample fade out, see `plane.brevity`.
    """
    magnitude = np.maximum(np.abs(rates), 1e-300)
    found = np.where(np.abs(rates.imag) > REAL * magnitude, -rates.real / magnitude, 1.0)
    return np.asarray(found + (1.0 - found) * brevity(rates, sample_time))


def bilinear(w: ComplexArray, M: FloatArray, v: ComplexArray) -> ComplexArray:
    """Return ``w M v`` of rows w (k, i), real matrices M (k, d, i, j) and columns v (k, j): (k, d)."""
    both = (w[:, :, None] * v[:, None, :]).reshape(len(w), w.shape[1] * v.shape[1])
    # One real product for real and imaginary part is faster than a complex copy of M.
    product = M.reshape(*M.shape[:2], both.shape[1]) @ np.stack([both.real, both.imag], axis=-1)
    return np.asarray(product[..., 0] + 1j * product[..., 1])


def eigenvalues(A: FloatArray) -> ComplexArray:
    """Return the eigenvalues (m, n) of (m, n, n) matrices, NaN for those without finite eigenvalues."""
    usable: BoolArray | None = None
    if np.abs(A).max(initial=0.0) < LARGEST:
        try:
            return np.asarray(np.linalg.eigvals(A), complex)
        except np.linalg.LinAlgError:
            usable = _one_by_one(A)
    usable = _usable(A) if usable is None else usable
    found = np.full(A.shape[:2], np.nan, complex)
    if usable.any():
        found[usable] = np.linalg.eigvals(A[usable])
    return found


def _usable(A: FloatArray) -> BoolArray:
    """Return which matrices have finite entries whose squares are finite, too."""
    # a comparison with NaN is false
    return np.asarray((np.abs(A) < LARGEST).all(axis=(1, 2)))


def _one_by_one(A: FloatArray) -> BoolArray:
    """Return for which matrices the eigenvalue iteration converges."""
    found = np.zeros(len(A), bool)
    for i, matrix in enumerate(A):
        try:
            np.linalg.eig(matrix)
            found[i] = _usable(matrix[None])[0]
        except np.linalg.LinAlgError:
            pass
    return found


def _inverses(right: ComplexArray) -> tuple[ComplexArray, BoolArray]:
    """Return the inverses of matrices of eigenvectors, and which of them are useless because a matrix is defective."""
    try:
        left = np.linalg.inv(right)
    except np.linalg.LinAlgError:
        left = np.full(right.shape, np.inf, complex)
        for i, matrix in enumerate(right):
            with suppress(np.linalg.LinAlgError):
                left[i] = np.linalg.inv(matrix)
    size = np.abs(left).max(axis=(1, 2))
    return np.asarray(left, complex), np.asarray(~(size < _DEFECTIVE))


def _left_of(A: FloatArray, right: ComplexArray) -> ComplexArray:
    """Return left eigenvectors as rows for right ones as columns, with ``W V = I``.

    A defective matrix has no complete set of eigenvectors. Its left ones are those that LAPACK finds by themselves,
    and are divided by the smallest number instead of zero.
    """
    left, defective = _inverses(right)
    for i in np.flatnonzero(defective):
        found = eig(A[i], left=True, right=False, check_finite=False)[1].conj().T
        products = (found * right[i].T).sum(axis=1, keepdims=True)
        left[i] = found / np.where(np.abs(products) > 1.0 / _LONGEST, products, 1.0 / _LONGEST)
    return left


@dataclass(frozen=True, eq=False)
class Eigensystem:
    """Eigenvalues (m, n) and eigenvectors of matrices, NaN for those without finite eigenvalues.

    The eigenvalues of a defective matrix stay as they are: a change of the matrix by rounding errors would move k
    eigenvalues that meet by the k-th root of these.

    Attributes
    ----------
    A : (m, n, n) array
        The matrices.
    values : (m, n) array
        Eigenvalues.
    right : (m, n, n) array
        Right eigenvectors as columns.
    known_left : (m, n, n) array, optional
        Left eigenvectors, where they were computed with the right ones.
    """

    A: FloatArray
    values: ComplexArray
    right: ComplexArray
    known_left: ComplexArray | None = None

    @classmethod
    def of(cls, A: FloatArray) -> Eigensystem:
        """Return the eigensystems of (m, n, n) matrices."""
        if np.abs(A).max(initial=0.0) < LARGEST:
            if (library := kernels()) is not None and (found := compiled_eigensystems(library, A, _LONGEST)):
                return cls(A, *found)
            try:
                values, right = np.linalg.eig(A)
                return cls(A, values.astype(complex, copy=False), right.astype(complex, copy=False))
            except np.linalg.LinAlgError:
                usable = _one_by_one(A)
        else:
            usable = _usable(A)
        values, right = np.full(A.shape[:2], np.nan, complex), np.full(A.shape, np.nan, complex)
        if usable.any():
            values[usable], right[usable] = np.linalg.eig(A[usable])
        return cls(A, values, right)

    @cached_property
    def left(self) -> ComplexArray:
        """Left eigenvectors as rows, with ``W V = I``."""
        if self.known_left is not None:
            return self.known_left
        usable = ~np.isnan(self.values[:, 0])
        if usable.all():
            return _left_of(self.A, self.right)
        found = np.full(self.right.shape, np.nan, complex)
        if usable.any():
            found[usable] = _left_of(self.A[usable], self.right[usable])
        return found

    def slopes(self, loops: npt.NDArray[np.intp], which: npt.NDArray[np.intp], dA: FloatArray) -> ComplexArray:
        """Return derivatives (k, d) of chosen eigenvalues: ``w dA v`` with ``w v = 1``; dA is (m, d, n, n)."""
        return bilinear(self.left[loops, which], dA[loops], self.right[loops, :, which])


def damping_slopes(rates: ComplexArray, slopes: ComplexArray, sample_time: float | None = None) -> FloatArray:
    """Return derivatives (k, d) of the damping factor from those of the eigenvalues in continuous time."""
    magnitude = np.abs(rates)[:, None]
    along = (rates.conj()[:, None] * slopes).real
    found = -slopes.real / magnitude + rates.real[:, None] * along / magnitude**3
    if sample_time is None:
        return np.asarray(found)
    short = brevity(rates, sample_time)[:, None]
    fading = np.where((short > 0) & (short < 1), -slopes.real * sample_time / FADE, 0.0)
    return np.asarray((1 - short) * found + (1 - damping_factors(rates)[:, None]) * fading)


# ---- Eigenvalues of the same loops at nearby designs, and their gradients.


class NearbyEigenvalues:
    """Eigenvalues of m loops at several designs that lie near the first one.

    Where kernels are compiled, eigenvectors of the first design are the start of an inverse iteration for those of the
    others: a solution takes a tenth of the time of all eigenvalues.

    Parameters
    ----------
    loops : Derivatives
        The m loops at the first design, then those at the second one, and so on.
    m : int
        Number of loops.
    """

    def __init__(self, loops: Derivatives, m: int) -> None:
        self._loops, self._m, self._library = loops, m, kernels()
        self._system = Eigensystem.of(loops.A if self._library is None else loops.A[:m])

    def slopes(self, which: npt.NDArray[np.intp], places: ComplexArray) -> tuple[ComplexArray, ComplexArray]:
        """Return the eigenvalues (k,) nearest to known ones, and their gradients (k, d).

        Parameters
        ----------
        which : (n, q) array
            Loop of each of n eigenvalues in each of q designs.
        places : (n,) array
            Where they are at the first design.
        """
        system, flat = self._system, which.ravel()
        if self._library is None:
            at = np.abs(system.values[which] - places[:, None, None]).argmin(axis=2).ravel()
            return system.values[flat, at], system.slopes(flat, at, self._loops.dA)
        first = flat % self._m
        at = np.abs(system.values[first] - np.repeat(places, which.shape[1])[:, None]).argmin(axis=1)
        known = system.values[first, at], system.right[first, :, at], system.left[first, at]
        return compiled_eigenvalue_slopes(self._library, self._loops.A, self._loops.dA, flat, known)


# ---- Complex Schur form of a balanced matrix, and the eigenvalues near given places.


@dataclass(frozen=True, eq=False)
class SchurForm:
    """Complex Schur form of a matrix in balanced units of its states, which decide how good it is.

    With the balanced matrix ``A / unit[:, None] * unit`` it is ``basis form basis*``.

    Attributes
    ----------
    packed : complex array
        Form (n, n), vectors of the basis as rows (n, n), units (n,) as pairs of real numbers, and eigenvalues (n,).
    n : int
        Number of states.
    """

    packed: ComplexArray
    n: int

    @classmethod
    def of(cls, A: FloatArray) -> SchurForm | None:
        """Return the form of a finite matrix (n, n); None when it is not found."""
        n, library = len(A), kernels()
        found = None if library is None else compiled_schur_form(library, A)
        if found is not None:
            return cls(found, n)
        balanced, _, _, unit, _ = dgebal(A, scale=1)
        form, _, _, basis, _, failed = zgees(lambda _: None, balanced)
        pairs = np.append(unit, np.zeros(n % 2)).view(complex)
        return None if failed else cls(np.concatenate([form.ravel(), basis.T.ravel(), pairs, np.diag(form)]), n)

    @property
    def form(self) -> ComplexArray:
        """Upper triangular matrix (n, n)."""
        return self.packed[: self.n**2].reshape(self.n, self.n)

    @property
    def basis(self) -> ComplexArray:
        """Unitary matrix (n, n)."""
        return self.packed[self.n**2 : 2 * self.n**2].reshape(self.n, self.n).T

    @property
    def unit(self) -> FloatArray:
        """Units of the states (n,)."""
        return self.packed[2 * self.n**2 : -self.n].view(float)[: self.n]
