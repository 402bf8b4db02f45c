"""One pass over the samples: cost, gradient, Gauss-Newton Hessian and end states of every window.

The predictor is linear in the state, so the pass is a recursion over ``x`` and its parameter sensitivities
``s_i = dx / dtheta_i``:

    x[k+1] = F x[k] + G z[k],     s_i[k+1] = F s_i[k] + (dF_i x[k] + dG_i z[k]),
    yhat[k] = C x[k] + H z[k],    psi_i[k] = C s_i[k] + dC_i x[k] + dH_i z[k],

run for all blocks side by side, each from its own start. The free response from a start is ``F^k``, the same
for all blocks. A window of several blocks is linked afterwards, exactly, through the sensitivity of each
inner start to the parameters and to the start of the window: single shooting is the case of one window, and
costs no more than multiple shooting.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from gbid.identify.blocks import Blocks
from gbid.identify.predictor import PredictorValues

FloatArray = npt.NDArray[np.float64]
_CHUNK_BYTES = 32 * 2**20  # sensitivities held at a time


@dataclass(frozen=True, eq=False)
class Sweep:
    """Sums over the samples at one point; the cost is ``sum e' W e / 2``.

    Attributes
    ----------
    error_products : (n_y, n_y) array
        ``sum e e'``, unweighted.
    gradient : (n_p,) array
        With respect to the parameters.
    gradient_start : (n_windows, n) array
        With respect to each window's start.
    hessian : (n_p, n_p) array
    hessian_mixed : (n_windows, n_p, n) array
    hessian_start : (n_windows, n, n) array
    end : (n_windows, n) array
        State after each window.
    end_theta : (n_windows, n, n_p) array
    end_start : (n_windows, n, n) array
        Its sensitivities.
    """

    error_products: FloatArray
    gradient: FloatArray
    gradient_start: FloatArray
    hessian: FloatArray
    hessian_mixed: FloatArray
    hessian_start: FloatArray
    end: FloatArray
    end_theta: FloatArray
    end_start: FloatArray


class _BlockSums(NamedTuple):
    gradient: FloatArray  # (n_p,)
    gradient_start: FloatArray  # (W, n)
    hessian: FloatArray  # (n_p, n_p)
    mixed: FloatArray  # (W, n_p, n)
    start: FloatArray  # (W, n, n)
    products: FloatArray  # (n_y, n_y)
    end_theta: FloatArray  # (W, n, n_p)


def powers_of(F: FloatArray, count: int) -> FloatArray:
    """Return ``F^0`` to ``F^count``, shape (count + 1, n, n), by doubling."""
    powers = np.empty((count + 1, *F.shape))
    powers[0] = np.eye(len(F))
    have, step = 1, F
    while have <= count:
        take = min(have, count + 1 - have)
        powers[have : have + take] = powers[:take] @ step
        step = step @ step
        have += take
    return powers


def forced_states(v: PredictorValues, blocks: Blocks) -> FloatArray:
    """States of all blocks from zero start, and after their end: (length + 1, n, n_blocks)."""
    forcing = v.G @ blocks.z
    states = np.zeros((blocks.length + 1, len(v.F), blocks.n_blocks))
    for k in range(blocks.length):
        states[k + 1] = v.F @ states[k] + forcing[k]
    return states


def block_starts(blocks: Blocks, starts: FloatArray, ends: FloatArray, transition: FloatArray) -> FloatArray:
    """Start state of every block, shape (n, n_blocks), from the windows' starts (n_windows, n)."""
    x = np.empty((len(transition), blocks.n_blocks))
    x[:, blocks.window_first] = starts.T
    for i in range(1, blocks.per_window):
        inner = blocks.window_first[blocks.window_size > i] + i
        x[:, inner] = transition @ x[:, inner - 1] + ends[:, inner - 1]
    return x


def residuals(v: PredictorValues, blocks: Blocks, starts: FloatArray) -> FloatArray:
    """Prediction errors ``y - yhat``, shape (length, n_y, n_blocks), zero on padding."""
    powers = powers_of(v.F, blocks.length)
    states = forced_states(v, blocks)
    x0 = block_starts(blocks, starts, states[-1], powers[-1])
    response = v.C @ (states[:-1] + powers[:-1] @ x0) + v.H @ blocks.z
    return np.asarray((blocks.y - response) * blocks.used[:, None, :])


