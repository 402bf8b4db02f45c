"""Sums over the samples: cost, gradient, Gauss-Newton Hessian and window ends; protocol of a kernel.

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

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, NamedTuple

import numpy as np

from gbid.core.arrays import FloatArray
from gbid.identify.kernel.blocks import Blocks, BlockSums, Prediction
from gbid.identify.options import RunEngine
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
    n = len(F)
    powers = np.empty((count + 1, n, n))
    powers[0] = np.eye(n)
    rows, have, step = powers.reshape(-1, n), 1, F
    while have <= count:
        take = min(have, count + 1 - have)
        np.matmul(rows[: take * n], step, out=rows[have * n : (have + take) * n])
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


_IN_CACHE = 32_768  # values of windows that are linked together


def along_windows(blocks: Blocks, starts: FloatArray, ends: FloatArray, transition: FloatArray) -> FloatArray:
    """Return the state at the start of each block, (n, W, m): the window's start, else the previous block's end.

    Inner blocks of a window are of full length, so one `transition` serves all. `starts` are the values at the starts
    of the windows, (n, n_windows, m). `ends` is what each block adds from its start to its end, (n, W, m).
    """
    blocks_of, inside = blocks.by_window
    result = np.zeros(ends.shape)
    count = max(1, _IN_CACHE // max(1, starts[:, 0].size * blocks.per_window))
    for some in (slice(first, first + count) for first in range(0, len(inside), count)):
        values = np.concatenate([starts[:, some, None], ends[:, blocks_of[some, :-1]]], axis=2)
        result[:, blocks_of[some][inside[some]]] = scan(transition, values)[:, inside[some]]
    return result


def start_hessians(blocks: Blocks, free: FloatArray) -> FloatArray:
    """Return Hessians with respect to block starts, (W, n, n), from weighted free responses (length, n_y, n).

    It is the same matrix for all blocks whose samples all count.
    """
    n = free.shape[2]
    rows = free.reshape(-1, n)
    full = np.broadcast_to(rows.T @ rows, (len(blocks.size), n, n)).copy()
    for block in blocks.uneven:
        used = blocks.used[block // blocks.lanes, :, block % blocks.lanes]
        rows = (free * used[:, None, None]).reshape(-1, n)
        full[block] = rows.T @ rows
    return full


class Linked(NamedTuple):
    """Sensitivities of the start of each block within its window.

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
    """Return the sensitivities of block starts, for blocks with one transition matrix; `powers` are its powers."""
    n_blocks, n, n_p = end_theta.shape
    last = blocks.window_first + blocks.window_size - 1
    ends_theta, transition = end_theta[last], powers[blocks.size[last]]
    if blocks.per_window == 1:
        by_start = np.broadcast_to(np.eye(n), (n_blocks, n, n))
        return Linked(np.zeros((n_blocks, n, n_p)), by_start, ends_theta, transition)
    starts, ends = np.zeros((n, blocks.n_windows, n_p + n)), np.zeros((n, n_blocks, n_p + n))
    starts[:, :, n_p:] = np.eye(n)[:, None]
    ends[:, :, :n_p] = end_theta.transpose(1, 0, 2)
    both = along_windows(blocks, starts, ends, powers[-1]).transpose(1, 0, 2)
    by_theta, by_start = np.ascontiguousarray(both[:, :, :n_p]), np.ascontiguousarray(both[:, :, n_p:])
    return Linked(by_theta, by_start, transition @ by_theta[last] + ends_theta, transition @ by_start[last])


def joined(blocks: Blocks, sums: BlockSums, start_hessian: FloatArray, linked: Linked) -> Sweep:
    """Return the sums of each window, added over its blocks."""
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


def tied(sweep: Sweep, tie: FloatArray | None) -> Sweep:
    """Return sums with respect to the unknowns of a problem: parameters of the predictor are ``tie @ theta``.

    Without a matrix `tie`, (n_own, n_p), both are the same.
    """
    if tie is None:
        return sweep
    return replace(
        sweep,
        gradient=tie.T @ sweep.gradient,
        hessian=tie.T @ sweep.hessian @ tie,
        hessian_mixed=tie.T @ sweep.hessian_mixed,
        end_theta=sweep.end_theta @ tie,
    )


_TENFOLD = 10.0  # growth that counts
_TINY = float(np.finfo(float).tiny)


def spectral_radius(v: PredictorValues) -> float:
    """Return the spectral radius of a predictor's transition; infinite where the predictor overflows."""
    return float(np.abs(np.linalg.eigvals(v.F)).max()) if np.isfinite(v.F).all() else np.inf


