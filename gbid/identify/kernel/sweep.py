"""One pass over the samples: cost, gradient, Gauss-Newton Hessian and end states of each window.

The predictor is linear in the state, so the pass is a recursion over ``x`` and its parameter sensitivities
``s_i = dx / dtheta_i``:

    x[k+1] = F x[k] + G z[k],     s_i[k+1] = F s_i[k] + (dF_i x[k] + dG_i z[k]),
    yhat[k] = C x[k] + H z[k],    psi_i[k] = C s_i[k] + dC_i x[k] + dH_i z[k],

for all blocks in parallel, each from its own start. The free response to a start is ``F^k``, the same for all blocks.
Windows of several blocks are linked afterwards. The link is exact: it uses the sensitivity of each inner start to the
parameters and to the start of the window. Single shooting is the case of one window, and has the same cost as
multiple shooting.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from gbid.arrays import FloatArray
from gbid.identify.kernel.block_sums import BlockSums, PassEngine, Prediction
from gbid.identify.kernel.blocks import Blocks
from gbid.identify.kernel.numpy_pass import run_with_numpy
from gbid.identify.predictor import PredictorValues


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


def scan(transition: FloatArray, values: FloatArray) -> FloatArray:
    """Solve ``x[i] = transition x[i-1] + values[i]`` in place along axis 2 of (n, n_windows, steps, m), by doubling."""
    n, _, steps, _ = values.shape
    reach = 1
    while reach < steps:
        carried = transition @ values[:, :, :-reach].reshape(n, -1)
        values[:, :, reach:] += carried.reshape(values[:, :, reach:].shape)
        transition = transition @ transition
        reach *= 2
    return values


def along_windows(blocks: Blocks, starts: FloatArray, ends: FloatArray, transition: FloatArray) -> FloatArray:
    """Value at the start of every block, (n, W, m): that of its window, or what the block before makes of its own.

    Inner blocks of a window are of full length, so one `transition` serves all; `starts` (n, n_windows, m) are those
    of the windows, `ends` (n, W, m) what comes to it in each block.
    """
    blocks_of, inside = blocks.by_window
    result = np.zeros(ends.shape)
    values = np.concatenate([starts[:, :, None], ends[:, blocks_of[:, :-1]]], axis=2)
    result[:, blocks_of[inside]] = scan(transition, values)[:, inside]
    return result


def block_starts(blocks: Blocks, starts: FloatArray, ends: FloatArray, transition: FloatArray) -> FloatArray:
    """Return the start state of each block, (n, W), from starts of windows (n_windows, n) and forced ends (n, W)."""
    return along_windows(blocks, starts.T[:, :, None], ends[:, :, None], transition)[:, :, 0]


def from_starts(v: PredictorValues, blocks: Blocks, starts: FloatArray, engine: PassEngine | None = None) -> Prediction:
    """Return states and errors from the starts of the windows (n_windows, n)."""
    run = engine or run_with_numpy
    return run.predict(v, blocks, starts_of_blocks(v, blocks, starts, powers_of(v.F, blocks.length)[-1], run))


def residuals(v: PredictorValues, blocks: Blocks, starts: FloatArray, engine: PassEngine | None = None) -> FloatArray:
    """Return prediction errors ``y - yhat``, (n_groups, length, n_y, lanes), zero where samples do not count."""
    return from_starts(v, blocks, starts, engine).errors


def starts_of_blocks(
    v: PredictorValues, blocks: Blocks, starts: FloatArray, transition: FloatArray, run: PassEngine
) -> FloatArray:
    """Return the state at the start of each block, (n, W), from the starts of the windows (n_windows, n)."""
    at_rest = np.zeros((len(v.F), len(blocks.size)))
    if blocks.per_window > 1:
        return block_starts(blocks, starts, run.predict(v, blocks, at_rest).end, transition)
    at_rest[:, : blocks.n_windows] = starts.T
    return at_rest


def sweep(
    v: PredictorValues, blocks: Blocks, starts: FloatArray, weight: FloatArray, engine: PassEngine | None = None
) -> Sweep:
    """Run the pass.

    Parameters
    ----------
    v : PredictorValues
    blocks : Blocks
    starts : (n_windows, n) array
        State at the start of each window.
    weight : (n_y, n_y) array
        ``W``, positive definite.
    engine : PassEngine, optional
        Runs the recursion; numpy when not given.

    Returns
    -------
    Sweep
    """
    powers, run = powers_of(v.F, blocks.length), engine or run_with_numpy
    begin = starts_of_blocks(v, blocks, starts, powers[-1], run)
    sums, free = block_sums(v, blocks, begin, weight, powers, run)
    return joined(blocks, sums, start_hessians(blocks, free), link(blocks, sums.end_theta, powers))


def block_sums(
    v: PredictorValues,
    blocks: Blocks,
    begin: FloatArray,
    weight: FloatArray,
    powers: FloatArray,
    run: PassEngine,
) -> tuple[BlockSums, FloatArray]:
    """Run the engine over all blocks from where they begin; also return the weighted response to a start.

    `begin` is (n, W); the response is (length, n_y, n).
    """
    root = np.linalg.cholesky(weight).T  # W = root' root
    free = np.ascontiguousarray(root @ v.C @ powers[:-1])
    return run(v, blocks, np.ascontiguousarray(begin.T), np.ascontiguousarray(root), free), free


def start_hessians(blocks: Blocks, free: FloatArray) -> FloatArray:
    """Hessian with respect to each block's start, (W, n, n): one matrix for all blocks whose samples all count."""
    n = free.shape[2]
    rows = free.reshape(-1, n)
    full = np.broadcast_to(rows.T @ rows, (len(blocks.size), n, n)).copy()
    used = blocks.used.transpose(0, 2, 1).reshape(-1, blocks.length)
    for block in np.flatnonzero((used != 1).any(axis=1)):
        rows = (free * used[block][:, None, None]).reshape(-1, n)
        full[block] = rows.T @ rows
    return full


