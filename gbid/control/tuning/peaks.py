"""Peaks of the sensitivities of many loops over frequency, and their derivatives by the gains."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property, lru_cache

import numpy as np

from gbid.control.loop.norm import largest_singular_values
from gbid.control.tuning.kernels import compiled_peak_slopes, kernels
from gbid.control.tuning.loops import Derivatives, Loops
from gbid.control.tuning.plane import Eigensystem, IntArray, bilinear, schur_form
from gbid.core.arrays import BoolArray, ComplexArray, FloatArray
from gbid.core.compiled import CompilerMissingError, Library, load_library

SchurResponse = tuple[ComplexArray, ComplexArray, ComplexArray]
"""Schur form (n, n) of a loop, with its inputs and outputs in that basis."""
_PER_DECADE = 28
_SUSPECT = 1e6
"""Largest entry of left eigenvectors up to which a response needs no check."""
_WRONG = 1e-9
"""Relative error of a response from which on it is computed without eigenvectors."""
_ROUNDING = 1e-12
"""Relative rise of a peak that counts as rounding; its place then stays, as that of a flat one at zero frequency."""
_AXIS = -1e-100
"""Rate of a pole on the imaginary axis, at whose frequency a response would be infinite."""
_STEPS = np.linspace(0.0, 1.0, 9)
_NEAR = 0.9
"""Share of a gain that matters which a grid point near a peak of that gain reaches."""


@dataclass(frozen=True)
class Peaks:
    """Local maxima over frequency: index of the loop, angular frequency [rad/s] and height, all (k,)."""

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
        """Return poles (m, n), residues (m, n, n_y n_d), D, and Schur forms of loops whose modes may have no use."""
        forms = {int(loop): self._form(int(loop)) for loop in np.flatnonzero(self._suspect)}
        return self._poles, self._residues, self._D, forms

    def __call__(self, frequency: FloatArray, which: IntArray | None = None) -> ComplexArray:
        """Return the responses of all or of chosen loops at (k, f) frequencies [rad/s]: (k, f, n_y, n_d)."""
        found, useless = self._of_modes(frequency, which), self._useless
        loops = np.arange(len(frequency)) if which is None else which
        for loop in np.unique(loops[useless[loops]]) if useless.any() else ():
            found[loops == loop] = self._without_modes(int(loop), frequency[loops == loop])
        return found

    @cached_property
    def _useless(self) -> BoolArray:
        """Which loops have no use of their modes."""
        found = np.zeros(len(self._suspect), bool)
        if self._suspect.any():
            loops = np.flatnonzero(self._suspect)
            found[loops] = ~(self._error(loops) < _WRONG)
        return found

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
        """Return the relative error of the responses of some loops at two frequencies, from a direct solution."""
        size = np.sort(np.abs(self._poles[loops]), axis=1)
        frequency = size[:, [size.shape[1] // 4, size.shape[1] // 2]]
        A, B, C = self._loops.A[loops], self._loops.B[loops], self._loops.C[loops][:, self._rows]
        try:
            exact = direct_response(A, B, C, self._D[loops], frequency)
        except np.linalg.LinAlgError:  # a pole on one of the frequencies
            return np.full(len(loops), np.inf)
        off = np.abs(self._of_modes(frequency, loops) - exact).max(axis=(1, 2, 3))
        return np.asarray(off / np.abs(exact).max(axis=(1, 2, 3)))

    def _form(self, loop: int) -> SchurResponse:
        """Return the Schur form of a loop with its inputs and outputs."""
        if loop not in self._forms:
            schur = schur_form(self._loops.A[loop])
            assert schur is not None, "a matrix with eigenvalues has a Schur form"
            B, C = self._loops.B[loop] / schur.unit[:, None], self._loops.C[loop, self._rows] * schur.unit
            self._forms[loop] = schur.form, schur.basis.conj().T @ B, C @ schur.basis
        return self._forms[loop]

    def _without_modes(self, loop: int, frequency: FloatArray) -> ComplexArray:
        """Return the responses of one loop (k, f, n_y, n_d), from its Schur form by substitution at all frequencies."""
        form, B, C = self._form(loop)
        n, n_d = B.shape
        # row i of (j w - T) X = B, for all frequencies and inputs side by side
        resolvent = 1.0 / (1j * np.repeat(frequency, n_d) - np.diag(form)[:, None])
        inputs, states = np.tile(B, frequency.size), np.empty((n, frequency.size * n_d), complex)
        for i in range(n - 1, -1, -1):
            states[i] = (form[i, i + 1 :] @ states[i + 1 :] + inputs[i]) * resolvent[i]
        found = (C @ states).reshape(len(C), *frequency.shape, n_d).transpose(1, 2, 0, 3)
        return np.asarray(found + self._D[loop])


def direct_response(A: FloatArray, B: FloatArray, C: FloatArray, D: FloatArray, frequency: FloatArray) -> ComplexArray:
    """Return frequency responses of k loops at (k, f) frequencies [rad/s] by a solution at each: (k, f, n_y, n_d)."""
    shifted = 1j * frequency[:, :, None, None] * np.eye(A.shape[-1]) - A[:, None]
    return np.asarray(C[:, None] @ np.linalg.solve(shifted, B[:, None].astype(complex)) + D[:, None])


def respond(loops: Loops, modes: Eigensystem, rows: slice, which: IntArray, frequency: FloatArray) -> ComplexArray:
    """Return frequency responses of some outputs of chosen loops at (k, f) frequencies [rad/s]: (k, f, n_y, n_d)."""
    return ModalResponse(loops, modes, rows)(frequency, which)


def _largest(responses: ComplexArray, _: FloatArray) -> FloatArray:
    """Return the largest singular value at each frequency."""
    return largest_singular_values(responses)


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
    m = len(loops.A)
    respond_at, base = ModalResponse(loops, modes, rows), base_frequencies(modes.values)
    if gain is _largest and loops.D[:, rows].shape[1:] == (2, 2) and (library := kernel()) is not None:
        return _compiled_peaks(library, respond_at, base, extra, least)
    grid = _grid(modes, base, extra)
    values = gain(respond_at(grid), grid)
    padded = np.full((m, grid.shape[1] + 2), -np.inf)
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
        found = gain(respond_at(points, loop), points)
        at = np.clip(found.argmax(axis=1), 1, len(_STEPS) - 2)
        low, high = points[row, at - 1], points[row, at + 1]
        three = found[row[:, None], at[:, None] + np.array([-1, 0, 1])]
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


def _vertex(middle: FloatArray, step: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return place and height of the parabola through three points; where it has no top between them, the highest."""
    before, here, after = values.T
    bend, rise = 2 * here - before - after, (after - before) / 2
    share = np.clip(rise / np.where(bend > 0, bend, np.inf), -1.0, 1.0)
    top = here + share * rise - share**2 * bend / 2
    inside = np.abs(share) < 1
    at = values.argmax(axis=1)
    place = middle + step * np.where(inside, share, at - 1.0)
    return place, np.where(inside, top, values.max(axis=1))