def growth_along(transitions: FloatArray, samples: int) -> float:
    """Return the mean growth per sample of a small deviation along a trajectory.

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
    size_last, size_half = (max(float(np.linalg.norm(product)), _TINY) for product in (second @ first, first))
    growth = float(np.log(size_last)) + after - (float(np.log(size_half)) if half else 0.0)
    growth *= len(transitions) / (len(transitions) - half)
    return float(np.exp((growth if growth > np.log(_TENFOLD) else min(growth, 0.0)) / samples))


def _product(steps: FloatArray) -> tuple[FloatArray, float]:
    """Return the product of all step matrices (last one on the left), scaled, and the logarithm of the scale.

    Neighbours are multiplied with one another, then their products, so that few calls do all.
    """
    log = 0.0
    while len(steps) > 1:
        last = steps[len(steps) // 2 * 2 :]
        steps = np.concatenate([steps[1::2] @ steps[: len(steps) // 2 * 2 : 2], last])
        size = np.maximum(np.sqrt(np.einsum("kij,kij->k", steps, steps)), _TINY)
        steps, log = steps / size[:, None, None], log + float(np.log(size).sum())
    return (steps[0], log) if len(steps) else (np.eye(steps.shape[1]), log)


# ---- Kernels: protocol of the passes over the samples of a group of records.


class Traced(NamedTuple):
    """Sums of a pass by window and by block, with the sensitivities of block starts.

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
    """Predictor with a finite-difference step in one parameter.

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


class Lagrangian(NamedTuple):
    """Lagrangian at a point: ``sum e' W e / 2`` plus multipliers times the states at window ends.

    Attributes
    ----------
    starts : (n_windows, n) array
        States at the starts of the windows.
    ends : (n_windows, n) array
        Multipliers of the states at their ends.
    weight : (n_y, n_y) array
        Constant weight W of the errors; with it, parts of a problem do not depend on each other.
    """

    starts: FloatArray
    ends: FloatArray
    weight: FloatArray


class Kernel(ABC):
    """Protocol of a kernel. In all methods, `v` is the result of the predictor's method ``at``.

    `starts` are the states at the starts of the windows, (n_windows, n); `begin` are those at the starts of all W
    blocks, (n, W).

    Attributes
    ----------
    engine : {"compiled", "numpy"}
        What runs the passes.
    """

    engine: ClassVar[RunEngine]

    @abstractmethod
    def trace(self, v: Any, blocks: Blocks, starts: FloatArray, weights: Sequence[FloatArray]) -> list[Traced]:
        """Return the sums of a pass with sensitivities, by window and by block, for each weight."""

    def sweep(self, v: Any, blocks: Blocks, starts: FloatArray, weight: FloatArray) -> Sweep:
        """Return cost ``sum e' W e / 2``, gradient, Gauss-Newton Hessian and states at window ends."""
        return self.trace(v, blocks, starts, [weight])[0].sums

    @abstractmethod
    def begin(self, v: Any, blocks: Blocks, starts: FloatArray) -> FloatArray:
        """Return the state at the start of each block, (n, W)."""

    @abstractmethod
    def passed(self, v: Any, blocks: Blocks, begin: FloatArray) -> Prediction:
        """Return states and errors from the states at block starts, without sensitivities."""

    def ends(self, v: Any, blocks: Blocks, begin: FloatArray) -> FloatArray:
        """Return the state after the full length of each block, (n, W), from the states at block starts."""
        return self.passed(v, blocks, begin).end

    def predict(self, v: Any, blocks: Blocks, starts: FloatArray) -> Prediction:
        """Return states and errors from the states at window starts, without sensitivities."""
        return self.passed(v, blocks, self.begin(v, blocks, starts))

    def errors(self, v: Any, blocks: Blocks, starts: FloatArray) -> FloatArray:
        """Return the prediction errors from the states at window starts, (n_groups, length, n_y, lanes)."""
        return self.predict(v, blocks, starts).errors

    def products(self, v: Any, blocks: Blocks, starts: FloatArray) -> FloatArray:
        """Return the products ``sum e e'`` of the errors of each block, (W, n_y, n_y)."""
        return self.predict(v, blocks, starts).products

    @abstractmethod
    def gradient(self, v: Any, blocks: Blocks, at: Lagrangian) -> tuple[FloatArray, FloatArray]:
        """Return the gradient of a Lagrangian.

        Returns
        -------
        (n_p,) array
            By the parameters of the predictor.
        (n_windows, n) array
            By the starts of the windows.
        """

    @abstractmethod
    def left_out(self, v: Any, blocks: Blocks, at: Lagrangian, moved: Sequence[Moved]) -> tuple[FloatArray, FloatArray]:
        """Return the second-order term of a Lagrangian's Hessian (neglected by Gauss-Newton), for moved parameters.

        Returns
        -------
        (n_p, n_p) array
            By two parameters of the predictor; zero in other columns.
        (n_windows, n_p, n) array
            By a parameter and the start of a window.
        """

    @abstractmethod
    def growth(self, v: Any, blocks: Blocks, sweep: Sweep | None, state_scale: FloatArray) -> float:
        """Return the growth of a small deviation per sample; infinite where the predictor overflows.

        `sweep` is a pass; a linear predictor needs none, a nonlinear one has NaN without it. States are of the order of
        `state_scale`.
        """

    @abstractmethod
    def feedback(self, v: Any, blocks: Blocks, prediction: Prediction) -> PredictorValues:
        """Return a linear predictor whose last regressors are the measured outputs, (n_y)."""

    @abstractmethod
    def sensitivities(self, v: Any, blocks: Blocks, prediction: Prediction, linked: Linked, some: slice) -> FloatArray:
        """Return sensitivities of predictions to parameters and window start, for some blocks.

        Returns
        -------
        (n_y * (n_p + n), n_blocks, length) array
            Zero where samples do not count.
        """


