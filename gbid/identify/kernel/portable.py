"""Passes over the samples in numpy, without a C compiler: all blocks at once, one sample after another."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from gbid.core.arrays import FloatArray
from gbid.identify.kernel.blocks import Blocks, BlockSums, Prediction
from gbid.identify.kernel.sums import SampleKernel, SampleSums


class PortablePasses(SampleKernel):
    """Passes of a kernel in numpy; in part a `Kernel`."""

    engine = "numpy"

    def begin(self, v: Any, blocks: Blocks, starts: FloatArray) -> FloatArray:
        """Return the state at the start of each block; see `Kernel`."""
        z = flat(blocks.z(v.shift))
        result = np.zeros((starts.shape[1], len(blocks.size)))
        x = starts
        for i in range(blocks.per_window):
            live = blocks.window_size > i
            at = np.where(live, blocks.window_first + i, 0)
            result[:, at[live]] = x[live].T
            if i + 1 < blocks.per_window:
                for k in range(blocks.length):
                    x = self.onwards(v, x, z[k, at])[0]
        return result

    def passed(self, v: Any, blocks: Blocks, begin: FloatArray) -> Prediction:
        """Return states and errors; see `Kernel`."""
        z, y = flat(blocks.z(v.shift)), flat(blocks.y)
        used = flat(blocks.used[:, :, None])
        states, errors = np.empty((*z.shape[:2], len(begin))), np.empty_like(y)
        x = np.ascontiguousarray(begin.T)
        for k in range(blocks.length):
            states[k] = x
            x, yhat = self.onwards(v, x, z[k])
            errors[k] = _counted(used[k], (y[k] - yhat) * used[k])
        return Prediction(grouped(states, blocks), grouped(errors, blocks), x.T)

    def sample_sums(self, v: Any, blocks: Blocks, begin: FloatArray, root: FloatArray) -> SampleSums:
        """Return the sums of a pass with sensitivities; see `SampleKernel`."""
        n, n_p, width = len(begin), v.n_parameters, len(blocks.size)
        y, used = flat(blocks.y), flat(blocks.used[:, :, None])
        n_y, m = y.shape[2], n_p + n
        first = np.concatenate([np.zeros((width, n, n_p)), np.broadcast_to(np.eye(n), (width, n, n))], axis=2)
        hessian, gradient = np.zeros((width, m, m)), np.zeros((width, m))
        products = np.zeros((n_y, n_y))
        end, slopes = np.ascontiguousarray(begin.T), first.copy()
        every = self._with_slopes(v, flat(blocks.z(v.shift)), np.ascontiguousarray(begin.T), first)
        for k, (x, S, yhat, psi) in enumerate(every):
            error = _counted(used[k], (y[k] - yhat) * used[k])
            weighted = error @ root.T
            rows = root @ _counted(used[k][:, None], psi * used[k][:, None])
            hessian += rows.transpose(0, 2, 1) @ rows
            gradient -= np.einsum("wyi,wy->wi", rows, weighted)
            products += error.T @ error
            ended = blocks.size == k + 1
            end[ended], slopes[ended] = x[ended], S[ended]
        live = (blocks.size > 0)[:, None, None]
        hessian = np.where(live, hessian, 0.0)
        return SampleSums(
            BlockSums(
                hessian[:, :n_p, :n_p].sum(axis=0),
                products,
                gradient[:, :n_p],
                gradient[:, n_p:],
                hessian[:, :n_p, n_p:],
                end,
                slopes[:, :, :n_p],
            ),
            hessian[:, n_p:, n_p:],
            slopes[:, :, n_p:],
        )

    def slopes(self, v: Any, blocks: Blocks, prediction: Prediction, first: FloatArray, some: slice) -> FloatArray:
        """Return the sensitivities of some blocks; see `SampleKernel`."""
        z = np.ascontiguousarray(blocks.side_by_side(blocks.z(v.shift), some).transpose(0, 2, 1))
        x = np.ascontiguousarray(blocks.side_by_side(prediction.states, some)[0].T)
        return np.stack([psi for *_, psi in self._with_slopes(v, z, x, first)]).transpose(0, 2, 3, 1)

    def _with_slopes(
        self, v: Any, z: FloatArray, x: FloatArray, slopes: FloatArray
    ) -> Iterator[tuple[FloatArray, FloatArray, FloatArray, FloatArray]]:
        """Yield for each sample the next state, the outputs, and the derivatives of both."""
        for now in z:
            x, slopes, yhat, psi = self.with_slopes(v, x, now, slopes)
            yield x, slopes, yhat, psi


def _counted(used: FloatArray, values: FloatArray) -> FloatArray:
    """Return values with zeros at samples outside the cost, even where the values overflow."""
    return np.where(used != 0, values, 0.0)


def flat(values: FloatArray) -> FloatArray:
    """Return groups side by side: (n_groups, length, n, lanes) as (length, n_groups * lanes, n)."""
    n_groups, length, n, lanes = values.shape
    return np.ascontiguousarray(values.transpose(1, 0, 3, 2)).reshape(length, n_groups * lanes, n)


def grouped(values: FloatArray, blocks: Blocks) -> FloatArray:
    """Return values of all blocks, (length, n_blocks, n), in groups of `lanes` blocks, (n_groups, length, n, lanes)."""
    length, _, n = values.shape
    return np.ascontiguousarray(values.reshape(length, -1, blocks.lanes, n).transpose(1, 0, 3, 2))