class Linked(NamedTuple):
    """Sensitivities of every block's start within its window.

    Attributes
    ----------
    by_theta : (W, n, n_p) array
    by_start : (W, n, n) array
        With respect to the start of the window.
    end_theta : (n_windows, n, n_p) array
    end_start : (n_windows, n, n) array
        Of the end of each window.
    """

    by_theta: FloatArray
    by_start: FloatArray
    end_theta: FloatArray
    end_start: FloatArray


def link(blocks: Blocks, end_theta: FloatArray, powers: FloatArray) -> Linked:
    """Follow each window through its blocks: a block's start is the end of the block before."""
    n_blocks, n, n_p = end_theta.shape
    first, size = blocks.window_first, blocks.window_size
    if blocks.per_window > 1:
        starts, ends = np.zeros((n, blocks.n_windows, n_p + n)), np.zeros((n, n_blocks, n_p + n))
        starts[:, :, n_p:] = np.eye(n)[:, None]
        ends[:, :, :n_p] = end_theta.transpose(1, 0, 2)
        both = along_windows(blocks, starts, ends, powers[-1]).transpose(1, 0, 2)
        by_theta, by_start = np.ascontiguousarray(both[:, :, :n_p]), np.ascontiguousarray(both[:, :, n_p:])
    else:
        by_theta = np.zeros((n_blocks, n, n_p))
        by_start = np.broadcast_to(np.eye(n), (n_blocks, n, n))
    last = first + size - 1
    transition = powers[blocks.size[last]]
    return Linked(by_theta, by_start, transition @ by_theta[last] + end_theta[last], transition @ by_start[last])


def joined(blocks: Blocks, sums: BlockSums, start_hessian: FloatArray, linked: Linked) -> Sweep:
    """Return the sums over the blocks of each window."""
    first, live = blocks.window_first, slice(0, blocks.n_blocks)
    S, P = linked.by_theta[live], linked.by_start[live]
    mixed, start, gradient_start = sums.mixed[live], start_hessian[live], sums.gradient_start[live]
    hessian, gradient = sums.hessian, sums.gradient.sum(0)
    if blocks.per_window > 1:
        S_t = S.transpose(0, 2, 1)
        cross = np.tensordot(mixed, S, ([0, 2], [0, 1]))
        hessian = hessian + cross + cross.T + np.tensordot(S, start @ S, ([0, 1], [0, 1]))
        gradient = gradient + np.einsum("wnp,wn->p", S, gradient_start)
        P_t = P.transpose(0, 2, 1)
        mixed = np.add.reduceat((mixed + S_t @ start) @ P, first)
        start = np.add.reduceat(P_t @ start @ P, first)
        gradient_start = np.add.reduceat((P_t @ gradient_start[:, :, None])[:, :, 0], first)
    end = sums.end[first + blocks.window_size - 1]
    return Sweep(
        sums.products, gradient, gradient_start, hessian, mixed, start, end, linked.end_theta, linked.end_start
    )


def tied(own: Sweep, tie: FloatArray | None) -> Sweep:
    """Refer derivatives by a predictor's own parameters to the parameters that they are tied to.

    `tie` is (n_own, n_p), ``own = tie @ theta``; without it they are the same.
    """
    if tie is None:
        return own
    return replace(
        own,
        gradient=tie.T @ own.gradient,
        hessian=tie.T @ own.hessian @ tie,
        hessian_mixed=tie.T @ own.hessian_mixed,
        end_theta=own.end_theta @ tie,
    )
