"""Peaks of the sensitivities of many loops over frequency, and their derivatives by the gains."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from gbid.arrays import ComplexArray, FloatArray
from gbid.control.loop.norm import largest_singular_values
from gbid.control.tuning.search.loop_family import Derivatives, Loops
from gbid.control.tuning.search.spectrum import Eigensystem, bilinear

IntArray = npt.NDArray[np.intp]
_BASE = np.concatenate([[0.0], np.geomspace(1.0, 1e5, 140)])
_USELESS = 1e8
"""Largest entry of left eigenvectors from which responses are computed without them."""
_STEPS = np.linspace(0.0, 1.0, 25)


@dataclass(frozen=True)
class Peaks:
    """Local maxima over frequency: index of the loop, angular frequency [rad/s] and height, all (k,)."""

    loop: IntArray
    frequency: FloatArray
    value: FloatArray


def respond(loops: Loops, modes: Eigensystem, rows: slice, which: IntArray, frequency: FloatArray) -> ComplexArray:
    """Return frequency responses of some outputs of chosen loops at (k, f) frequencies [rad/s]: (k, f, n_y, n_d)."""
    CV = loops.C[which][:, rows] @ modes.right[which]
    WB = modes.left[which] @ loops.B[which]
    resolvent = 1.0 / (1j * frequency[:, :, None] - modes.values[which][:, None, :])
    found = np.asarray((CV[:, None] * resolvent[:, :, None, :]) @ WB[:, None] + loops.D[which][:, None, rows])
    # nearly defective matrices, such as those of delays of several samples, have no use of their eigenvectors
    for i in np.flatnonzero(np.abs(modes.left).max(axis=(1, 2))[which] > _USELESS):
        A, B, C, D = (M[which[i]] for M in (loops.A, loops.B, loops.C[:, rows], loops.D[:, rows]))
        found[i] = C @ np.linalg.solve(1j * frequency[i, :, None, None] * np.eye(len(A)) - A, B.astype(complex)) + D
    return found


def _largest(responses: ComplexArray, _: FloatArray) -> FloatArray:
    """Return the largest singular value at each frequency."""
    return largest_singular_values(responses)


def find_peaks(
    loops: Loops,
    modes: Eigensystem,
    rows: slice,
    extra: tuple[IntArray, FloatArray] | None = None,
    gain: Callable[[ComplexArray, FloatArray], FloatArray] = _largest,
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

    Notes
    -----
    The grid has logarithmic spacing and contains the magnitudes of the eigenvalues of each loop, because a peak that a
    coarse grid would miss belongs to a lightly damped eigenvalue. Each local maximum is then refined.
    """
    m = len(loops.A)
    size, pair = np.abs(modes.values), modes.values.imag > 0
    # Conjugate and real eigenvalues give shifted points, because two equal frequencies would look like a maximum.
    own = [np.where(pair, size, 1.07 * size), np.where(pair, modes.values.imag, 0.93 * size)]
    grid = np.concatenate([np.broadcast_to(_BASE, (m, len(_BASE))), *own], axis=1)
    if extra is not None:
        more = np.zeros((m, len(extra[0])))
        more[extra[0], np.arange(len(extra[0]))] = extra[1]
        grid = np.concatenate([grid, more], 1)
    grid = np.sort(grid, axis=1)
    values = gain(respond(loops, modes, rows, np.arange(m), grid), grid)
    padded = np.pad(values, ((0, 0), (1, 1)), constant_values=-np.inf)
    # of neighbours at one frequency only the last counts
    top = (values >= padded[:, :-2]) & (values > padded[:, 2:]) & (values > 0.6 * values.max(axis=1, keepdims=True))
    loop, column = np.nonzero(top)
    low = grid[loop, np.maximum(column - 1, 0)]
    high = grid[loop, np.minimum(column + 1, grid.shape[1] - 1)]
    best, place = values[loop, column], grid[loop, column]
    row = np.arange(len(loop))
    for _ in range(3):
        points = low[:, None] + (high - low)[:, None] * _STEPS
        found = gain(respond(loops, modes, rows, loop, points), points)
        at = found.argmax(axis=1)
        better = found[row, at] > best
        best, place = np.where(better, found[row, at], best), np.where(better, points[row, at], place)
        low, high = points[row, np.maximum(at - 1, 0)], points[row, np.minimum(at + 1, len(_STEPS) - 1)]
    return Peaks(loop, place, best)


def peak_slopes(loops: Derivatives, rows: slice, peaks: Peaks) -> tuple[FloatArray, FloatArray]:
    """Return derivatives (k, d) of the largest singular value by the gains at fixed frequency, and its value (k,).

    At a maximum over frequency this is the derivative of the peak, because the change of its frequency has an effect of
    second order only. With ``S = C R B + D``, ``R = (j w - A)^-1``: ``dS = dD + dC R B + C R (dB + dA R B)``.
    """
    i, n = peaks.loop, loops.A.shape[-1]
    system = 1j * peaks.frequency[:, None, None] * np.eye(n) - loops.A[i]
    RB = np.linalg.solve(system, loops.B[i].astype(complex))
    C, D = loops.C[i][:, rows], loops.D[i][:, rows]
    CR = np.linalg.solve(system.transpose(0, 2, 1), C.transpose(0, 2, 1).astype(complex)).transpose(0, 2, 1)
    U, values, Vh = np.linalg.svd(C @ RB + D)
    u, v = U[:, :, 0].conj(), Vh[:, 0].conj()
    RBv = (RB @ v[:, :, None])[:, :, 0]
    uCR = (u[:, None] @ CR)[:, 0]
    dS = bilinear(u, loops.dD[i][:, :, rows], v) + bilinear(u, loops.dC[i][:, :, rows], RBv)
    dS += bilinear(uCR, loops.dB[i], v) + bilinear(uCR, loops.dA[i], RBv)
    return np.asarray(dS.real), np.asarray(values[:, 0])
