"""Kernel of linear predictors: blocks side by side, linked by powers of the transition; and its portable passes."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from gbid.core.arrays import FloatArray
from gbid.identify.kernel.blocks import Blocks, BlockSums, Prediction, at_windows
from gbid.identify.kernel.portable import LinearSteps, PortableRunner, flat, sample_sensitivities
from gbid.identify.kernel.sums import (
    Kernel,
    Linked,
    Moved,
    Sweep,
    Traced,
    along_windows,
    joined,
    link,
    powers_of,
    scan,
    spectral_radius,
    start_hessians,
)
from gbid.identify.predictor import PredictorValues


class Backwards(NamedTuple):
    """Model run forwards, and its adjoint run backwards over all blocks.

    Attributes
    ----------
    states : (n_groups, length, n, lanes) array
        States of the model.
    start : (n, W) array
        The adjoint at the start of each block.
    sums : (n + n_y, n + n_z) array
        Derivative of the cost by the entries of ``[F G; C H]``.
    factors : (n_groups, length, n + n_y, lanes) array
        For each sample ``a[k+1]`` and then ``-w[k]``: `sums` are their products with states and regressors.
    """

    states: FloatArray
    start: FloatArray
    sums: FloatArray
    factors: FloatArray


class LinearKernel(Kernel):
    """Kernel of a linear predictor, whose transition is the same for all samples; passes over blocks are abstract."""

    def trace(
        self, v: PredictorValues, blocks: Blocks, starts: FloatArray, weights: Sequence[FloatArray]
    ) -> list[Traced]:
        """Return the sums by window and by block for each weight; see `Kernel`."""
        powers = powers_of(v.F, blocks.length)
        begin = self._begin(v, blocks, starts, powers[-1])
        passes = []
        for weight in weights:
            root = np.ascontiguousarray(np.linalg.cholesky(weight).T)  # W = root' root
            free = root @ v.C @ powers[:-1]
            sums = self.sums(v, blocks, begin, root, free)
            linked = link(blocks, sums.end_theta, powers)
            passes.append(Traced(begin, joined(blocks, sums, start_hessians(blocks, free), linked), linked, sums))
        return passes

    def begin(self, v: PredictorValues, blocks: Blocks, starts: FloatArray) -> FloatArray:
        """Return the state at the start of each block; see `Kernel`."""
        return self._begin(v, blocks, starts, powers_of(v.F, blocks.length)[-1])

    def _begin(self, v: PredictorValues, blocks: Blocks, starts: FloatArray, transition: FloatArray) -> FloatArray:
        if blocks.per_window == 1:
            return at_windows(blocks, starts)
        ends = self.passed(v, blocks, np.zeros((len(v.F), len(blocks.size)))).end
        return along_windows(blocks, starts.T[:, :, None], ends[:, :, None], transition)[:, :, 0]

    def products(self, v: PredictorValues, blocks: Blocks, starts: FloatArray) -> FloatArray:
        """Return the products of the errors of each block; see `Kernel`."""
        return self.products_of(v, blocks, self.begin(v, blocks, starts))

    def gradient(
        self, v: PredictorValues, blocks: Blocks, starts: FloatArray, ends: FloatArray, weight: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return the gradient by the adjoint: less work than a pass with sensitivities.

        ``w`` are the weighted errors, and ``a[k]`` is the derivative of the cost by the state at sample k. The adjoint
        runs backwards, ``a[k] = F' a[k+1] - C' w[k]``, from the multipliers at the end of a window. Derivatives by the
        entries of F and G are sums of products of ``a`` with states and regressors. Those by C and H use ``w``.
        """
        powers = powers_of(v.F, blocks.length)
        back = self._backwards(v, blocks, starts, ends, weight, powers[-1])
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
        """Return the second-order term from two passes for all columns together; see `Kernel`.

        With the adjoint a, the weighted errors w and the sensitivities ``s_j`` of the state, it is the sum over k of

            a[k+1]' (dF_i s_j + dF_j s_i + d2F_ij x + d2G_ij z) - w' (dC_i s_j + dC_j s_i + d2C_ij x + d2H_ij z).

        The sums of products of a and w with states and sensitivities come from the passes. Second derivatives of the
        matrices are differences of the first ones, which need no pass. The state is linear in the start of its window.
        So by a parameter and a start, ``dF_j F^k`` is all that is left.
        """
        powers, n, n_p = powers_of(v.F, blocks.length), len(v.F), len(v.dF)
        back = self._backwards(v, blocks, starts, ends, weight, powers[-1])
        products, end_theta = self.second_pass(v, blocks, back)
        linked = link(blocks, end_theta, powers)
        live, m = slice(0, blocks.n_blocks), back.factors.shape[2]
        # Of the start of each block: products of the factors with the free response, (n_blocks, m * n, n).
        by_block = np.moveaxis(back.factors, -1, 1).transpose(0, 1, 3, 2).reshape(-1, blocks.length)
        free = (by_block @ powers[:-1].reshape(blocks.length, -1)).reshape(-1, m * n, n)[live]
        products = products.transpose(1, 0, 2).reshape(n_p, m * n)
        products = products + np.tensordot(linked.by_theta[live], free, ([0, 1], [0, 2]))
        slopes = np.concatenate([v.dF, v.dC], axis=1).reshape(n_p, m * n)
        across = slopes @ products.T
        full, columns = across + across.T, [each.column for each in moved]
        theta, mixed = np.zeros((n_p, n_p)), np.zeros((blocks.n_windows, n_p, n))
        here = _by_parameters(v, back.sums)
        for each in moved:
            change = (_by_parameters(each.v, back.sums) - here) / each.step
            theta[:, each.column] = full[:, each.column] + change
        by_start = np.add.reduceat((slopes @ free) @ linked.by_start[live], blocks.window_first)
        mixed[:, columns] = by_start[:, columns]
        return theta, mixed

    def _backwards(
        self,
        v: PredictorValues,
        blocks: Blocks,
        starts: FloatArray,
        ends: FloatArray,
        weight: FloatArray,
        transition: FloatArray,
    ) -> Backwards:
        """Run the model forwards and its adjoint backwards through the blocks of each window."""
        prediction = self.passed(v, blocks, self._begin(v, blocks, starts, transition))
        weighted = weight @ prediction.errors * blocks.used[:, :, None]
        at_end = np.zeros((len(v.F), len(blocks.size)))
        at_end[:, blocks.window_first + blocks.window_size - 1] = ends.T
        back = self.adjoint_pass(v, blocks, weighted, prediction.states, at_end)
        if blocks.per_window > 1:
            at_start = _back_along_windows(blocks, back.start, transition)
            at_end[:, blocks.followed] = at_start[:, blocks.followed + 1]
            back = self.adjoint_pass(v, blocks, weighted, prediction.states, at_end)
        return back

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

    @abstractmethod
    def sums(
        self, v: PredictorValues, blocks: Blocks, begin: FloatArray, root: FloatArray, free: FloatArray
    ) -> BlockSums:
        """Return the sums of the pass with sensitivities.

        Parameters
        ----------
        v : PredictorValues
            Predictor.
        blocks : Blocks
            Samples.
        begin : (n, W) array
            State at the start of each block, padding included.
        root : (n_y, n_y) array
            Upper triangular, ``root' root`` the weight.
        free : (length, n_y, n) array
            Weighted response to the start, ``root C F^k``.
        """

    @abstractmethod
    def products_of(self, v: PredictorValues, blocks: Blocks, begin: FloatArray) -> FloatArray:
        """Return the products of the errors of each block as `products` does, from starts of blocks, (n, W)."""

    @abstractmethod
    def adjoint_pass(
        self, v: PredictorValues, blocks: Blocks, weighted: FloatArray, states: FloatArray, last: FloatArray
    ) -> Backwards:
        """Run the adjoint ``a[k] = F' a[k+1] - C' w[k]`` backwards in each block.

        Parameters
        ----------
        v : PredictorValues
            Predictor.
        blocks : Blocks
            Samples.
        weighted : (n_groups, length, n_y, lanes) array
            Weighted errors ``w``.
        states : (n_groups, length, n, lanes) array
            States of the model.
        last : (n, W) array
            The adjoint at the end of each block.
        """

    @abstractmethod
    def second_pass(self, v: PredictorValues, blocks: Blocks, back: Backwards) -> tuple[FloatArray, FloatArray]:
        """Run the sensitivities of the states, each block from a start that does not depend on the parameters.

        Returns
        -------
        (n + n_y, n_p, n) array
            Sums over all samples of the factors of the adjoint times these sensitivities.
        (W, n, n_p) array
            The sensitivities after the whole length of each block, padding included.
        """


