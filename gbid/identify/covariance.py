"""Covariance of the estimates: for white residuals, and a robust one for coloured residuals."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from gbid.identify.blocks import LONGEST_BLOCK, cut
from gbid.identify.shooting import Part, Shooting
from gbid.identify.sweep import block_sums, joined, link, powers_of, start_hessians
from gbid.identify.whiteness import correlation_length

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
_UNDETERMINED = 1e-13  # eigenvalue of the scaled information below which a direction counts as not determined
_BLOCKS = 64  # the least number of blocks, within which scores are summed before they are correlated
_SHORTEST, _LONGEST = 8, 64  # samples in such a block
_MOST_BLOCKS = 200  # in long records the blocks grow instead


class Covariance(NamedTuple):
    """Uncertainty of the free parameters, initial states estimated along.

    Attributes
    ----------
    white : (n_p, n_p) array
        For white residuals.
    robust : (n_p, n_p) array
        For residuals of any colour.
    undetermined : (n_directions, n_p) array
        Unit directions, in parameters scaled by their curvature, that the data say nothing about; mostly empty.
    condition : float
        Condition of the scaled information.
    """

    white: FloatArray
    robust: FloatArray
    undetermined: FloatArray
    condition: float


def covariance(
    problem: Shooting,
    theta: FloatArray,
    starts: FloatArray,
    record_window: IntArray,
    error_products: FloatArray,
    errors: list[FloatArray],
    held: npt.NDArray[np.bool_],
    *,
    initial_known: bool = False,
) -> Covariance:
    """Covariance of the parameters at an estimate.

    Parameters
    ----------
    problem : Shooting
    theta : (n_p,) array
    starts : (n_windows, n) array
    record_window : (n_records,) integer array
        First window of each record.
    error_products : (n_y, n_y) array
        ``sum e e'``.
    errors : list of (n_samples, n_y) array
        Residuals, for the length of their memory.
    held : (n_p,) boolean array
        Parameters on a bound: they count as known, and get zero rows.
    initial_known : bool
        Whether initial states were given instead of estimated.

    Returns
    -------
    Covariance

    Notes
    -----
    With ``H = sum psi' W psi`` over parameters and initial states, and J the covariance of the gradient
    ``sum psi' W e``, the estimates have the covariance ``H^-1 J H^-1`` (Ljung, System Identification,
    Secs. 9.2 to 9.4). For white residuals of covariance Lambda, ``J = sum psi' W Lambda W psi``. The robust J
    sums the products of the gradients of neighbouring blocks, with weights that fall to zero at a few times
    the residuals' memory (Newey and West, 1987). A prior adds its information to H and, as what a datum of its
    variance would do, to J.
    """
    n_p = problem.n_theta
    n_all = n_p + len(record_window) * problem.n_states
    weight = problem.weight(error_products)
    freedom = max(1.0, problem.n_samples - n_all / len(weight))
    block = min(max(problem.n_samples // _BLOCKS, _SHORTEST), _LONGEST)
    block = max(block, min(problem.n_samples // _MOST_BLOCKS, LONGEST_BLOCK))
    fine = _by_piece(problem, block)
    first = _information(problem, fine, theta, starts, record_window, weight, scores=True)
    shaped = weight @ (error_products / freedom) @ weight
    second = _information(problem, fine, theta, starts, record_window, shaped)

    # The weight is one over the total error, the likelihood's one over its variance: they differ by this factor.
    unit = float(np.trace(weight @ error_products)) / (problem.n_samples * len(weight))
    known = np.concatenate([problem.prior.information * unit, np.zeros(n_all - n_p)])
    keep = np.concatenate([~held, np.full(n_all - n_p, not initial_known)])
    kept = np.ix_(keep, keep)
    H = (first.hessian + np.diag(known))[kept]
    J_white = (second.hessian + np.diag(known * unit))[kept]
    lag = max(1, round(3 * correlation_length(errors) / block))
    J_robust = long_run([scores[:, keep] for scores in first.scores], lag) + np.diag(known * unit)[kept]

    scale = np.sqrt(np.maximum(np.diag(H), np.finfo(float).tiny))
    eigenvalues, vectors = np.linalg.eigh(H / np.outer(scale, scale))
    dark = eigenvalues < _UNDETERMINED * eigenvalues[-1]
    inverse = (vectors[:, ~dark] / eigenvalues[~dark]) @ vectors[:, ~dark].T / np.outer(scale, scale)
    n_kept = int((~held).sum())

    def over_parameters(J: FloatArray) -> FloatArray:
        result = np.zeros((n_p, n_p))
        result[np.ix_(~held, ~held)] = (inverse @ J @ inverse)[:n_kept, :n_kept]
        return result

    directions = np.zeros((int(dark.sum()), n_p))
    directions[:, ~held] = vectors[:n_kept, dark].T
    # A direction among initial states alone is no concern of the parameters.
    directions = directions[np.linalg.norm(directions, axis=1) > 1e-2]
    condition = float(eigenvalues[-1] / max(eigenvalues[0], np.finfo(float).tiny))
    return Covariance(over_parameters(J_white), over_parameters(J_robust), directions, condition)


class _Fine(NamedTuple):
    """A part cut anew, each piece as one window of short blocks, and the windows these pieces start with."""

    part: Part
    windows: IntArray


class _Information(NamedTuple):
    hessian: FloatArray  # (n_all, n_all) over parameters and initial states
    scores: list[FloatArray]  # per record, (n_blocks, n_all): gradient of each block


def _by_piece(problem: Shooting, block: int) -> list[_Fine]:
    fine = []
    for part, first in zip(problem.parts, problem.first_window[:-1], strict=True):
        blocks = cut(part.blocks.pieces, part.predictor, None, longest_block=block)
        fine.append(_Fine(replace(part, blocks=blocks), first + part.blocks.piece_first))
    return fine


def _information(
    problem: Shooting,
    fine: list[_Fine],
    theta: FloatArray,
    starts: FloatArray,
    record_window: IntArray,
    weight: FloatArray,
    *,
    scores: bool = False,
) -> _Information:
    """Run a pass over whole pieces and refer everything to parameters and the records' initial states."""
    n, n_p = problem.n_states, problem.n_theta
    n_all = n_p + len(record_window) * n
    record_of = {int(window): i for i, window in enumerate(record_window)}
    chains: dict[int, tuple[FloatArray, int]] = {}  # start of the piece at a window: sensitivity, record
    for window, record in record_of.items():
        T = np.zeros((n, n_all))
        T[:, n_p + record * n : n_p + (record + 1) * n] = np.eye(n)
        chains[window] = T, record
    hessian = np.zeros((n_all, n_all))
    gathered: list[list[tuple[int, FloatArray]]] = [[] for _ in record_window]
    passes = []
    for v, (part, windows) in zip(problem.values(theta), fine, strict=True):
        powers = powers_of(v.F, part.blocks.length)
        sums, free = block_sums(v, part.blocks, starts[windows], weight, powers, part.engine)
        linked = link(part.blocks, sums.end_theta, powers)
        whole = joined(part.blocks, sums, start_hessians(part.blocks, free), linked)
        passes.append((part, windows, sums, whole, linked))
    _follow_pieces(problem, passes, chains)
    for part, windows, sums, whole, linked in passes:
        hessian[np.ix_(part.index, part.index)] += whole.hessian
        for i, window in enumerate(windows):
            T, record = chains[int(window)]
            mixed = whole.hessian_mixed[i] @ T
            hessian[part.index] += mixed
            hessian[:, part.index] += mixed.T
            hessian += T.T @ whole.hessian_start[i] @ T
            if scores:
                own = slice(part.blocks.window_first[i], part.blocks.window_first[i] + part.blocks.window_size[i])
                g, gx = sums.gradient[own], sums.gradient_start[own]
                block = (gx[:, None, :] @ linked.by_start[own])[:, 0] @ T
                block[:, part.index] += g + (gx[:, None, :] @ linked.by_theta[own])[:, 0]
                gathered[record].append((int(window), block))
    ordered = [np.concatenate([b for _, b in sorted(parts, key=lambda item: item[0])]) for parts in gathered if parts]
    return _Information(hessian, ordered)