def base_frequencies(values: ComplexArray, per_decade: int = _PER_DECADE) -> FloatArray:
    """Return 0 and 1 to 1e5 rad/s with logarithmic spacing, and farther for loops on another time scale.

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
    middle, top = (float(np.median(size)), float(size.max())) if size.size else (1.0, 1.0)
    low = 1.0 if middle > 10.0 else 1e-2 * middle
    return _spaced(low, 1e5 if top <= 1e5 else min(10 * top, 1e4 * max(middle, 1e2)), per_decade)


@lru_cache(maxsize=32)
def _spaced(low: float, high: float, per_decade: int) -> FloatArray:
    return np.concatenate([[0.0], np.geomspace(low, high, round(per_decade * np.log10(high / low)))])


def around(values: ComplexArray) -> FloatArray:
    """Return frequencies on both sides of the resonance of each mode: (k,) to (k, 4) [rad/s]."""
    steps = np.array([-3.0, -1.0, 1.0, 3.0])
    return np.asarray(np.abs(np.abs(values.imag)[..., None] + np.abs(values.real)[..., None] * steps))


def _grid(modes: Eigensystem, base: FloatArray, extra: tuple[IntArray, FloatArray] | None) -> FloatArray:
    """Return ascending frequencies for each loop (m, f) [rad/s]."""
    m, n = modes.values.shape
    n_extra = 0 if extra is None else len(extra[0])
    grid = np.zeros((m, len(base) + 2 * n + n_extra))
    grid[:, : len(base)] = base
    own = grid[:, len(base) : len(base) + 2 * n]
    # Conjugate and real eigenvalues give shifted points, because two equal frequencies would look like a maximum.
    size, pair = np.abs(modes.values), modes.values.imag > 0
    own[:, :n] = np.where(pair, size, 1.07 * size)
    own[:, n:] = np.where(pair, modes.values.imag, 0.93 * size)
    if extra is not None:
        grid[extra[0], len(base) + 2 * n + np.arange(n_extra)] = extra[1]
    grid.sort(axis=1)
    return grid


def peak_slopes(loops: Derivatives, rows: slice, peaks: Peaks) -> tuple[FloatArray, FloatArray]:
    """Return derivatives (k, d) of the largest singular value by the gains at fixed frequency, and its value (k,).

    At a maximum over frequency this is the derivative of the peak, because the change of its frequency has an effect of
    second order only. With ``S = C R B + D``, ``R = (j w - A)^-1``: ``dS = dD + dC R B + C R (dB + dA R B)``.
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
    U, values, Vh = np.linalg.svd(C @ RB + D)
    u, v = U[:, :, 0].conj(), Vh[:, 0].conj()
    RBv = (RB @ v[:, :, None])[:, :, 0]
    uCR = np.asarray(np.linalg.solve(system.transpose(0, 2, 1), (u[:, None] @ C).transpose(0, 2, 1))[:, :, 0], complex)
    dS = bilinear(u, loops.dD[i][:, :, rows], v) + bilinear(u, loops.dC[i][:, :, rows], RBv)
    dS = dS + bilinear(uCR, loops.dB[i], v) + bilinear(uCR, loops.dA[i], RBv)
    return dS.real, values[:, 0]


