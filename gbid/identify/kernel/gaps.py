"""Linear predictors with missing output samples or irregular times: kernel, and Kalman gains after each gap.

At irregular times each interval has matrices F and G of its own; the first regressor is its number. The correction by
an error lasts as long as the interval: e is constant between samples, as in the model of even times.

At a missing sample the predictor takes its own prediction for the measured output: the correction is skipped. A
regressor that is NaN says so. Behind the regressors stand, for each sample k, two matrices:

    T[k] (n_y, n_y)   weights the errors, ``T (y - yhat)``; the columns of missing outputs are zero;
    L[k] (n, n_y)     is what the gain has there beyond the constant one.

After a gap the state is known less well. Then the constant gain is not the one of the Kalman filter, and the variance
of the errors is larger. `with_kalman_gains` computes both from the covariance of the state, which is zero as long as no
sample is missing (Anderson and Moore, Optimal Filtering, 1979, Sec. 9.2).
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from gbid.core.arrays import BoolArray, FloatArray, IntArray
from gbid.identify.kernel.blocks import Blocks, GapGains, Segment, in_groups
from gbid.identify.kernel.portable import PortablePasses, flat, grouped
from gbid.identify.kernel.sums import KernelOfLinear
from gbid.identify.predictor import PredictorValues


class GapKernel(KernelOfLinear, PortablePasses):
    """Kernel of a linear predictor with missing output samples, in numpy; a `Kernel`."""

    def onwards(self, v: PredictorValues, x: FloatArray, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the next states and the weighted outputs; see `SampleKernel`."""
        step = _step(v, x, z)
        return step.after, step.outputs

    def with_slopes(
        self, v: PredictorValues, x: FloatArray, z: FloatArray, slopes: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return states and weighted outputs with their derivatives; see `SampleKernel`."""
        step, n_p = _step(v, x, z), v.n_parameters
        psi, S = v.C @ slopes, step.F @ slopes
        n_known, regressors = step.known.shape[1], np.hstack([step.known, step.measured])
        psi[:, :, :n_p] += (v.dC @ x.T + v.dH[:, :, :n_known] @ step.known.T).T
        if v.by_interval is None:
            S[:, :, :n_p] += (v.dF @ x.T + v.dG @ regressors.T).T
        else:
            onto = v.by_interval.slopes[step.interval]
            S[:, :, :n_p] += (onto @ np.hstack([x, regressors])[:, None, :, None])[..., 0]
        if step.measured.shape[1]:
            S += step.by_prediction @ psi
        return step.after, S, step.outputs, step.T @ psi


class _Step(NamedTuple):
    """One sample of the predictor for many blocks of samples at once: next states, outputs, derivatives.

    Attributes
    ----------
    after, outputs : (W, n), (W, n_y) array
        States after it, and weighted predictions.
    T : (W, n_y, n_y) array
    by_prediction : (W, n, n_y) array
        Derivative of the states by the predictions that are fed back.
    known, measured : (W, m), (W, n_y) array
        Regressors before the outputs, and outputs with predictions for missing ones; without columns if none are fed
        back.
    F : (n, n) or (W, n, n) array
        Transition of all blocks, or of each at irregular times.
    interval : (W,) integer array
        Numbers of the intervals; without meaning at even times.
    """

    after: FloatArray
    outputs: FloatArray
    T: FloatArray
    by_prediction: FloatArray
    known: FloatArray
    measured: FloatArray
    F: FloatArray
    interval: IntArray


def _step(v: PredictorValues, x: FloatArray, z: FloatArray) -> _Step:
    """Return the step of one sample; T and (with feedback) L follow the regressors in `z`."""
    n_y, (n, n_z), F, G, interval = len(v.C), v.G.shape, v.F, v.G, np.zeros(0, np.int64)
    if v.by_interval is not None:
        interval, z = z[:, 0].astype(np.int64), z[:, 1:]
        F, G = v.by_interval.F[interval], v.by_interval.G[interval]
    feeds_back = z.shape[1] > n_z + n_y**2
    n_known = n_z - n_y if feeds_back else n_z
    known, T = z[:, :n_known], z[:, n_z : n_z + n_y**2].reshape(-1, n_y, n_y)
    yhat = x @ v.C.T + known @ v.H[:, :n_known].T
    after, outputs = _times(F, x) + _times(G[..., :n_known], known), (T @ yhat[:, :, None])[:, :, 0]
    y = z[:, n_known:n_z]
    if not feeds_back:
        return _Step(after, outputs, T, np.zeros((len(z), n, n_y)), known, y, F, interval)
    onto, L = G[..., n_known:], z[:, n_z + n_y**2 :].reshape(-1, n, n_y)
    missing = np.isnan(y)
    y = np.where(missing, yhat, y)
    after = after + _times(onto, y) + (L @ (y - yhat)[:, :, None])[:, :, 0]
    return _Step(after, outputs, T, np.where(missing[:, None, :], onto, -L), known, y, F, interval)


def _times(matrix: FloatArray, rows: FloatArray) -> FloatArray:
    """Return the product of one matrix, or of a matrix for each row, with each row of (W, n)."""
    return np.asarray(rows @ matrix.T if matrix.ndim == 2 else (matrix @ rows[:, :, None])[:, :, 0])


# ---- Kalman gains after gaps, for a model with the covariance of its innovations.


def with_constant_gain(segment: Segment, n_states: int, *, feeds_back: bool) -> Segment:
    """Return a segment for a `GapKernel` with a constant gain, in which missing outputs do not count."""
    n, n_y = segment.outputs.shape
    T = (np.eye(n_y) * ~np.isnan(segment.measured)[:, None, :]).reshape(n, -1)
    columns = np.hstack([T, np.zeros((n, n_states * n_y))]) if feeds_back else T
    return replace(segment, gains=GapGains(columns, np.zeros((n_y, n_y))))


class _Filter(NamedTuple):
    """Kalman filter over blocks: gains beyond the constant gain, and covariances of the errors.

    Attributes
    ----------
    gains : (length, W, n, n_y) array
    covariances : (length, W, n_y, n_y) array
        Rows and columns of missing outputs are those of an identity matrix.
    """

    gains: FloatArray
    covariances: FloatArray


def with_kalman_gains(v: PredictorValues, blocks: Blocks, innovation: FloatArray, *, mixes: bool) -> Blocks:
    """Return blocks with the weights and gains of the Kalman filter for a model.

    Parameters
    ----------
    v : PredictorValues
        Predictor with the constant gain.
    blocks : Blocks
        Samples, some of which are missing.
    innovation : (n_y, n_y) array
        Covariance of the innovations.
    mixes : bool
        Whether the weights decorrelate the errors of several outputs, as the determinant criterion needs; otherwise
        missing outputs just do not count.
    """
    parts = [segment.present.astype(float) for segment in blocks.segments]
    filter_ = _filter(v, blocks, flat(in_groups(parts, blocks.length, len(blocks.y))) > 0, innovation)
    n_y, n, eye = len(innovation), len(v.F), np.eye(len(innovation))
    rows = np.concatenate([each.reshape(*each.shape[:2], -1) for each in filter_], axis=2)
    segments = []
    for segment, part in zip(blocks.segments, blocks.by_segment(grouped(rows, blocks)), strict=True):
        measured = segment.present
        counted = measured.any(axis=1)
        T, absent, spread = eye * measured[:, None, :], np.zeros((n_y, n_y)), 0.0
        if mixes or n_y == 1:
            covariances = part[:, n * n_y :].reshape(-1, n_y, n_y)
            known = np.where(measured[:, :, None] & measured[:, None, :], innovation, eye)
            given = innovation @ T @ np.linalg.inv(np.linalg.cholesky(known)).swapaxes(1, 2)
            T = given @ np.linalg.inv(np.linalg.cholesky(covariances)) @ T
            absent = (innovation - given @ given.swapaxes(1, 2))[counted].sum(axis=0)
            spread = float(np.linalg.slogdet(covariances[counted])[1].sum())
            spread -= float(counted.sum() * np.linalg.slogdet(innovation)[1])
            spread -= float((~measured[counted]).sum()) * (1 + float(np.log(2 * np.pi)))
        gains = part[:, : n * n_y] if blocks.predictor.feeds_back else part[:, :0]
        columns = np.zeros((len(segment.outputs), n_y**2 + gains.shape[1]))
        segment.part(columns)[:] = np.hstack([T.reshape(-1, n_y**2), gains])
        segments.append(replace(segment, gains=GapGains(columns, absent, spread)))
    y = in_groups([segment.targets for segment in segments], blocks.length, len(blocks.y))
    return replace(blocks.with_segments(segments), y=y)


def _filter(v: PredictorValues, blocks: Blocks, measured: BoolArray, innovation: FloatArray) -> _Filter:
    """Run the Kalman filter in all blocks side by side, until the covariances at block boundaries agree."""
    (length, width, n_y), n = measured.shape, len(v.F)
    F, G, intervals = v.F[None], v.G[None], np.zeros((length, width), np.int64)
    if v.by_interval is not None:
        F, G, intervals = v.by_interval.F, v.by_interval.G, flat(blocks.z(v.shift))[:, :, 0].astype(np.int64)
    every_K = G[:, :, -n_y:] if blocks.predictor.feeds_back else np.zeros((len(G), n, n_y))
    every_A, eye = F + every_K @ v.C, np.eye(n_y)
    first = np.zeros(width, bool)
    first[blocks.window_first[blocks.segment_first]] = True
    start = np.zeros((width, n, n))
    gains, covariances = np.zeros((length, width, n, n_y)), np.empty((length, width, n_y, n_y))
    while True:
        P = start
        for k in range(length):
            A, K = every_A[intervals[k]], every_K[intervals[k]]
            both = measured[k][:, :, None] & measured[k][:, None, :]
            PC = P @ v.C.T
            S = np.where(both, v.C @ PC + innovation, eye)
            across = (A @ PC + K @ innovation) * measured[k][:, None, :]
            gain = np.linalg.solve(S, across.swapaxes(1, 2)).swapaxes(1, 2)
            gains[k], covariances[k] = gain - K * measured[k][:, None, :], S
            P = A @ P @ A.swapaxes(1, 2) + K @ innovation @ K.swapaxes(1, 2) - gain @ across.swapaxes(1, 2)
            P = (P + P.swapaxes(1, 2)) / 2
        following = np.concatenate([np.zeros((1, n, n)), P[:-1]])
        following[first] = 0.0
        if not every_K.any() or np.abs(following - start).max() <= 1e-9 * max(
            np.abs(following).max(), np.finfo(float).tiny
        ):
            return _Filter(gains, covariances)
        start = following
