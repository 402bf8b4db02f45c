"""Peaks of the sensitivities of many loops over frequency, and their derivatives by the gains."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

from gbid.control.loop.norm import crossing_frequencies, largest_singular_values
from gbid.control.tuning.kernels import SchurResponse, compiled_peak_slopes, compiled_peaks, kernels
from gbid.control.tuning.loops import Derivatives, Loops, inverses
from gbid.control.tuning.plane import Eigensystem, eigenvalues, schur_form
from gbid.core.arrays import BoolArray, ComplexArray, FloatArray, IntArray

_PER_DECADE = 28
_SUSPECT = 1e6
"""Largest entry of left eigenvectors up to which a response needs no check."""
_WRONG = 1e-9
"""Relative error of a response from which on it is computed without eigenvectors."""
_ROUNDING = 1e-12
"""Relative rise of a peak that counts as rounding; its place then stays, as that of a flat one at zero frequency."""
_BLOCK = 32
"""Rows of a triangular system that are solved together: products of matrices, not of vectors, do most of the work."""
_AXIS = -1e-100
"""Rate of a pole on the imaginary axis, at whose frequency a response would be infinite."""
HIGHEST = 1e100
"""Height that stands for an infinite peak, so that designs with one can be compared."""
_STEPS = np.linspace(0.0, 1.0, 9)
_NEAR = 0.9
"""Share of a gain that matters which a grid point near a peak of that gain reaches."""


@dataclass(frozen=True)
class Peaks:
    """Local maxima over frequency: index of the loop, angular frequency [rad/s] and height, each (k,)."""

    loop: IntArray
    frequency: FloatArray
    value: FloatArray


class ModalResponse:
    r"""Frequency responses of m loops as sums over modes, ``G(j w) = sum_k R_k / (j w - lambda_k) + D``.

    Nearly defective matrices, such as those of delays of several samples, have no use of their eigenvectors. Their
    responses are computed without them.

    Parameters
    ----------
    loops, modes
        Matrices of the loops, and their eigenvalues and eigenvectors.
    rows : slice
        Rows of the outputs.
    """

    def __init__(self, loops: Loops, modes: Eigensystem, rows: slice) -> None:
        self._loops, self._rows, self._poles = loops, rows, modes.values
        C, self._D = loops.C[:, rows], loops.D[:, rows]
        m, n_y, n = C.shape
        outputs, inputs = (C @ modes.right).transpose(0, 2, 1), modes.left @ loops.B
        self._residues = (outputs[:, :, :, None] * inputs[:, :, None, :]).reshape(m, n, n_y * inputs.shape[2])
        self._forms: dict[int, SchurResponse] = {}
        # large entries may come from units of the states, or from eigenvectors that are nearly parallel
        self._suspect = ~(np.abs(modes.left).max(axis=(1, 2)) < _SUSPECT)

    def parts(self) -> tuple[ComplexArray, ComplexArray, FloatArray, dict[int, SchurResponse]]:
        """Return poles (m, n), residues (m, n, n_y n_d), D, and Schur forms of the loops with inaccurate modal sums."""
        for loop in np.flatnonzero(self._suspect).tolist():
            self._form(loop)
        return self._poles, self._residues, self._D, self._forms

    def __call__(self, frequency: FloatArray, which: IntArray | None = None) -> ComplexArray:
        """Return the responses of all or of chosen loops at (k, f) frequencies [rad/s]: (k, f, n_y, n_d)."""
        responses, useless = self._of_modes(frequency, which), self._useless
        loops = np.arange(len(frequency)) if which is None else which
        for loop in np.unique(loops[useless[loops]]) if useless.any() else ():
            responses[loops == loop] = self._without_modes(int(loop), frequency[loops == loop])
        return responses

    def mean_products(self, edges: FloatArray) -> ComplexArray:
        r"""Return the means of :math:`M^T \bar M` of every loop between neighbours of f + 1 frequencies [rad/s].

        The means are exact, however narrow a resonance is: with :math:`M = \sum_a R_a / (j w - \lambda_a) + D`

        .. math:: M^T \bar M = \sum_a \frac{C_a}{j w - \lambda_a} + \Big(\cdot\Big)^H + D^T D, \quad
                  C_a = R_a^T \Big(D - \sum_b \frac{\bar R_b}{\lambda_a + \bar\lambda_b}\Big),

        whose integrals are logarithms. Loops that have no use of their modes are taken at the middles.

        Parameters
        ----------
        edges : (f + 1,) array
            Rising frequencies [rad/s].

        Returns
        -------
        (m, f, n_d, n_d) array
        """
        poles, D = self._poles, self._D
        residues = self._residues.reshape(*poles.shape, *D.shape[1:])
        poles = np.where(poles.real == 0, poles + _AXIS, poles)
        sums = poles[:, :, None] + poles.conj()[:, None]
        inner = D[:, None] - np.einsum("mab,mbil->mail", 1 / np.where(sums == 0, _AXIS, sums), residues.conj())
        weights = np.einsum("maij,mail->majl", residues, inner)
        off = 1j * edges[None, :, None] - poles[:, None]
        means = -1j * np.log(off[:, 1:] / off[:, :-1]) / np.diff(edges)[:, None]
        half = np.einsum("mfa,majl->mfjl", means, weights)
        products = half + half.conj().swapaxes(2, 3) + (D.swapaxes(1, 2) @ D)[:, None]
        loops = np.flatnonzero(self._useless)
        if len(loops):
            M = self(np.tile((edges[1:] + edges[:-1]) / 2, (len(loops), 1)), loops)
            products[loops] = np.einsum("mfij,mfil->mfjl", M, M.conj())
        return np.asarray(products)

    @cached_property
    def _useless(self) -> BoolArray:
        """Mask of the loops whose sum over modes is too inaccurate (m,)."""
        useless = np.zeros(len(self._suspect), bool)
        if self._suspect.any():
            loops = np.flatnonzero(self._suspect)
            useless[loops] = ~(self._error(loops) < _WRONG)
        return useless

    def _of_modes(self, frequency: FloatArray, which: IntArray | None = None) -> ComplexArray:
        poles, residues, D = self._poles, self._residues, self._D
        if which is not None:
            poles, residues, D = poles[which], residues[which], D[which]
        # a quotient of real numbers is faster than one of complex numbers
        rate, off = (
            np.where(poles.real == 0, _AXIS, poles.real)[:, None, :],
            frequency[:, :, None] - poles.imag[:, None],
        )
        size = rate * rate + off * off
        resolvent = np.empty(size.shape, complex)
        np.divide(-rate, size, out=resolvent.real)
        np.divide(-off, size, out=resolvent.imag)
        return np.asarray((resolvent @ residues).reshape(*frequency.shape, *D.shape[1:]) + D[:, None])

    def _error(self, loops: IntArray) -> FloatArray:
        """Return the relative error of the modal sums of some loops at two frequencies, against a direct solution."""
        size = np.sort(np.abs(self._poles[loops]), axis=1)
        frequency = size[:, [size.shape[1] // 4, size.shape[1] // 2]]
        A, B, C = self._loops.A[loops], self._loops.B[loops], self._loops.C[loops][:, self._rows]
        try:
            exact = direct_response(A, B, C, self._D[loops], frequency)
        except np.linalg.LinAlgError:  # a pole on one of the frequencies
            return np.full(len(loops), np.inf)
        off = np.abs(self._of_modes(frequency, loops) - exact).max(axis=(1, 2, 3))
        with np.errstate(over="ignore"):  # a response of zero has an infinite relative error
            return np.asarray(off / np.maximum(np.abs(exact).max(axis=(1, 2, 3)), 1e-300))

    def _form(self, loop: int) -> SchurResponse:
        """Return the Schur form of a loop with its inputs and outputs."""
        if loop not in self._forms:
            schur = schur_form(self._loops.A[loop])
            assert schur is not None, "a matrix with eigenvalues has a Schur form"
            B, C = self._loops.B[loop] / schur.unit[:, None], self._loops.C[loop, self._rows] * schur.unit
            self._forms[loop] = schur.form, schur.basis.conj().T @ B, C @ schur.basis
        return self._forms[loop]

    @np.errstate(divide="ignore", invalid="ignore", over="ignore")  # the response at a pole is not finite
    def _without_modes(self, loop: int, frequency: FloatArray) -> ComplexArray:
        """Return the responses of one loop (k, f, n_y, n_d), from its Schur form by substitution at all frequencies."""
        form, B, C = self._form(loop)
        n, n_d = B.shape
        # row i of (j w - T) X = B, for all frequencies and inputs side by side
        resolvent = 1.0 / (1j * np.repeat(frequency, n_d) - np.diag(form)[:, None])
        states = np.tile(B, frequency.size)
        for end in range(n, 0, -_BLOCK):  # a product of matrices for the rows of a block, then the block itself
            first = max(end - _BLOCK, 0)
            states[first:end] += form[first:end, end:] @ states[end:]
            for i in range(end - 1, first - 1, -1):
                states[i] = (form[i, i + 1 : end] @ states[i + 1 : end] + states[i]) * resolvent[i]
        responses = (C @ states).reshape(len(C), *frequency.shape, n_d).transpose(1, 2, 0, 3)
        return np.asarray(responses + self._D[loop])


def direct_response(A: FloatArray, B: FloatArray, C: FloatArray, D: FloatArray, frequency: FloatArray) -> ComplexArray:
    """Return frequency responses of k loops at (k, f) frequencies [rad/s] by a solution at each: (k, f, n_y, n_d)."""
    shifted = 1j * frequency[:, :, None, None] * np.eye(A.shape[-1]) - A[:, None]
    return np.asarray(C[:, None] @ np.linalg.solve(shifted, B[:, None].astype(complex)) + D[:, None])


def _largest(responses: ComplexArray, _: FloatArray) -> FloatArray:
    """Return the largest singular value of the response at each frequency."""
    return np.minimum(largest_singular_values(responses), HIGHEST)


def find_peaks(
    loops: Loops,
    modes: Eigensystem,
    rows: slice,
    extra: tuple[IntArray, FloatArray] | None = None,
    gain: Callable[[ComplexArray, FloatArray], FloatArray] = _largest,
    least: float = 0.0,
) -> Peaks:
    """Return the local maxima of the gain of a response, refined in frequency.

    Parameters
    ----------
    loops, modes
        Matrices of the loops, and their eigenvalues and eigenvectors.
    rows : slice
        Rows of the outputs.
    extra : (loop, frequency), optional
        Additional frequencies, found by an exact norm.
    gain : callable
        From responses (k, f, n_y, n_d) and their frequencies (k, f) to gains (k, f); by default the largest singular
        value.
    least : float
        Gain below which a peak does not matter; it may then be left out.

    Notes
    -----
    The grid has logarithmic spacing and contains the magnitudes of the eigenvalues of each loop, because a peak that a
    coarse grid would miss belongs to a lightly damped eigenvalue. Each local maximum is then refined.
    """
    respond_at, base = ModalResponse(loops, modes, rows), base_frequencies(modes.values)
    if gain is _largest and loops.D[:, rows].shape[1:] == (2, 2) and (library := kernels()) is not None:
        return Peaks(*compiled_peaks(library, respond_at.parts(), base, extra, least))
    grid = _grid(modes, base, extra)
    return _refined(respond_at, grid, gain(respond_at(grid), grid), gain=gain, least=least)


def _refined(
    respond_at: ModalResponse,
    grid: FloatArray,
    values: FloatArray,
    gain: Callable[[ComplexArray, FloatArray], FloatArray] = _largest,
    least: float = 0.0,
) -> Peaks:
    """Return the local maxima of gains (m, f) on ascending frequencies, refined."""
    padded = np.full((len(grid), grid.shape[1] + 2), -np.inf)
    padded[:, 1:-1] = values
    # of neighbours at one frequency only the last counts
    enough = np.maximum(0.6 * values.max(axis=1, keepdims=True), _NEAR * least)
    loop, column = np.nonzero((values >= padded[:, :-2]) & (values > padded[:, 2:]) & (values > enough))
    best, place = values[loop, column], grid[loop, column]
    if not len(loop):
        return Peaks(loop, place, best)
    low = grid[loop, np.maximum(column - 1, 0)]
    high = grid[loop, np.minimum(column + 1, grid.shape[1] - 1)]
    row = np.arange(len(loop))
    for _ in range(2):
        points = low[:, None] + (high - low)[:, None] * _STEPS
        gains = gain(respond_at(points, loop), points)
        at = np.clip(gains.argmax(axis=1), 1, len(_STEPS) - 2)
        low, high = points[row, at - 1], points[row, at + 1]
        three = gains[row[:, None], at[:, None] + np.array([-1, 0, 1])]
        better = three[:, 1] > best * (1 + _ROUNDING)
        best, place = np.where(better, three[:, 1], best), np.where(better, points[row, at], place)
    step = (high - low) / 2
    vertex, _ = _vertex(low + step, step, three)
    step = 0.1 * step
    points = np.maximum(vertex[:, None] + step[:, None] * np.array([-1.0, 0.0, 1.0]), 0.0)
    three = gain(respond_at(points, loop), points)
    vertex, top = _vertex(vertex, step, three)
    better = top > best * (1 + _ROUNDING)
    return Peaks(loop, np.where(better, vertex, place), np.where(better, top, best))


_SPARSE = 6
"""Frequencies in a decade of a search that ends with an exact norm."""
_ROUNDS = 8
"""Largest number of level sets."""
_EXACT = 1e-7
"""Relative error of an exact norm."""
_FAR = 1e6
"""Frequency that stands for infinity, in magnitudes of the fastest mode."""


def exact_peaks(loops: Loops, modes: Eigensystem, enough: float = np.inf) -> Peaks:
    """Return the local maxima of the largest singular value; the highest of a stable loop is its H-infinity norm.

    The peaks of a sparse grid and of the surroundings of all modes give lower bounds. The eigenvalues of a Hamiltonian
    matrix then tell at which frequencies a loop exceeds the largest bound, see `gbid.control.loop.norm.peak_gain`, and
    the middles between them become part of the grid. Beyond a gain of `enough` a lower bound is returned.

    Parameters
    ----------
    loops, modes
        Matrices of the loops, and their eigenvalues and eigenvectors.
    enough : float
        Gain beyond which no more peaks are looked for.
    """
    response, every = ModalResponse(loops, modes, slice(None)), np.arange(len(loops.A))
    base, far = base_frequencies(modes.values, _SPARSE), _FAR * np.abs(modes.values).max(axis=1)
    loop, which = np.nonzero(modes.values.imag > 0)
    near = around(modes.values[loop, which])
    extra = np.concatenate([every, np.repeat(loop, near.shape[1])]), np.concatenate([far, near.ravel()])
    stable = np.flatnonzero((modes.values.real < 0).all(axis=1)).tolist()
    for _ in range(_ROUNDS):
        grid = _grid(modes, base, extra)
        values = largest_singular_values(response(grid))
        if values.max() > enough or not stable:  # the response of an unstable loop has no meaning
            best = values.argmax(axis=1)
            return Peaks(every, grid[every, best], np.minimum(values[every, best], HIGHEST))
        peaks = _refined(response, grid, values)
        level = float(peaks.value.max(initial=0.0)) * (1 + _EXACT)
        if not 1e-100 < level < min(enough, HIGHEST):
            break
        missed = [_exceeding(response, loops, i, level) for i in stable]
        if not any(map(len, missed)):
            break
        extra = (
            np.concatenate([extra[0], np.repeat(stable, list(map(len, missed)))]),
            np.concatenate([extra[1], *missed]),
        )
    return peaks


def _exceeding(response: ModalResponse, loops: Loops, i: int, level: float) -> FloatArray:
    """Return frequencies at which the largest singular value of a stable loop exceeds a level."""
    A, B, C, D = loops.A[i], loops.B[i], loops.C[i], loops.D[i]
    crossings = crossing_frequencies(A, B, C, D, level, lambda H: eigenvalues(H[None])[0])
    if not len(crossings):
        return crossings
    edges = np.unique(np.concatenate([[0.0], crossings]))
    places = np.concatenate([edges, (edges[1:] + edges[:-1]) / 2])
    return np.asarray(places[largest_singular_values(response(places[None], np.array([i])))[0] > level])


def _vertex(middle: FloatArray, step: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return position and height of the parabola's vertex through three points; outside them the highest point."""
    before, here, after = values.T
    bend, rise = 2 * here - before - after, (after - before) / 2
    share = np.clip(rise / np.where(bend > 0, bend, np.inf), -1.0, 1.0)
    top = here + share * rise - share**2 * bend / 2
    inside = np.abs(share) < 1
    at = values.argmax(axis=1)
    place = middle + step * np.where(inside, share, at - 1.0)
    return place, np.where(inside, top, values.max(axis=1))