class KernelOfLinear(Kernel):
    """Methods of a linear predictor's kernel that need no pass."""

    def growth(
        self,
        v: PredictorValues,
        blocks: Blocks,  # noqa: ARG002
        sweep: Sweep | None,  # noqa: ARG002
        state_scale: FloatArray,  # noqa: ARG002
    ) -> float:
        """Return the spectral radius; see `Kernel`."""
        return spectral_radius(v)

    def feedback(
        self,
        v: PredictorValues,
        blocks: Blocks,  # noqa: ARG002
        prediction: Prediction,  # noqa: ARG002
    ) -> PredictorValues:
        """Return the predictor itself; see `Kernel`."""
        return v


# ---- Kernels that run all blocks sample by sample, with sensitivities to the start of each block.

_AT_ONCE = 64  # blocks whose sensitivities are made together


class SampleSums(NamedTuple):
    """Results of a pass with sensitivities, for each block.

    Attributes
    ----------
    by_block : BlockSums
        Sums over all blocks and values of each block.
    start_hessian : (W, n, n) array
        Gauss-Newton Hessian by the start of each block.
    end_start : (W, n, n) array
        Derivative of the end of each block by its start.
    """

    by_block: BlockSums
    start_hessian: FloatArray
    end_start: FloatArray


def linked_along(blocks: Blocks, end_theta: FloatArray, end_start: FloatArray) -> Linked:
    """Return the sensitivities of block starts, for blocks with different transitions.

    Parameters
    ----------
    blocks : Blocks
        The blocks.
    end_theta : (W, n, n_p) array
        Derivatives of the end of each block by the parameters.
    end_start : (W, n, n) array
        By its start.
    """
    n, n_p = end_theta.shape[1:]
    if blocks.per_window == 1:
        windows = slice(blocks.n_windows)
        by_start = np.zeros((len(end_theta), n, n))
        by_start[windows] = np.eye(n)
        return Linked(np.zeros_like(end_theta), by_start, end_theta[windows], end_start[windows])
    both = np.zeros((len(end_theta), n, n_p + n))
    both[blocks.window_first, :, n_p:] = np.eye(n)
    ends = np.zeros((blocks.n_windows, n, n_p + n))
    for i in range(blocks.per_window):
        if blocks.n_windows == 1:  # views are a third of the time of copies
            np.matmul(end_start[i], both[i], out=ends[0])
            ends[0, :, :n_p] += end_theta[i]
            both[i + 1 : blocks.per_window][:1] = ends
            continue
        live = np.flatnonzero(blocks.window_size > i)
        at = blocks.window_first[live] + i
        ends[live] = end_start[at] @ both[at]
        ends[live, :, :n_p] += end_theta[at]
        more = blocks.window_size[live] > i + 1
        both[at[more] + 1] = ends[live[more]]
    return Linked(both[:, :, :n_p], both[:, :, n_p:], ends[:, :, :n_p], ends[:, :, n_p:])


def by_segments(blocks: Blocks, passes: Sequence[Sweep]) -> list[Sweep]:
    """Return the sums over the windows of each segment, from passes over gap-free windows at one point."""
    size = np.diff(np.append(blocks.segment_first, blocks.n_windows))
    every = np.arange(len(size))
    windows = replace(
        blocks, per_window=int(size.max()), window_first=blocks.segment_first, window_size=size, segment_first=every
    )
    linked = linked_along(windows, passes[0].end_theta, passes[0].end_start)
    none = linked.by_theta[:0]
    sums = (
        BlockSums(s.hessian, s.error_products, s.gradient[None], s.gradient_start, s.hessian_mixed, s.end, none)
        for s in passes
    )
    return [joined(windows, each, s.hessian_start, linked) for each, s in zip(sums, passes, strict=True)]