def sweep(v: PredictorValues, blocks: Blocks, starts: FloatArray, weight: FloatArray) -> Sweep:
    """Run the pass.

    Parameters
    ----------
    v : PredictorValues
    blocks : Blocks
    starts : (n_windows, n) array
        State at the start of each window.
    weight : (n_y, n_y) array
        ``W``, positive definite.

    Returns
    -------
    Sweep
    """
    n, n_p = len(v.F), len(v.dF)
    powers = powers_of(v.F, blocks.length)
    if blocks.per_window > 1:
        x0 = block_starts(blocks, starts, forced_states(v, blocks)[-1], powers[-1])
    else:
        x0 = np.ascontiguousarray(starts.T)
    root = np.linalg.cholesky(weight).T  # W = root' root
    free = np.ascontiguousarray(root @ v.C @ powers[:-1])  # weighted response to the start
    per_block = 8 * blocks.length * n * (1 + n_p)
    width = max(8, _CHUNK_BYTES // per_block)
    sums, x_end = [], []
    for first in range(0, blocks.n_blocks, width):
        part = slice(first, first + width)
        s, e = _run(v, blocks, part, x0[:, part], root, free)
        sums.append(s)
        x_end.append(e)
    ends = np.concatenate(x_end, axis=1)
    joined = _BlockSums(
        sum(s.gradient for s in sums),
        np.concatenate([s.gradient_start for s in sums]),
        sum(s.hessian for s in sums),
        np.concatenate([s.mixed for s in sums]),
        np.concatenate([s.start for s in sums]),
        sum(s.products for s in sums),
        np.concatenate([s.end_theta for s in sums]),
    )
    return _link(blocks, joined, ends, powers[-1])


def _run(
    v: PredictorValues, blocks: Blocks, part: slice, x0: FloatArray, root: FloatArray, free: FloatArray
) -> tuple[_BlockSums, FloatArray]:
    """Run some blocks with their sensitivities and sum up; also return their end states (n, W)."""
    n, n_p, n_y, length = len(v.F), len(v.dF), len(v.C), blocks.length
    z, y, used = blocks.z[:, :, part], blocks.y[:, :, part], blocks.used[:, part]
    width = z.shape[2]
    # Column 0 of the joined state is x, column 1 + i is s_i; the drive of x comes from z alone.
    drive_x = np.concatenate([np.zeros((1, n, n)), v.dF]).transpose(1, 0, 2).reshape(n * (1 + n_p), n)
    drive_z = np.concatenate([v.G[None], v.dG]).transpose(1, 0, 2).reshape(n * (1 + n_p), -1)
    drive = np.hstack([drive_x, drive_z])
    history = np.empty((length, n, (1 + n_p) * width))
    state = np.zeros((n, 1 + n_p, width))
    state[:, 0] = x0
    joined = np.empty((n + z.shape[1], width))
    for k in range(length):
        flat = state.reshape(n, -1)
        history[k] = flat
        joined[:n], joined[n:] = state[:, 0], z[k]
        state = (v.F @ flat).reshape(n, 1 + n_p, width) + (drive @ joined).reshape(n, 1 + n_p, width)
    response = (v.C @ history).reshape(length, n_y, 1 + n_p, width)
    response[:, :, 0] += v.H @ z
    if v.dC.any():
        states = history.reshape(length, n, 1 + n_p, width)[:, :, 0]
        response[:, :, 1:] += np.einsum("pyn,knw->kypw", v.dC, states, optimize=True)
    if v.dH.any():
        response[:, :, 1:] += np.einsum("pyz,kzw->kypw", v.dH, z, optimize=True)
    error = (y - response[:, :, 0]) * used[:, None]
    response *= used[:, None, None]
    flat_error = error.transpose(1, 0, 2).reshape(n_y, -1)
    weighted = (root @ response.reshape(length, n_y, -1)).reshape(length, n_y, 1 + n_p, width)
    weighted_error = root @ error
    psi = np.ascontiguousarray(weighted[:, :, 1:].transpose(2, 0, 1, 3)).reshape(n_p, -1)
    by_row = free.reshape(length * n_y, n)
    psi_rows = weighted[:, :, 1:].reshape(length * n_y, n_p * width)
    mixed = (by_row.T @ psi_rows).reshape(n, n_p, width).transpose(2, 1, 0)
    start = np.broadcast_to(by_row.T @ by_row, (width, n, n)).copy()
    for block in np.flatnonzero(used[-1] == 0):
        rows = by_row[: n_y * int(used[:, block].sum())]
        start[block] = rows.T @ rows
    sums = _BlockSums(
        -psi @ weighted_error.reshape(-1),
        -(by_row.T @ weighted_error.reshape(length * n_y, width)).T,
        psi @ psi.T,
        mixed,
        start,
        flat_error @ flat_error.T,
        state[:, 1:].transpose(2, 0, 1),
    )
    return sums, state[:, 0]


def _link(blocks: Blocks, sums: _BlockSums, ends: FloatArray, transition: FloatArray) -> Sweep:
    """Join the blocks of each window: their starts follow from the window's start and the parameters."""
    n_p, n = sums.mixed.shape[1:]
    first, size = blocks.window_first, blocks.window_size
    n_windows = blocks.n_windows
    hessian, gradient = sums.hessian.copy(), sums.gradient.copy()
    mixed = np.zeros((n_windows, n_p, n))
    start = np.zeros((n_windows, n, n))
    gradient_start = np.zeros((n_windows, n))
    by_theta = np.zeros((n_windows, n, n_p))  # sensitivity of the current block's start
    by_start = np.broadcast_to(np.eye(n), (n_windows, n, n)).copy()
    for i in range(blocks.per_window):
        live = np.flatnonzero(size > i)
        b = first[live] + i
        S, P = by_theta[live], by_start[live]
        mixed_b, start_b, gradient_b = sums.mixed[b], sums.start[b], sums.gradient_start[b]
        if i > 0:
            cross = (mixed_b @ S).sum(0)
            hessian += cross + cross.T + (S.transpose(0, 2, 1) @ start_b @ S).sum(0)
            gradient += (S.transpose(0, 2, 1) @ gradient_b[:, :, None]).sum(0)[:, 0]
            mixed_b = mixed_b + S.transpose(0, 2, 1) @ start_b
        mixed[live] += mixed_b @ P
        start[live] += P.transpose(0, 2, 1) @ start_b @ P
        gradient_start[live] += (P.transpose(0, 2, 1) @ gradient_b[:, :, None])[:, :, 0]
        by_theta[live] = transition @ S + sums.end_theta[b]
        by_start[live] = transition @ P
    last = first + size - 1
    return Sweep(
        sums.products,
        gradient,
        gradient_start,
        hessian,
        mixed,
        start,
        np.ascontiguousarray(ends[:, last].T),
        by_theta,
        by_start,
    )