def base_frequencies(values: ComplexArray, per_decade: int = _PER_DECADE) -> FloatArray:
    """Return 0 and logarithmically spaced 1 to 1e5 rad/s, extended for loops with slower or faster modes.

    Parameters
    ----------
    values : (m, n) array
        Eigenvalues of the loops.
    per_decade : int
        Number of frequencies in a decade.
    """
    size = np.abs(values)
    if size.size and size.min() > 10.0 and size.max() <= 1e5:
        return _spaced(1.0, 1e5, per_decade)
    size = size[(size > 0) & np.isfinite(size)]
    middle, top = (float(np.sort(size)[len(size) // 2]), float(size.max())) if size.size else (1.0, 1.0)
    low = 1.0 if middle > 10.0 else 1e-2 * middle
    high = 1e5 if top <= 1e5 else min(10 * top, 1e4 * max(middle, 1e2))
    return _spaced(2.0 ** np.floor(np.log2(low)), 2.0 ** np.ceil(np.log2(high)), per_decade)  # few different ones


@lru_cache(maxsize=32)
def _spaced(low: float, high: float, per_decade: int) -> FloatArray:
    return np.concatenate([[0.0], np.geomspace(low, high, round(per_decade * np.log10(high / low)))])


def around(values: ComplexArray) -> FloatArray:
    """Return frequencies on both sides of the resonance of each mode: (k,) to (k, 4) [rad/s]."""
    steps = np.array([-3.0, -1.0, 1.0, 3.0])
    return np.asarray(np.abs(np.abs(values.imag)[..., None] + np.abs(values.real)[..., None] * steps))


def _grid(modes: Eigensystem, base: FloatArray, extra: tuple[IntArray, FloatArray] | None) -> FloatArray:
    """Return the ascending frequencies of each loop (m, f) [rad/s]."""
    m, n = modes.values.shape
    n_extra = 0 if extra is None else len(extra[0])
    grid = np.zeros((m, len(base) + 2 * n + n_extra))
    grid[:, : len(base)] = base
    frequencies = grid[:, len(base) : len(base) + 2 * n]
    # Conjugate and real eigenvalues give shifted points, because two equal frequencies would look like a maximum.
    size, pair = np.abs(modes.values), modes.values.imag > 0
    frequencies[:, :n] = np.where(pair, size, 1.07 * size)
    frequencies[:, n:] = np.where(pair, modes.values.imag, 0.93 * size)
    if extra is not None:
        grid[extra[0], len(base) + 2 * n + np.arange(n_extra)] = extra[1]
    grid.sort(axis=1)
    return grid


def peak_slopes(loops: Derivatives, rows: slice, peaks: Peaks) -> tuple[FloatArray, FloatArray]:
    """Return derivatives (k, d) of the largest singular value by the gains at fixed frequencies, and the values (k,).

    At a maximum over frequency this is the derivative of the peak, because the change of its frequency has an effect of
    second order only. With ``S = C R B + D``, ``R = (j w - A)^-1``: ``dS = [C R, I] d[[A, B], [C, D]] [R B; I]``.
    """
    first, last, _ = rows.indices(loops.C.shape[1])
    if (last - first, loops.B.shape[2]) == (2, 2) and (library := kernels()) is not None:
        return compiled_peak_slopes(library, loops, first, peaks.loop, peaks.frequency)
    i, n = peaks.loop, loops.A.shape[-1]
    system, B = 1j * peaks.frequency[:, None, None] * np.eye(n) - loops.A[i], loops.B[i].astype(complex)
    C, D = loops.C[i][:, rows], loops.D[i][:, rows]
    try:
        RB = np.linalg.solve(system, B)
    except np.linalg.LinAlgError:  # a pole on one of the frequencies
        system += 1e-9 * max(float(np.abs(system).max()), 1e-9) * np.eye(n)
        RB = np.linalg.solve(system, B)
    response = C @ RB + D
    finite = np.asarray(np.isfinite(response).all(axis=(1, 2)))  # of an infinite peak there is no gradient
    U, values, Vh = np.linalg.svd(np.where(finite[:, None, None], response, 0.0))
    u, v = U[:, :, 0].conj(), Vh[:, 0].conj()
    RBv = (RB @ v[:, :, None])[:, :, 0]
    uCR = np.asarray(np.linalg.solve(system.transpose(0, 2, 1), (u[:, None] @ C).transpose(0, 2, 1))[:, :, 0], complex)
    outputs = np.zeros((len(i), loops.C.shape[1]), complex)
    outputs[:, rows] = u
    dS = loops.along(i, np.hstack([uCR, outputs]), np.hstack([RBv, v]))
    return np.where(finite[:, None], dS.real, np.nan), values[:, 0]


@np.errstate(divide="ignore", invalid="ignore")  # equal singular values have no second derivative
def peak_curvature(
    loops: Derivatives, rows: slice, loop: IntArray, frequency: FloatArray, bend: FloatArray
) -> FloatArray:
    r"""Return second derivatives (k, d, d) of the logarithm of the largest singular value at fixed frequencies.

    It is the largest eigenvalue of the Hermitian matrix :math:`[[0, S], [S^H, 0]]`, whose others are the other singular
    values, all negative ones, and zeros. With :math:`x_{ij} = u_i^H S_p v_j` an eigenvalue :math:`\pm s_i` acts by
    :math:`x_{i1} \pm x_{1i}^*`. For `bend` see `Derivatives.second`.
    """
    n = loops.A.shape[-1]
    R = inverses(np.asarray(1j * frequency[:, None, None] * np.eye(n) - loops.A[loop], complex))
    C, B, left, right = loops.C[loop][:, rows], loops.B[loop], loops.left[loop], loops.right[loop]
    S = C @ R @ B + loops.D[loop][:, rows]
    finite = np.asarray(np.isfinite(S).all(axis=(1, 2)))
    U, s, Vh = np.linalg.svd(np.where(finite[:, None, None], S, 0.0))
    # of each left singular vector u^H [C R, I] left, of each right one right [R B; I] v
    from_signals = U.conj().swapaxes(1, 2) @ (C @ R @ left[:, :n] + left[:, n:][:, rows])
    to_signals = (right[:, :, :n] @ R @ B + right[:, :, n:]) @ Vh.conj().swapaxes(1, 2)
    by_row, by_column, second = loops.second(bend, loop, from_signals[:, 0], to_signals[:, :, 0], R)
    size = max(S.shape[1:])
    x, y = np.zeros((2, *by_row.shape[:2], size), complex)
    x[:, :, : S.shape[1]], y[:, :, : S.shape[2]] = by_column @ from_signals.swapaxes(1, 2), (by_row @ to_signals).conj()
    s = np.pad(s, ((0, 0), (0, size - s.shape[1])))[:, None]
    slope, total = x[..., 0].real / s[..., 0], second.real
    for pair, distance in (((x + y)[..., 1:], s[..., :1] - s[..., 1:]), (x - y, s[..., :1] + s)):
        total = total + (pair.conj() / distance @ pair.swapaxes(1, 2)).real / 2
    return np.asarray(total / s[..., :1] - slope[:, :, None] * slope[:, None])
