"""H-infinity norm: largest singular value of a transfer matrix over all frequencies, computed exactly."""

from __future__ import annotations

from collections.abc import Callable
from math import inf, pi
from typing import Any, NamedTuple

import numpy as np
import scipy

from gbid.core.arrays import ComplexArray, FloatArray
from gbid.core.errors import UsageError
from gbid.structure import LinearModel


class Peak(NamedTuple):
    """Largest gain over frequency, and its frequency.

    Attributes
    ----------
    value : float
        Largest gain; infinite for an unstable model.
    frequency_hz : float
        Frequency [Hz]; infinite when the largest gain is the limit at high frequency, NaN for an unstable model.
    """

    value: float
    frequency_hz: float


def peak_gain(model: LinearModel, tolerance: float = 1e-8, least: float = 0.0) -> Peak:
    r"""Return the H-infinity norm, the largest singular value over all frequencies.

    Parameters
    ----------
    model : LinearModel
        Continuous without exact delays, or sampled.
    tolerance : float
        Relative tolerance; no frequency has a gain that is larger by more than twice this.
    least : float
        Gain that matters. Where no frequency has a larger one, the returned gain may be too small, but takes less time.

    Returns
    -------
    Peak
        Norm of the transfer matrix from all inputs to all outputs; infinite when the model is not stable.

    Raises
    ------
    UsageError
        When the model has exact delays (use `gbid.control.Sensitivities.peak`).

    Notes
    -----
    Bruinsma and Steinbuch (1990): :math:`\gamma` is a singular value of :math:`G(\mathrm i\omega)` exactly when
    the Hamiltonian matrix

    .. math:: H_\gamma = \begin{bmatrix} F & B R^{-1} B^T \\ -C^T (I + D R^{-1} D^T) C & -F^T \end{bmatrix},
              \quad R = \gamma^2 I - D^T D, \quad F = A + B R^{-1} D^T C,

    has an eigenvalue :math:`\mathrm i\omega`. For a lower bound these frequencies form intervals, and the middles of
    the intervals give a better bound. This is repeated until no frequency is found. The first lower bound is the
    largest gain at the frequencies of the poles, so that one eigenvalue problem is usually enough. A sampled model is
    mapped to a continuous one by the bilinear transform, which does not change the norm.
    """
    if model.delay is not None:
        raise UsageError(f"model {model.name!r} has exact delays; its peak follows from frequency responses only")
    if not model.is_stable():
        return Peak(inf, float("nan"))
    A, B, C, D = (np.array(m) for m in (model.A, model.B, model.C, model.D))
    if model.dt is not None:  # G_c((z - 1)/(z + 1)) = G(z): equal gains at w = tan(theta / 2)
        eye = np.eye(len(A))
        plus = np.linalg.inv(A + eye)
        A, B, C, D = (A - eye) @ plus, np.sqrt(2) * plus @ B, np.sqrt(2) * C @ plus, D - C @ plus @ B
    value, w = _peak_of(A, B, C, D, tolerance, least)
    return Peak(value, w / (2 * pi) if model.dt is None else float(np.arctan(w) / (pi * model.dt)))


def largest_singular_values(matrices: ComplexArray) -> FloatArray:
    """Return the largest singular value of each matrix of a stack (..., n, m); closed form for two by two matrices.

    It is infinite for a matrix that is not finite: the response at a pole on the imaginary axis.
    """
    if matrices.shape[-2:] == (2, 2):
        a, b, c, d = (matrices[..., i, j] for i in (0, 1) for j in (0, 1))
        squares = (matrices.real**2 + matrices.imag**2).sum(axis=(-2, -1))
        with np.errstate(invalid="ignore"):
            values = larger_of_two(squares, np.abs(a * d - b * c))
        return np.asarray(np.where(np.isfinite(squares), values, inf))
    finite = np.asarray(np.isfinite(matrices).all(axis=(-2, -1)))
    M = np.where(finite[..., None, None], matrices, 0.0 + 0.0j)
    wide = M.shape[-2] < M.shape[-1]
    size = np.maximum(np.abs(M).max(axis=(-2, -1), initial=0.0), 1e-300)[..., None, None]
    M = M / size
    # the largest eigenvalue of the smaller Gram matrix takes a third of the time of a decomposition
    gram = M @ M.conj().swapaxes(-2, -1) if wide else M.conj().swapaxes(-2, -1) @ M
    values = size[..., 0, 0] * np.sqrt(np.maximum(np.linalg.eigvalsh(gram)[..., -1], 0.0))
    return np.asarray(np.where(finite, values, inf))


def larger_of_two(squares: FloatArray, determinant: FloatArray) -> FloatArray:
    """Return the larger of two singular values from the sum of their squares and their product."""
    return np.asarray(0.5 * (np.sqrt(squares + 2 * determinant) + np.sqrt(np.maximum(squares - 2 * determinant, 0.0))))


