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

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Protocol

import numpy as np

from gbid.core.arrays import FloatArray, IntArray
from gbid.identify.kernel.blocks import Adjoint, Blocks, BlockSums, PassEngine, Prediction, Second
from gbid.identify.predictor import PredictorValues

# ---- Pass over the samples in numpy: the portable engine, and the reference for the compiled one.

_AT_ONCE = 64  # blocks whose sensitivities run together
_CHUNK_BYTES = 32 * 2**20  # largest size of the sensitivities in memory


class NumpyEngine:
    """The pass in numpy; an `PassEngine`."""

    def __call__(
        self, v: PredictorValues, blocks: Blocks, starts: FloatArray, root: FloatArray, free: FloatArray
    ) -> BlockSums:
        """Run the recursion with numpy, some groups at a time; an `PassEngine`."""
        n, n_p = len(v.F), len(v.dF)
        z = blocks.z(v.shift)
        n_groups, length, _, lanes = z.shape
        per_group = 8 * length * n * (1 + n_p) * lanes
        step = max(1, _CHUNK_BYTES // per_group)
        parts = []
        for first in range(0, n_groups, step):
            part = slice(first, first + step)
            rows = slice(first * lanes, (first + step) * lanes)
            parts.append(
                _run(
                    v,
                    _flat(z[part]),
                    _flat(blocks.y[part]),
                    _flat(blocks.used[part, :, None])[:, 0],
                    blocks.size[rows],
                    starts[rows].T,
                    root,
                    free,
                )
            )
        joined = [np.concatenate([part[i] for part in parts]) for i in range(2, 7)]
        totals = [np.sum([part[i] for part in parts], axis=0) for i in range(2)]
        return BlockSums(*totals, *joined)

    def predict(self, v: PredictorValues, blocks: Blocks, starts: FloatArray) -> Prediction:
        """Run the state alone; see `PassEngine`."""
        z = blocks.z(v.shift)
        n_groups, length, _, lanes = z.shape
        states = np.empty((length + 1, n_groups, len(v.F), lanes))
        states[0] = starts.reshape(len(v.F), n_groups, lanes).transpose(1, 0, 2)
        forcing = (v.G @ z).transpose(1, 0, 2, 3)
        for k in range(length):
            np.matmul(v.F, states[k], out=states[k + 1])
            states[k + 1] += forcing[k]
        at = np.ascontiguousarray(states[:-1].transpose(1, 0, 2, 3))
        errors = (blocks.y - v.C @ at - v.H @ z) * blocks.used[:, :, None]
        return Prediction(at, errors, states[-1].transpose(1, 0, 2).reshape(len(v.F), -1))

    def products(self, v: PredictorValues, blocks: Blocks, starts: FloatArray) -> FloatArray:
        """Return the products of the errors of each block; see `PassEngine`."""
        return self.predict(v, blocks, starts).products

    def adjoint(
        self, v: PredictorValues, blocks: Blocks, weighted: FloatArray, states: FloatArray, last: FloatArray
    ) -> Adjoint:
        """Run the adjoint backwards; see `PassEngine`."""
        z = blocks.z(v.shift)
        n_groups, length, n, lanes = states.shape
        size = blocks.size.reshape(n_groups, 1, lanes)
        given = last.reshape(n, n_groups, lanes).transpose(1, 0, 2)
        drive = v.C.T @ weighted
        after = np.empty_like(states)
        a = np.zeros_like(given)
        for k in range(length - 1, -1, -1):
            a = np.where(size == k + 1, given, a)
            after[:, k] = a
            a = v.F.T @ a - drive[:, k]
        left, right = np.concatenate([after, -weighted], axis=2), np.concatenate([states, z], axis=2)
        sums = np.einsum("gkal,gkbl->ab", left, right, optimize=True)
        return Adjoint(a.transpose(1, 0, 2).reshape(n, -1), sums, left)

    def second(self, v: PredictorValues, blocks: Blocks, states: FloatArray, factors: FloatArray) -> Second:
        """Run the sensitivities of the states, some groups at a time; see `PassEngine`."""
        z, (n_p, n, _) = blocks.z(v.shift), v.dF.shape
        drive = np.concatenate([v.dF, v.dG], axis=2).reshape(n_p * n, -1)
        products, ends = np.zeros((factors.shape[2], n_p * n)), []
        step = max(1, _CHUNK_BYTES // (8 * blocks.length * n * n_p * blocks.lanes))
        for first in range(0, len(z), step):
            part = slice(first, first + step)
            forcing = drive @ _flat(np.concatenate([states[part], z[part]], axis=2))
            s = np.zeros(forcing.shape[1:])
            for own, driven in zip(_flat(factors[part]), forcing, strict=True):
                products += own @ s.T
                s = (v.F @ s.reshape(n_p, n, -1)).reshape(s.shape) + driven
            ends.append(s.reshape(n_p, n, -1).transpose(2, 1, 0))
        return Second(products.reshape(-1, n_p, n), np.concatenate(ends))

    def sensitivities(
        self, v: PredictorValues, blocks: Blocks, prediction: Prediction, first: FloatArray, own: slice
    ) -> FloatArray:
        """Return the sensitivities of some blocks, `_AT_ONCE` at a time; see `PassEngine`."""
        n, n_p, n_y, length = len(v.F), len(v.dF), len(v.C), blocks.length
        m, (count, *_) = n_p + n, first.shape
        psi = np.empty((n_y * m, count, length))
        onto_state, onto_output = np.zeros((n, m, n + v.G.shape[1])), np.zeros((n_y, m, n + v.G.shape[1]))
        onto_state[:, :n_p] = np.concatenate([v.dF, v.dG], axis=2).transpose(1, 0, 2)
        onto_output[:, :n_p] = np.concatenate([v.dC, v.dH], axis=2).transpose(1, 0, 2)
        for a in range(0, count, _AT_ONCE):
            some = slice(own.start + a, min(own.start + a + _AT_ONCE, own.stop))
            driving = np.concatenate(
                [blocks.side_by_side(prediction.states, some), blocks.side_by_side(blocks.z(v.shift), some)], axis=1
            )
            history = np.empty((length + 1, n, m, some.stop - some.start))
            history[0] = first[a : a + _AT_ONCE].transpose(1, 2, 0)
            np.matmul(onto_state.reshape(n * m, -1), driving, out=history[1:].reshape(length, n * m, -1))
            flat = history.reshape(length + 1, n, -1)
            for k in range(length):
                flat[k + 1] += v.F @ flat[k]
            rows = (v.C @ flat[:-1]).reshape(length, n_y * m, -1)
            if onto_output.any():
                rows += onto_output.reshape(n_y * m, -1) @ driving
            rows *= blocks.side_by_side(blocks.used[:, :, None], some)
            psi[:, a : a + _AT_ONCE] = rows.transpose(1, 2, 0)
        return psi


run_with_numpy = NumpyEngine()


def _flat(values: FloatArray) -> FloatArray:
    """Return groups side by side: (n_groups, length, n, lanes) to (length, n, n_groups * lanes)."""
    return np.ascontiguousarray(values.transpose(1, 2, 0, 3)).reshape(values.shape[1], values.shape[2], -1)


def _run(
    v: PredictorValues,
    z: FloatArray,
    y: FloatArray,
    used: FloatArray,
    size: IntArray,
    x0: FloatArray,
    root: FloatArray,
    free: FloatArray,
) -> BlockSums:
    """Run W blocks in parallel, their samples in the last axis, and return the sums."""
    n, n_p, n_y = len(v.F), len(v.dF), len(v.C)
    length, _, width = z.shape
    # Column 0 of the joined state is x, column 1 + i is s_i; the drive of x comes from z alone.
    drive_x = np.concatenate([np.zeros((1, n, n)), v.dF]).transpose(1, 0, 2).reshape(n * (1 + n_p), n)
    drive_z = np.concatenate([v.G[None], v.dG]).transpose(1, 0, 2).reshape(n * (1 + n_p), -1)
    drive = np.hstack([drive_x, drive_z])
    history = np.empty((length + 1, n, (1 + n_p) * width))
    state = np.zeros((n, 1 + n_p, width))
    state[:, 0] = x0
    history[0] = state.reshape(n, -1)
    joined = np.empty((n + z.shape[1], width))
    for k in range(length):
        joined[:n], joined[n:] = history[k, :, :width], z[k]
        np.matmul(v.F, history[k], out=history[k + 1])
        history[k + 1] += (drive @ joined).reshape(n, -1)
    response = (v.C @ history[:-1]).reshape(length, n_y, 1 + n_p, width)
    response[:, :, 0] += v.H @ z
    if v.dC.any():
        response[:, :, 1:] += np.einsum("pyn,knw->kypw", v.dC, history[:-1, :, :width], optimize=True)
    if v.dH.any():
        response[:, :, 1:] += np.einsum("pyz,kzw->kypw", v.dH, z, optimize=True)
    error = (y - response[:, :, 0]) * used[:, None]
    psi = np.ascontiguousarray(response[:, :, 1:]) * used[:, None, None]
    psi = (root @ psi.reshape(length, n_y, -1)).reshape(length * n_y, n_p, width)
    weighted_error = (root @ error).reshape(length * n_y, width)
    psi_twice = (psi.reshape(length, n_y, n_p, width) * used[:, None, None]).reshape(length * n_y, -1)
    error_twice = (weighted_error.reshape(length, n_y, width) * used[:, None]).reshape(length * n_y, width)
    by_row = free.reshape(length * n_y, n)
    by_parameter = np.ascontiguousarray(psi.transpose(1, 0, 2)).reshape(n_p, -1)
    flat_error = error.transpose(1, 0, 2).reshape(n_y, -1)
    ends = history[size, :, :].reshape(width, n, 1 + n_p, width)[np.arange(width), :, :, np.arange(width)]
    return BlockSums(
        by_parameter @ by_parameter.T,
        flat_error @ flat_error.T,
        -np.einsum("kpw,kw->wp", psi, weighted_error),
        -(by_row.T @ error_twice).T,
        (by_row.T @ psi_twice).reshape(n, n_p, width).transpose(2, 1, 0),
        ends[:, :, 0],
        ends[:, :, 1:],
    )


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


# ---- Growth of small deviations of the state: of a constant transition, or along a trajectory.

_TENFOLD = 10.0  # growth that counts
_TINY = float(np.finfo(float).tiny)


def spectral_radius(values: list[PredictorValues]) -> float:
    """Largest magnitude of the predictors' eigenvalues; infinite where they overflow."""
    transitions = [v.F for v in values]
    if not all(np.isfinite(F).all() for F in transitions):
        return np.inf
    return max(float(np.abs(np.linalg.eigvals(F)).max()) for F in transitions)


def growth_along(transitions: FloatArray, samples: int) -> float:
    """Return the growth of a small deviation in a sample, along a trajectory.

    It is that over the second half of the trajectory: a deviation that grows like time, as the phase of an oscillator
    does, is not unstable. Less than a tenfold growth counts as none.

    Parameters
    ----------
    transitions : (n_windows, n, n) array
        Derivatives of the end of each window by its start, for states of the order of one.
    samples : int
        Number of samples in all windows.
    """
    if not np.isfinite(transitions).all():
        return np.inf
    half = len(transitions) // 2
    (first, _), (second, after) = (_product(steps) for steps in (transitions[:half], transitions[half:]))
    there, here = (max(float(np.linalg.norm(product)), _TINY) for product in (second @ first, first))
    growth = float(np.log(there)) + after - (float(np.log(here)) if half else 0.0)
    growth *= len(transitions) / (len(transitions) - half)
    return float(np.exp((growth if growth > np.log(_TENFOLD) else min(growth, 0.0)) / samples))


def _product(steps: FloatArray) -> tuple[FloatArray, float]:
    """Return the product of all steps, the last on the left, and the logarithm of the factor that is left out.

    Neighbours are multiplied with one another, then their products, so that few calls do all.
    """
    log = 0.0
    while len(steps) > 1:
        last = steps[len(steps) // 2 * 2 :]
        steps = np.concatenate([steps[1::2] @ steps[: len(steps) // 2 * 2 : 2], last])
        size = np.maximum(np.sqrt(np.einsum("kij,kij->k", steps, steps)), _TINY)
        steps, log = steps / size[:, None, None], log + float(np.log(size).sum())
    return (steps[0], log) if len(steps) else (np.eye(steps.shape[1]), log)


# ---- Protocol of a kernel: what a fit asks of the recursion of a group of records, linear or nonlinear.


class Traced(NamedTuple):
    """Pass over segments, with what happens within the windows.

    Attributes
    ----------
    begin : (n, W) array
        State at the start of each block.
    sums : Sweep
        Sums over the blocks of each window.
    linked : Linked
        Sensitivities of the starts of the blocks.
    by_block : BlockSums
        Sums of each block.
    """

    begin: FloatArray
    sums: Sweep
    linked: Linked
    by_block: BlockSums


class Moved(NamedTuple):
    """Predictor with one parameter moved.

    Attributes
    ----------
    column : int
        Position of the parameter among those of the predictor.
    step : float
        How far it is moved.
    v : object
        What the ``at`` of the predictor returns there.
    """

    column: int
    step: float
    v: Any


class Kernel(Protocol):
    """Kernel of one kind of predictor. In all methods, `v` is what the ``at`` of the predictor returns.

    `starts` are the states at the starts of the windows, (n_windows, n).
    """

    def sweep(self, v: Any, blocks: Blocks, starts: FloatArray, weight: FloatArray) -> Sweep:
        """Return cost, gradient, Gauss-Newton Hessian and ends of windows of ``sum e' W e / 2``."""
        ...

    def trace(self, v: Any, blocks: Blocks, starts: FloatArray, weights: Sequence[FloatArray]) -> list[Traced]:
        """Return the same with the sums of each block, for each weight."""
        ...

    def begin(self, v: Any, blocks: Blocks, starts: FloatArray) -> FloatArray:
        """Return the state at the start of each block, (n, W)."""
        ...

    def predict(self, v: Any, blocks: Blocks, starts: FloatArray) -> Prediction:
        """Return states and errors, without sensitivities."""
        ...

    def passed(self, v: Any, blocks: Blocks, begin: FloatArray) -> Prediction:
        """Return the same from the state at the start of each block, (n, W)."""
        ...

    def products(self, v: Any, blocks: Blocks, starts: FloatArray) -> FloatArray:
        """Return the products ``sum e e'`` of the errors of each block, (W, n_y, n_y)."""
        ...

    def gradient(
        self, v: Any, blocks: Blocks, starts: FloatArray, ends: FloatArray, weight: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return the gradient of ``sum e' W e / 2`` plus the ends of windows times `ends`, (n_windows, n).

        Returns
        -------
        (n_p,) array
            By the own parameters of the predictor.
        (n_windows, n) array
            By the starts of the windows.
        """
        ...

    def left_out(
        self,
        v: Any,
        blocks: Blocks,
        starts: FloatArray,
        ends: FloatArray,
        weight: FloatArray,
        moved: Sequence[Moved],
    ) -> tuple[FloatArray, FloatArray]:
        """Return the second derivatives of the same that Gauss-Newton omits, in the columns of the moved parameters.

        Returns
        -------
        (n_p, n_p) array
            By two of the own parameters of the predictor; zero in other columns.
        (n_windows, n_p, n) array
            By a parameter and the start of a window.
        """
        ...

    def growth(self, v: Any, blocks: Blocks, sweep: Sweep | None, state_scale: FloatArray) -> float:
        """Return the growth of a small deviation in a sample; infinite where the predictor overflows.

        `sweep` is the pass, None where it overflows; a linear predictor needs none. States are of the order of
        `state_scale`.
        """
        ...

    def feedback(self, v: Any, blocks: Blocks, prediction: Prediction) -> PredictorValues:
        """Return a linear predictor whose last regressors are the measured outputs, (n_y)."""
        ...

    def sensitivities(self, v: Any, blocks: Blocks, prediction: Prediction, linked: Linked, own: slice) -> FloatArray:
        """Return sensitivities of the predictions by the parameters and the start of the window, for some blocks.

        Returns
        -------
        (n_y * (n_p + n), n_blocks, length) array
            Zero where samples do not count.
        """
        ...