# ---- The same peaks of two by two responses in C: on a grid of 200 frequencies, a tenth of the time.

_PEAKS_IN_C = r"""
#include <math.h>
#include <stdlib.h>
#include <string.h>

typedef struct { double re, im; } num;

/* One loop: modes (poles and residues), or for nearly parallel eigenvectors its Schur form with inputs and outputs. */
typedef struct { long n; const num *pole, *residue, *form, *inputs, *outputs; const double *D; } loop_response;

enum { TILE = 32 };

/* Entries of the response at frequencies w, as real and imaginary parts: sum over modes. */
static void of_modes(const loop_response *l, long count, const double *restrict w, double e[8][TILE])
{
    for (long k = 0; k < l->n; k++) {
        const num *r = l->residue + 4 * k;
        double rate = l->pole[k].re, place = l->pole[k].im;
        for (long i = 0; i < count; i++) {
            double off = w[i] - place, size = 1.0 / (rate * rate + off * off), x = -rate * size, y = -off * size;
            e[0][i] += x * r[0].re - y * r[0].im, e[1][i] += x * r[0].im + y * r[0].re;
            e[2][i] += x * r[1].re - y * r[1].im, e[3][i] += x * r[1].im + y * r[1].re;
            e[4][i] += x * r[2].re - y * r[2].im, e[5][i] += x * r[2].im + y * r[2].re;
            e[6][i] += x * r[3].re - y * r[3].im, e[7][i] += x * r[3].im + y * r[3].re;
        }
    }
}

/* The same by substitution in (j w - form) X = inputs; `work` holds X, four rows of TILE numbers for each state. */
static void of_form(const loop_response *l, long count, const double *restrict w, double (*work)[4][TILE],
                    double e[8][TILE])
{
    long n = l->n;
    for (long k = n - 1; k >= 0; k--) {
        double(*restrict X)[TILE] = work[k];
        num b0 = l->inputs[2 * k], b1 = l->inputs[2 * k + 1], t = l->form[k * n + k];
        for (long i = 0; i < TILE; i++) X[0][i] = b0.re, X[1][i] = b0.im, X[2][i] = b1.re, X[3][i] = b1.im;
        for (long j = k + 1; j < n; j++) {
            num f = l->form[k * n + j];
            double(*restrict Y)[TILE] = work[j];
            for (long i = 0; i < TILE; i++) {
                X[0][i] += f.re * Y[0][i] - f.im * Y[1][i], X[1][i] += f.re * Y[1][i] + f.im * Y[0][i];
                X[2][i] += f.re * Y[2][i] - f.im * Y[3][i], X[3][i] += f.re * Y[3][i] + f.im * Y[2][i];
            }
        }
        for (long i = 0; i < count; i++) {
            double off = w[i] - t.im, size = 1.0 / (t.re * t.re + off * off), x = -t.re * size, y = -off * size;
            double p = X[0][i], q = X[1][i];
            X[0][i] = p * x - q * y, X[1][i] = p * y + q * x;
            p = X[2][i], q = X[3][i];
            X[2][i] = p * x - q * y, X[3][i] = p * y + q * x;
        }
        for (long i = count; i < TILE; i++) X[0][i] = X[1][i] = X[2][i] = X[3][i] = 0.0;
        for (int r = 0; r < 2; r++) {
            num c = l->outputs[r * n + k];
            for (long i = 0; i < TILE; i++) {
                e[4 * r][i] += c.re * X[0][i] - c.im * X[1][i], e[4 * r + 1][i] += c.re * X[1][i] + c.im * X[0][i];
                e[4 * r + 2][i] += c.re * X[2][i] - c.im * X[3][i], e[4 * r + 3][i] += c.re * X[3][i] + c.im * X[2][i];
            }
        }
    }
}

/* Largest singular values at frequencies w. */
static void gains(const loop_response *l, long total, const double *w, double (*work)[4][TILE], double *out)
{
    double e[8][TILE];
    for (long first = 0; first < total; first += TILE, w += TILE, out += TILE) {
        long count = total - first < TILE ? total - first : TILE;
        for (int k = 0; k < 4; k++)
            for (long i = 0; i < TILE; i++) e[2 * k][i] = l->D[k], e[2 * k + 1][i] = 0.0;
        if (l->form) of_form(l, count, w, work, e);
        else of_modes(l, count, w, e);
        for (long i = 0; i < count; i++) {
            double sum = 0.0, x, y, product, rest;
            for (int k = 0; k < 8; k++) sum += e[k][i] * e[k][i];
            x = e[0][i] * e[6][i] - e[1][i] * e[7][i] - e[2][i] * e[4][i] + e[3][i] * e[5][i];
            y = e[0][i] * e[7][i] + e[1][i] * e[6][i] - e[2][i] * e[5][i] - e[3][i] * e[4][i];
            product = sqrt(x * x + y * y), rest = sum - 2 * product;
            out[i] = 0.5 * (sqrt(sum + 2 * product) + sqrt(rest > 0 ? rest : 0.0));
        }
    }
}

/* Place and height of the parabola through three points; without a top between them, the highest one. */
static void vertex(double middle, double step, const double *v, double *place, double *top)
{
    double bend = 2 * v[1] - v[0] - v[2], rise = (v[2] - v[0]) / 2, share = bend > 0 ? rise / bend : 0.0;
    share = share > 1 ? 1.0 : share < -1 ? -1.0 : share;
    if (fabs(share) < 1) {
        *place = middle + step * share, *top = v[1] + share * rise - share * share * bend / 2;
        return;
    }
    int at = v[1] > v[0] ? (v[2] > v[1] ? 2 : 1) : (v[2] > v[0] ? 2 : 0);
    *place = middle + step * (at - 1.0), *top = v[at];
}

static int ascending(const void *a, const void *b)
{
    double x = *(const double *)a, y = *(const double *)b;
    return (x > y) - (x < y);
}

/* Local maxima over frequency of m loops: returns their number; loop, place and height of each. */
long peaks(long m, long n, long n_base, long n_extra, double least, long most, const num *pole, const num *residue,
           const double *D, const long *form_of, const num *form, const num *inputs, const num *outputs,
           const double *base, const long *extra_loop, const double *extra_w, long *loop, double *place, double *height)
{
    enum { N = 9 };
    long room = n_base + 2 * n + n_extra, found = 0;
    double *grid = malloc(3 * room * sizeof(double)), points[N], there[N];
    double(*work)[4][TILE] = malloc(n * sizeof *work);
    if (!grid || !work) {
        free(grid), free(work);
        return -1;
    }
    double *own = grid + room, *value = own + room;
    for (long l = 0; l < m; l++) {
        const num *p = pole + n * l;
        loop_response r = {n, p, residue + 4 * n * l, 0, 0, 0, D + 4 * l};
        long count = 0, special = form_of[l];
        if (special >= 0) {
            r.form = form + special * n * n;
            r.inputs = inputs + special * 2 * n, r.outputs = outputs + special * 2 * n;
        }
        for (long k = 0; k < n; k++) {
            /* conjugate and real poles give shifted points: two equal frequencies would look like a maximum */
            double size = sqrt(p[k].re * p[k].re + p[k].im * p[k].im);
            int upper = p[k].im > 0;
            own[count++] = upper ? size : 1.07 * size;
            own[count++] = upper ? p[k].im : 0.93 * size;
        }
        for (long k = 0; k < n_extra; k++)
            if (extra_loop[k] == l) own[count++] = extra_w[k];
        qsort(own, count, sizeof(double), ascending);
        long total = 0, i = 0, j = 0;
        while (i < n_base || j < count)
            grid[total++] = j == count || (i < n_base && base[i] <= own[j]) ? base[i++] : own[j++];
        gains(&r, total, grid, work, value);
        double highest = 0.0;
        int sound = 1;
        for (i = 0; i < total; i++) {
            if (!(value[i] - value[i] == 0)) sound = 0;
            if (value[i] > highest) highest = value[i];
        }
        double enough = 0.6 * highest > 0.9 * least ? 0.6 * highest : 0.9 * least;
        for (i = 0; sound && i < total; i++) {
            if (!(value[i] > enough) || (i > 0 && value[i] < value[i - 1])) continue;
            if (i + 1 < total && value[i] <= value[i + 1]) continue;
            double low = grid[i > 0 ? i - 1 : 0], high = grid[i + 1 < total ? i + 1 : i];
            double best = value[i], where = grid[i], three[3], middle, top;
            for (int round = 0; round < 2; round++) {
                for (j = 0; j < N; j++) points[j] = low + (high - low) * (j / (N - 1.0));
                gains(&r, N, points, work, there);
                long at = 0;
                for (j = 1; j < N; j++)
                    if (there[j] > there[at]) at = j;
                at = at < 1 ? 1 : at > N - 2 ? N - 2 : at;
                low = points[at - 1], high = points[at + 1];
                memcpy(three, there + at - 1, sizeof three);
                if (three[1] > best * (1 + 1e-12)) best = three[1], where = points[at];
            }
            double step = (high - low) / 2;
            vertex(low + step, step, three, &middle, &top);
            step *= 0.1;
            for (j = 0; j < 3; j++) points[j] = middle + step * (j - 1.0) > 0 ? middle + step * (j - 1.0) : 0.0;
            gains(&r, 3, points, work, three);
            vertex(middle, step, three, &middle, &top);
            if (found < most) {
                loop[found] = l;
                int better = top > best * (1 + 1e-12);
                place[found] = better ? middle : where;
                height[found++] = better ? top : best;
            }
        }
    }
    free(grid), free(work);
    return found;
}
"""


