"""Pass over the samples in numpy: the portable engine, and the reference for the compiled one."""

from __future__ import annotations

import numpy as np

from gbid.arrays import FloatArray, IntArray
from gbid.identify.kernel.block_sums import Adjoint, BlockSums, Prediction, Second
from gbid.identify.kernel.blocks import Blocks
from gbid.identify.predictor import PredictorValues

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