def _gradient(s: Sweep, ends: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the gradient of a Lagrangian; multipliers of window ends are (n_windows, n)."""
    by_theta, by_start = (np.einsum("wn,wnm->wm", ends, each) for each in (s.end_theta, s.end_start))
    return s.gradient + by_theta.sum(axis=0), s.gradient_start + by_start


class SampleKernel(Kernel):
    """Kernel based on functions of one sample; a `Kernel`.

    A block begins where the model passes by, so that windows of several blocks are exact as well. Each block has a
    transition of its own.
    """

    def trace(self, v: Any, blocks: Blocks, starts: FloatArray, weights: Sequence[FloatArray]) -> list[Traced]:
        """Return the sums of each block for each weight; see `Kernel`."""
        return self.trace_from(v, blocks, self.begin(v, blocks, starts), weights)

    def trace_from(self, v: Any, blocks: Blocks, begin: FloatArray, weights: Sequence[FloatArray]) -> list[Traced]:
        """Return the sums of each block for each weight, from the states at block starts (n, W)."""
        passes = []
        for weight in weights:
            root = np.ascontiguousarray(np.linalg.cholesky(weight).T)
            by_block, start_hessian, end_start = self.sample_sums(v, blocks, begin, root)
            linked = linked_along(blocks, by_block.end_theta, end_start)
            passes.append(Traced(begin, joined(blocks, by_block, start_hessian, linked), linked, by_block))
        return passes

    def begins(self, points: Sequence[Any], blocks: Blocks, starts: FloatArray) -> list[FloatArray]:
        """Return the states at the starts of blocks, (n, W), for predictors at several points."""
        return [self.begin(v, blocks, starts) for v in points]

    def gradient(self, v: Any, blocks: Blocks, at: Lagrangian) -> tuple[FloatArray, FloatArray]:
        """Return the gradient from a pass with sensitivities; see `Kernel`."""
        return _gradient(self.sweep(v, blocks, at.starts, at.weight), at.ends)

    def left_out(self, v: Any, blocks: Blocks, at: Lagrangian, moved: Sequence[Moved]) -> tuple[FloatArray, FloatArray]:
        """Return the second-order term by finite differences of the gradient; see `Kernel`."""
        points = [v, *(each.v for each in moved)]
        first, *after = (
            self.trace_from(point, blocks, begin, [at.weight])[0].sums
            for point, begin in zip(points, self.begins(points, blocks, at.starts), strict=True)
        )
        before, theta, mixed = (
            _gradient(first, at.ends),
            np.zeros_like(first.hessian),
            np.zeros_like(first.hessian_mixed),
        )
        for (j, step, _), (by_theta, by_start) in zip(moved, (_gradient(s, at.ends) for s in after), strict=True):
            theta[:, j] = (by_theta - before[0]) / step - first.hessian[:, j]
            mixed[:, j] = (by_start - before[1]) / step - first.hessian_mixed[:, j]
        return theta, mixed

    @abstractmethod
    def onwards(self, v: Any, x: FloatArray, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the next states (width, n) and the outputs (width, n_y) of many blocks side by side."""

    @abstractmethod
    def with_slopes(
        self, v: Any, x: FloatArray, z: FloatArray, slopes: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return the next states, their derivatives (width, n, m), the outputs, and their derivatives (width, n_y, m).

        `slopes` are the derivatives of the states `x`, (width, n, m), by the parameters and then by other unknowns.
        """

    @abstractmethod
    def sample_sums(self, v: Any, blocks: Blocks, begin: FloatArray, root: FloatArray) -> SampleSums:
        """Return the sums of a pass with sensitivities, for the weight ``root' root``."""

    @abstractmethod
    def slopes(self, v: Any, blocks: Blocks, prediction: Prediction, first: FloatArray, some: slice) -> FloatArray:
        """Return the sensitivities of the predictions of some blocks, (length, n_y, m, n_blocks).

        `first` are those of the starts of these blocks, (n_blocks, n, m).
        """

    def sensitivities(self, v: Any, blocks: Blocks, prediction: Prediction, linked: Linked, some: slice) -> FloatArray:
        """Return the sensitivities of some blocks, in small batches; see `Kernel`."""
        n_y, m = blocks.y.shape[2], linked.by_theta.shape[2] + linked.by_start.shape[2]
        every = np.empty((n_y * m, some.stop - some.start, blocks.length))
        for begin in range(some.start, some.stop, _AT_ONCE):
            few = slice(begin, min(begin + _AT_ONCE, some.stop))
            first = np.concatenate([linked.by_theta[few], linked.by_start[few]], axis=2)
            psi = self.slopes(v, blocks, prediction, first, few)
            used = blocks.side_by_side(blocks.used[:, :, None], few)[:, :, None]
            rows = np.where(used != 0, psi * used, 0.0).reshape(blocks.length, n_y * m, -1)
            every[:, begin - some.start : few.stop - some.start] = rows.transpose(1, 2, 0)
        return every
