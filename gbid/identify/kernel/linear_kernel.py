"""Kernel of linear predictors: recursion of all blocks by an engine, and links by powers of the transition."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gbid.arrays import FloatArray
from gbid.identify.kernel.block_sums import Adjoint, PassEngine, Prediction
from gbid.identify.kernel.blocks import Blocks
from gbid.identify.kernel.growth import spectral_radius
from gbid.identify.kernel.kernel_protocol import Moved, Traced
from gbid.identify.kernel.sweep import (
    Linked,
    Sweep,
    block_sums,
    from_starts,
    joined,
    link,
    powers_of,
    scan,
    start_hessians,
    starts_of_blocks,
    sweep,
)
from gbid.identify.predictor import PredictorValues


@dataclass(frozen=True, eq=False)
class LinearKernel:
    """Kernel of a linear predictor; a `Kernel`.

    Attributes
    ----------
    run : PassEngine
        Engine of the recursion over the blocks.
    """

    run: PassEngine

    def sweep(self, v: PredictorValues, blocks: Blocks, starts: FloatArray, weight: FloatArray) -> Sweep:
        """Return the sums over the samples; see `Kernel`."""
        return sweep(v, blocks, starts, weight, self.run)

    def trace(
        self, v: PredictorValues, blocks: Blocks, starts: FloatArray, weights: Sequence[FloatArray]
    ) -> list[Traced]:
        """Return the sums of each block for each weight; see `Kernel`."""
        powers = powers_of(v.F, blocks.length)
        begin = starts_of_blocks(v, blocks, starts, powers[-1], self.run)
        found = []
        for weight in weights:
            sums, free = block_sums(v, blocks, begin, weight, powers, self.run)
            linked = link(blocks, sums.end_theta, powers)
            found.append(Traced(begin, joined(blocks, sums, start_hessians(blocks, free), linked), linked, sums))
        return found

    def begin(self, v: PredictorValues, blocks: Blocks, starts: FloatArray) -> FloatArray:
        """Return the state at the start of each block; see `Kernel`."""
        return starts_of_blocks(v, blocks, starts, powers_of(v.F, blocks.length)[-1], self.run)

    def predict(self, v: PredictorValues, blocks: Blocks, starts: FloatArray) -> Prediction:
        """Return states and errors; see `Kernel`."""
        return from_starts(v, blocks, starts, self.run)

    def passed(self, v: PredictorValues, blocks: Blocks, begin: FloatArray) -> Prediction:
        """Return states and errors from the starts of blocks; see `Kernel`."""
        return self.run.predict(v, blocks, begin)

    def products(self, v: PredictorValues, blocks: Blocks, starts: FloatArray) -> FloatArray:
        """Return the products of the errors of each block; see `Kernel`."""
        return self.run.products(v, blocks, self.begin(v, blocks, starts))

    def gradient(
        self, v: PredictorValues, blocks: Blocks, starts: FloatArray, ends: FloatArray, weight: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return the gradient by the adjoint: less work than a pass with sensitivities.

        ``w`` are the weighted errors, and ``a[k]`` is the derivative of the cost by the state at sample k. The adjoint
        runs backwards, ``a[k] = F' a[k+1] - C' w[k]``, from the multipliers at the end of a window. Derivatives by the
        entries of F and G are sums of products of ``a`` with states and regressors. Those by C and H use ``w``.
        """
        powers = powers_of(v.F, blocks.length)
        _, back = self._backwards(v, blocks, starts, ends, weight, powers[-1])
        return _by_parameters(v, back.sums), back.start[:, blocks.window_first].T

    def left_out(
        self,
        v: PredictorValues,
        blocks: Blocks,
        starts: FloatArray,
        ends: FloatArray,
        weight: FloatArray,
        moved: Sequence[Moved],
    ) -> tuple[FloatArray, FloatArray]:
        """Return what Gauss-Newton omits, from two passes for all columns together; see `Kernel`.

        With the adjoint a, the weighted errors w and the sensitivities ``s_j`` of the state, it is the sum over k of

            a[k+1]' (dF_i s_j + dF_j s_i + d2F_ij x + d2G_ij z) - w' (dC_i s_j + dC_j s_i + d2C_ij x + d2H_ij z).

        The sums of products of a and w with states and sensitivities come from the passes. Second derivatives of the
        matrices are differences of the first ones, which need no pass. The state is linear in the start of its window.
        So by a parameter and a start, ``dF_j F^k`` is all that is left.
        """
        powers, n, n_p = powers_of(v.F, blocks.length), len(v.F), len(v.dF)
        prediction, back = self._backwards(v, blocks, starts, ends, weight, powers[-1])
        second = self.run.second(v, blocks, prediction.states, back.factors)
        linked = link(blocks, second.end_theta, powers)
        live, m = slice(0, blocks.n_blocks), back.factors.shape[2]
        # Of the start of each block: products of the factors with the free response, (n_blocks, m * n, n).
        by_block = np.moveaxis(back.factors, -1, 1).transpose(0, 1, 3, 2).reshape(-1, blocks.length)
        free = (by_block @ powers[:-1].reshape(blocks.length, -1)).reshape(-1, m * n, n)[live]
        products = second.products.transpose(1, 0, 2).reshape(n_p, m * n)
        products = products + np.tensordot(linked.by_theta[live], free, ([0, 1], [0, 2]))
        slopes = np.concatenate([v.dF, v.dC], axis=1).reshape(n_p, m * n)
        across = slopes @ products.T
        full, wanted = across + across.T, [own.column for own in moved]
        theta, mixed = np.zeros((n_p, n_p)), np.zeros((blocks.n_windows, n_p, n))
        here = _by_parameters(v, back.sums)
        for own in moved:
            change = (_by_parameters(own.v, back.sums) - here) / own.step
            theta[:, own.column] = full[:, own.column] + change
        by_start = np.add.reduceat((slopes @ free) @ linked.by_start[live], blocks.window_first)
        mixed[:, wanted] = by_start[:, wanted]
        return theta, mixed

    def _backwards(
        self,
        v: PredictorValues,
        blocks: Blocks,
        starts: FloatArray,
        ends: FloatArray,
        weight: FloatArray,
        transition: FloatArray,
    ) -> tuple[Prediction, Adjoint]:
        """Run the model forwards and its adjoint backwards through the blocks of each window."""
        prediction = self.run.predict(v, blocks, starts_of_blocks(v, blocks, starts, transition, self.run))
        weighted = weight @ prediction.errors * blocks.used[:, :, None]
        at_end = np.zeros((len(v.F), len(blocks.size)))
        at_end[:, blocks.window_first + blocks.window_size - 1] = ends.T
        back = self.run.adjoint(v, blocks, weighted, prediction.states, at_end)
        if blocks.per_window > 1:
            at_start = _back_along_windows(blocks, back.start, transition)
            at_end[:, blocks.followed] = at_start[:, blocks.followed + 1]
            back = self.run.adjoint(v, blocks, weighted, prediction.states, at_end)
        return prediction, back

    def growth(
        self,
        v: PredictorValues,
        blocks: Blocks,  # noqa: ARG002
        sweep: Sweep | None,  # noqa: ARG002
        state_scale: FloatArray,  # noqa: ARG002
    ) -> float:
        """Return the spectral radius; see `Kernel`."""
        return spectral_radius([v])

    def feedback(
        self,
        v: PredictorValues,
        blocks: Blocks,  # noqa: ARG002
        prediction: Prediction,  # noqa: ARG002
    ) -> PredictorValues:
        """Return the predictor itself; see `Kernel`."""
        return v

    def sensitivities(
        self, v: PredictorValues, blocks: Blocks, prediction: Prediction, linked: Linked, own: slice
    ) -> FloatArray:
        """Return the sensitivities of some blocks; see `Kernel`."""
        first = np.concatenate([linked.by_theta[own], linked.by_start[own]], axis=2)
        return self.run.sensitivities(v, blocks, prediction, first, own)


def _back_along_windows(blocks: Blocks, own: FloatArray, transition: FloatArray) -> FloatArray:
    """Return the adjoint at the start of every block, (n, W), from the adjoints of single blocks."""
    backwards = blocks.window_size[:, None] - 1 - np.arange(blocks.per_window)
    inside = backwards >= 0
    blocks_of = blocks.window_first[:, None] + np.maximum(backwards, 0)
    result = np.zeros_like(own)
    result[:, blocks_of[inside]] = scan(transition.T, own[:, blocks_of][..., None])[:, inside, 0]
    return result


def _by_parameters(v: PredictorValues, sums: FloatArray) -> FloatArray:
    """Return derivatives by the predictor's parameters from those by the entries of its matrices."""
    n, n_p = len(v.F), len(v.dF)
    pairs = ((v.dF, sums[:n, :n]), (v.dG, sums[:n, n:]), (v.dC, sums[n:, :n]), (v.dH, sums[n:, n:]))
    return np.asarray(sum(slopes.reshape(n_p, -1) @ own.ravel() for slopes, own in pairs))
