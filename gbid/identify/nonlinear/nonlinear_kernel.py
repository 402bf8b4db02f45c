"""Kernel of nonlinear predictors: blocks run side by side, and are linked by their own transitions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from gbid.arrays import FloatArray
from gbid.identify.kernel.block_sums import BlockSums, Prediction
from gbid.identify.kernel.blocks import Blocks
from gbid.identify.kernel.growth import growth_along
from gbid.identify.kernel.kernel_protocol import Moved, Traced
from gbid.identify.kernel.sweep import Linked, Sweep, joined
from gbid.identify.nonlinear.nonlinear_predictor import NonlinearValues
from gbid.identify.predictor import PredictorValues

_AT_ONCE = 64  # blocks whose sensitivities are made together


class SampleSums(NamedTuple):
    """Results of a pass with sensitivities.

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


class SampleRunner(Protocol):
    """Runner of the functions of a sample over all blocks."""

    def begin(self, v: NonlinearValues, blocks: Blocks, starts: FloatArray) -> FloatArray:
        """Return the state at the start of each block, (n, W), from those of the windows, (n_windows, n)."""
        ...

    def passed(self, v: NonlinearValues, blocks: Blocks, begin: FloatArray) -> Prediction:
        """Return states and errors from the starts of the blocks, (n, W)."""
        ...

    def products(self, v: NonlinearValues, blocks: Blocks, begin: FloatArray) -> FloatArray:
        """Return the products ``sum e e'`` of the errors of each block, (W, n_y, n_y)."""
        ...

    def sums(self, v: NonlinearValues, blocks: Blocks, begin: FloatArray, root: FloatArray) -> SampleSums:
        """Return the sums of a pass with sensitivities, for the weight ``root' root``."""
        ...

    def adjoint(
        self, v: NonlinearValues, blocks: Blocks, prediction: Prediction, weighted: FloatArray, ends: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return derivatives by theta (n_p,) and by the starts of windows (n_windows, n), backwards from `ends`."""
        ...

    def sensitivities(
        self, v: NonlinearValues, blocks: Blocks, prediction: Prediction, first: FloatArray, own: slice
    ) -> FloatArray:
        """Return those of some blocks, (length, n_y, m, n_blocks), from those of their starts, (n_blocks, n, m)."""
        ...


@dataclass(frozen=True, eq=False)
class NonlinearKernel:
    """Kernel of a nonlinear predictor; a `Kernel`.

    A block begins where the model passes by, so that windows of several blocks are exact as well.

    Attributes
    ----------
    run : SampleRunner
        Runner of the functions of a sample.
    linear : callable
        Predictor of small deviations from the mean of a trajectory, for `feedback`.
    """

    run: SampleRunner
    linear: Callable[[NonlinearValues, Blocks, Prediction], PredictorValues]

    def sweep(self, v: NonlinearValues, blocks: Blocks, starts: FloatArray, weight: FloatArray) -> Sweep:
        """Return the sums over the samples; see `Kernel`."""
        return self.trace(v, blocks, starts, [weight])[0].sums

    def trace(
        self, v: NonlinearValues, blocks: Blocks, starts: FloatArray, weights: Sequence[FloatArray]
    ) -> list[Traced]:
        """Return the sums of each block for each weight; see `Kernel`."""
        begin, found = self.begin(v, blocks, starts), []
        for weight in weights:
            root = np.ascontiguousarray(np.linalg.cholesky(weight).T)
            by_block, start_hessian, end_start = self.run.sums(v, blocks, begin, root)
            linked = linked_along(blocks, by_block.end_theta, end_start)
            found.append(Traced(begin, joined(blocks, by_block, start_hessian, linked), linked, by_block))
        return found

    def begin(self, v: NonlinearValues, blocks: Blocks, starts: FloatArray) -> FloatArray:
        """Return the state at the start of each block; see `Kernel`."""
        if blocks.per_window > 1:
            return self.run.begin(v, blocks, starts)
        begin = np.zeros((starts.shape[1], len(blocks.size)))
        begin[:, : blocks.n_windows] = starts.T
        return begin

    def predict(self, v: NonlinearValues, blocks: Blocks, starts: FloatArray) -> Prediction:
        """Return states and errors; see `Kernel`."""
        return self.passed(v, blocks, self.begin(v, blocks, starts))

    def passed(self, v: NonlinearValues, blocks: Blocks, begin: FloatArray) -> Prediction:
        """Return states and errors from the starts of blocks; see `Kernel`."""
        return self.run.passed(v, blocks, begin)

    def products(self, v: NonlinearValues, blocks: Blocks, starts: FloatArray) -> FloatArray:
        """Return the products of the errors of each block; see `Kernel`."""
        return self.run.products(v, blocks, self.begin(v, blocks, starts))

    def gradient(
        self, v: NonlinearValues, blocks: Blocks, starts: FloatArray, ends: FloatArray, weight: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return the gradient by the adjoint of each step; see `Kernel`."""
        prediction = self.predict(v, blocks, starts)
        weighted = weight @ prediction.errors * blocks.used[:, :, None]
        return self.run.adjoint(v, blocks, prediction, weighted, ends)

    def left_out(
        self,
        v: NonlinearValues,
        blocks: Blocks,
        starts: FloatArray,
        ends: FloatArray,
        weight: FloatArray,
        moved: Sequence[Moved],
    ) -> tuple[FloatArray, FloatArray]:
        """Return what Gauss-Newton omits, by differences of the gradient; see `Kernel`."""
        kept = self.sweep(v, blocks, starts, weight)
        theta, mixed = np.zeros_like(kept.hessian), np.zeros_like(kept.hessian_mixed)
        here = self.gradient(v, blocks, starts, ends, weight)
        for j, step, at in moved:
            there = self.gradient(at, blocks, starts, ends, weight)
            theta[:, j] = (there[0] - here[0]) / step - kept.hessian[:, j]
            mixed[:, j] = (there[1] - here[1]) / step - kept.hessian_mixed[:, j]
        return theta, mixed

    def growth(
        self,
        v: NonlinearValues,  # noqa: ARG002
        blocks: Blocks,
        sweep: Sweep | None,
        state_scale: FloatArray,
    ) -> float:
        """Return the growth along the trajectory of the segment with the largest one; see `Kernel`."""
        if sweep is None:
            return np.inf
        by_start = sweep.end_start / state_scale[:, None] * state_scale
        window = blocks.length * blocks.per_window
        pieces = np.split(by_start, blocks.segment_first[1:])
        return max(growth_along(piece, window * len(piece)) for piece in pieces)

    def feedback(self, v: NonlinearValues, blocks: Blocks, prediction: Prediction) -> PredictorValues:
        """Return the predictor of small deviations from the mean of the trajectory; see `Kernel`."""
        return self.linear(v, blocks, prediction)

    def sensitivities(
        self, v: NonlinearValues, blocks: Blocks, prediction: Prediction, linked: Linked, own: slice
    ) -> FloatArray:
        """Return the sensitivities of some blocks; see `Kernel`."""
        n_y, m = blocks.y.shape[2], linked.by_theta.shape[2] + linked.by_start.shape[2]
        every = np.empty((n_y * m, own.stop - own.start, blocks.length))
        for begin in range(own.start, own.stop, _AT_ONCE):
            some = slice(begin, min(begin + _AT_ONCE, own.stop))
            first = np.concatenate([linked.by_theta[some], linked.by_start[some]], axis=2)
            psi = self.run.sensitivities(v, blocks, prediction, first, some)
            used = blocks.side_by_side(blocks.used[:, :, None], some)[:, :, None]
            rows = np.where(used != 0, psi * used, 0.0).reshape(blocks.length, n_y * m, -1)
            every[:, begin - own.start : some.stop - own.start] = rows.transpose(1, 2, 0)
        return every


def linked_along(blocks: Blocks, end_theta: FloatArray, end_start: FloatArray) -> Linked:
    """Follow each window through its blocks, of which each has its own transition.

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
        own = slice(blocks.n_windows)
        by_start = np.zeros((len(end_theta), n, n))
        by_start[own] = np.eye(n)
        return Linked(np.zeros_like(end_theta), by_start, end_theta[own], end_start[own])
    both = np.zeros((len(end_theta), n, n_p + n))
    both[blocks.window_first, :, n_p:] = np.eye(n)
    ends = np.zeros((blocks.n_windows, n, n_p + n))
    for i in range(blocks.per_window):
        live = np.flatnonzero(blocks.window_size > i)
        at = blocks.window_first[live] + i
        ends[live] = end_start[at] @ both[at]
        ends[live, :, :n_p] += end_theta[at]
        more = blocks.window_size[live] > i + 1
        both[at[more] + 1] = ends[live[more]]
    return Linked(both[:, :, :n_p], both[:, :, n_p:], ends[:, :, :n_p], ends[:, :, n_p:])