def _back_along_windows(blocks: Blocks, single: FloatArray, transition: FloatArray) -> FloatArray:
    """Return the adjoint at the start of every block, (n, W), from the adjoints of single blocks."""
    backwards = blocks.window_size[:, None] - 1 - np.arange(blocks.per_window)
    inside = backwards >= 0
    blocks_of = blocks.window_first[:, None] + np.maximum(backwards, 0)
    result = np.zeros_like(single)
    result[:, blocks_of[inside]] = scan(transition.T, single[:, blocks_of][..., None])[:, inside, 0]
    return result


def _by_parameters(v: PredictorValues, sums: FloatArray) -> FloatArray:
    """Return derivatives by the predictor's parameters from those by the entries of its matrices."""
    n, n_p = len(v.F), len(v.dF)
    pairs = ((v.dF, sums[:n, :n]), (v.dG, sums[:n, n:]), (v.dC, sums[n:, :n]), (v.dH, sums[n:, n:]))
    return np.asarray(sum(slopes.reshape(n_p, -1) @ products.ravel() for slopes, products in pairs))


# ---- Passes without a C compiler.


class PortableLinearKernel(LinearKernel):
    """Kernel of a linear predictor on a machine without a C compiler, in numpy; a `Kernel`."""

    def __init__(self) -> None:
        self._run = PortableRunner(LinearSteps())

    def sums(
        self,
        v: PredictorValues,
        blocks: Blocks,
        begin: FloatArray,
        root: FloatArray,
        free: FloatArray,  # noqa: ARG002
    ) -> BlockSums:
        """Return the sums of the pass with sensitivities; see `LinearKernel`."""
        return self._run.sums(v, blocks, begin, root).by_block

    def passed(self, v: PredictorValues, blocks: Blocks, begin: FloatArray) -> Prediction:
        """Return states and errors from the starts of blocks; see `Kernel`."""
        return self._run.passed(v, blocks, begin)

    def products_of(self, v: PredictorValues, blocks: Blocks, begin: FloatArray) -> FloatArray:
        """Return the products of the errors of each block; see `LinearKernel`."""
        return self.passed(v, blocks, begin).products

    def adjoint_pass(
        self, v: PredictorValues, blocks: Blocks, weighted: FloatArray, states: FloatArray, last: FloatArray
    ) -> Backwards:
        """Run the adjoint backwards in each block; see `LinearKernel`."""
        n_groups, length, n, lanes = states.shape
        size, given = blocks.size.reshape(n_groups, 1, lanes), blocks.by_group(last)
        drive = v.C.T @ weighted
        after = np.empty_like(states)
        a = np.zeros_like(given)
        for k in range(length - 1, -1, -1):
            after[:, k] = np.where(size == k + 1, given, a)
            a = v.F.T @ after[:, k] - drive[:, k]
        factors, driving = np.concatenate([after, -weighted], axis=2), _driving(v, blocks, states)
        sums = np.einsum("gkal,gkbl->ab", factors, driving, optimize=True)
        return Backwards(states, a.transpose(1, 0, 2).reshape(n, -1), sums, factors)

    def second_pass(self, v: PredictorValues, blocks: Blocks, back: Backwards) -> tuple[FloatArray, FloatArray]:
        """Return the products of the adjoint and the sensitivities of the states; see `LinearKernel`."""
        n_p, n, _ = v.dF.shape
        factors, driving = flat(back.factors), flat(_driving(v, blocks, back.states))
        onto = np.concatenate([v.dF, v.dG], axis=2).reshape(n_p * n, -1).T
        products, s = np.zeros((factors.shape[2], n_p * n)), np.zeros((len(blocks.size), n_p * n))
        for now, at in zip(factors, driving, strict=True):
            products += now.T @ s
            s = (s.reshape(-1, n) @ v.F.T).reshape(s.shape) + at @ onto
        return products.reshape(-1, n_p, n), s.reshape(-1, n_p, n).transpose(0, 2, 1)

    def sensitivities(
        self, v: PredictorValues, blocks: Blocks, prediction: Prediction, linked: Linked, some: slice
    ) -> FloatArray:
        """Return the sensitivities of some blocks; see `Kernel`."""
        return sample_sensitivities(self._run, v, blocks, prediction, linked, some)


def _driving(v: PredictorValues, blocks: Blocks, states: FloatArray) -> FloatArray:
    """Return states and regressors of all samples, (n_groups, length, n + n_z, lanes)."""
    return np.concatenate([states, blocks.z(v.shift)], axis=2)