def _follow_pieces(problem: Shooting, passes: list, chains: dict[int, tuple[FloatArray, int]]) -> None:  # type: ignore[type-arg]
    """Carry sensitivities from piece to piece of a record, over the stretches that are left out."""
    piece_of = {}
    last_window = {}
    for k, (_, windows, *_) in enumerate(passes):
        original = problem.parts[k].blocks
        ends = np.append(original.piece_first[1:], original.n_windows) - 1 + problem.first_window[k]
        for i, window in enumerate(windows):
            piece_of[int(window)] = (k, i)
            last_window[int(ends[i])] = int(window)
    for a, b in problem.links:
        if int(b) in piece_of and int(a) in last_window:
            T, record = chains[last_window[int(a)]]
            k, i = piece_of[last_window[int(a)]]
            part, _, _, whole, _ = passes[k]
            following = whole.end_start[i] @ T
            following[:, part.index] += whole.end_theta[i]
            chains[int(b)] = following, record


def long_run(scores: list[FloatArray], lag: int) -> FloatArray:
    """Covariance of the sum of scores, neighbours up to `lag` blocks counted with falling weights."""
    n = scores[0].shape[1]
    total = np.zeros((n, n))
    for s in scores:
        total += s.T @ s
        for shift in range(1, min(lag, len(s) - 1) + 1):
            product = s[shift:].T @ s[:-shift]
            total += (1 - shift / (lag + 1)) * (product + product.T)
    return total