@cache
def kernel() -> Library | None:
    """Return the compiled library; None without a C compiler."""
    try:
        library = load_library(_PEAKS_IN_C)
    except CompilerMissingError:
        return None
    number = ctypes.c_long
    library.peaks.argtypes = [*[number] * 4, ctypes.c_double, number, *[ctypes.c_void_p] * 13]
    library.peaks.restype = number
    return library


def _compiled_peaks(
    library: Library,
    response: ModalResponse,
    base: FloatArray,
    extra: tuple[IntArray, FloatArray] | None,
    least: float,
) -> Peaks:
    """Return the peaks of two by two responses, see `find_peaks`."""
    poles, residues, D, forms = response.parts()
    m, n = poles.shape
    loops, places = (np.zeros(0, np.intp), np.zeros(0)) if extra is None else extra
    most = m * (len(base) + 2 * n + len(places)) // 2 + m
    results = np.empty(most, np.intp), np.empty(most), np.empty(most)
    form_of, schur = np.full(m, -1), [np.zeros(0, complex)] * 3
    if forms:
        form_of[list(forms)] = np.arange(len(forms))
        schur = [np.array(parts) for parts in zip(*forms.values(), strict=True)]
    given = [np.ascontiguousarray(array) for array in (poles, residues, D, form_of, *schur, base)]
    extras = np.ascontiguousarray(loops, np.intp), np.ascontiguousarray(places, float)
    arrays = [array.ctypes.data for array in (*given, *extras, *results)]
    count = library.peaks(m, n, len(base), len(places), least, most, *arrays)
    if count < 0:
        raise MemoryError("the kernel of the peaks got no memory")
    return Peaks(*(array[:count].copy() for array in results))