def refine_maxima(function: Callable[[FloatArray], FloatArray], grid: FloatArray) -> Peak:
    """Return the largest value of a function of frequency, from a grid and refinement of its best local maxima.

    Four local maxima are refined six times. Each time reduces the bracket eightfold around the best of 17 points.

    Parameters
    ----------
    function : callable
        From frequencies (n,) to values (n,).
    grid : (n,) array
        Frequencies [Hz], ascending; the ends count as well.
    """
    values = function(grid)
    padded = np.concatenate([[-inf], values, [-inf]])
    peaks = np.flatnonzero((values >= padded[:-2]) & (values >= padded[2:]))
    peaks = peaks[np.argsort(values[peaks])[::-1][:4]]
    low, high = grid[np.maximum(peaks - 1, 0)], grid[np.minimum(peaks + 1, len(grid) - 1)]
    steps = np.linspace(0.0, 1.0, 17)
    row = np.arange(len(peaks))
    for _ in range(6):
        points = low[:, None] + (high - low)[:, None] * steps
        refined = function(points.ravel()).reshape(points.shape)
        top = refined.argmax(axis=1)
        best, place = refined[row, top], points[row, top]
        inner = np.clip(top, 1, len(steps) - 2)
        low, high = points[row, inner - 1], points[row, inner + 1]
    winner = int(best.argmax())
    if best[winner] < values.max():
        return Peak(float(values.max()), float(grid[values.argmax()]))
    return Peak(float(best[winner]), float(place[winner]))


def _peak_of(
    A: FloatArray, B: FloatArray, C: FloatArray, D: FloatArray, tolerance: float, least: float
) -> tuple[float, float]:
    """Return the largest gain of a stable continuous model, and its angular frequency."""
    at_infinity = float(np.linalg.norm(D, 2)) if D.size else 0.0
    if not len(A) or not B.any() or not C.any():
        return at_infinity, 0.0
    A, scaling = scipy.linalg.matrix_balance(A, permute=False, separate=True)
    scale = scaling[0]
    B, C = B / scale[:, None], C * scale
    eye = np.eye(len(A))

    def gains(w: FloatArray) -> FloatArray:
        states = np.linalg.solve(1j * w[:, None, None] * eye - A, B.astype(complex))
        return largest_singular_values(np.asarray(C @ states + D, np.complex128))

    poles = np.linalg.eigvals(A)
    places = np.unique(np.concatenate([[0.0], np.abs(poles), np.abs(poles.imag)]))
    sizes = gains(places)
    best, w_best = float(sizes.max()), float(places[sizes.argmax()])
    if at_infinity > best:
        best, w_best = at_infinity, inf
    # below it a response is rounding, as that of states which the input does not reach
    least = max(least, 1e-13 * float(np.linalg.norm(B) * np.linalg.norm(C) / (np.linalg.norm(A) + 1e-300)), 1e-100)
    for _ in range(60):
        gamma = max(best, least) * (1 + 2 * tolerance)
        crossings = crossing_frequencies(A, B, C, D, gamma)
        if not len(crossings):
            break
        edges = np.unique(np.concatenate([[0.0], crossings]))
        middles = np.concatenate([edges, (edges[1:] + edges[:-1]) / 2])
        sizes = gains(middles)
        if sizes.max() <= gamma:  # the crossings come from rounding: the curve does not exceed gamma
            if sizes.max() > best:
                best, w_best = float(sizes.max()), float(middles[sizes.argmax()])
            break
        best, w_best = float(sizes.max()), float(middles[sizes.argmax()])
    return _vertex(gains, best, w_best)


def _vertex(gains: Callable[[FloatArray], FloatArray], best: float, w: float) -> tuple[float, float]:
    """Return the maximum refined by the parabola through three points."""
    if not 0 < w < inf:
        return best, w
    step = 1e-4 * w
    before, middle, after = gains(np.array([w - step, w, w + step]))
    bend = before - 2 * middle + after
    if bend >= 0:
        return best, w
    place = w + np.clip(0.5 * (before - after) / bend, -1.0, 1.0) * step
    value = float(gains(np.array([place]))[0])
    return (value, float(place)) if value > best else (best, w)


def crossing_frequencies(
    A: FloatArray,
    B: FloatArray,
    C: FloatArray,
    D: FloatArray,
    gamma: float,
    eigenvalues: Callable[[FloatArray], Any] = np.linalg.eigvals,
) -> FloatArray:
    """Return angular frequencies at which a singular value may equal gamma; rounding may add wrong frequencies."""
    R = gamma**2 * np.eye(D.shape[1]) - D.T @ D
    weighted = np.linalg.solve(R, np.hstack([B.T, D.T @ C]))
    BRB, RDC = B @ weighted[:, : len(A)], weighted[:, len(A) :]
    F = A + B @ RDC
    # both off-diagonal blocks of one size: the eigenvalues do not change with this scaling
    lower = C.T @ (C + D @ RDC)
    ratio = np.sqrt(max(float(np.linalg.norm(lower)), 1e-300) / max(float(np.linalg.norm(BRB)), 1e-300))
    H = np.block([[F, BRB * ratio], [-lower / ratio, -F.T]])
    values = eigenvalues(H)
    near = np.abs(values.real) <= 1e-7 * np.abs(values) + 1e-13 * np.linalg.norm(H, 1)
    return np.asarray(np.sort(values.imag[near & (values.imag >= 0)]))
