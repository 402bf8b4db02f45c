"""Kernel of linear predictors for recordings with missing output samples, and the Kalman gains after each gap.

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

from gbid.core.arrays import BoolArray, FloatArray
from gbid.identify.kernel.blocks import Blocks, GapGains, Prediction, Segment, in_groups
from gbid.identify.kernel.portable import PortablePasses, flat, grouped
from gbid.identify.kernel.sums import Sweep, spectral_radius
from gbid.identify.predictor import PredictorValues


class GapKernel(PortablePasses):
    """Kernel of a linear predictor over samples of which some are missing, in numpy; a `Kernel`."""

    def onwards(self, v: PredictorValues, x: FloatArray, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the next states and the weighted outputs; see `SampleKernel`."""
        step = _step(v, x, z)
        return step.after, step.outputs

    def with_slopes(
        self, v: PredictorValues, x: FloatArray, z: FloatArray, slopes: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return states and weighted outputs with their derivatives; see `SampleKernel`."""
        step, n_p = _step(v, x, z), v.n_parameters
        psi, S = v.C @ slopes, v.F @ slopes
        n_known = step.known.shape[1]
        psi[:, :, :n_p] += (v.dC @ x.T + v.dH[:, :, :n_known] @ step.known.T).T
        S[:, :, :n_p] += (v.dF @ x.T + v.dG[:, :, :n_known] @ step.known.T).T
        if step.measured.shape[1]:
            S[:, :, :n_p] += (v.dG[:, :, n_known:] @ step.measured.T).T
            S += step.by_prediction @ psi
        return step.after, S, step.outputs, step.T @ psi

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


class _Step(NamedTuple):
    """A sample of many blocks side by side.

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
    """

    after: FloatArray
    outputs: FloatArray
    T: FloatArray
    by_prediction: FloatArray
    known: FloatArray
    measured: FloatArray


def _step(v: PredictorValues, x: FloatArray, z: FloatArray) -> _Step:
    """Return the step of a sample; behind its regressors `z` stand T and, where outputs are fed back, L."""
    n_y, (n, n_z) = len(v.C), v.G.shape
    feeds_back = z.shape[1] > n_z + n_y**2
    n_known = n_z - n_y if feeds_back else n_z
    known, T = z[:, :n_known], z[:, n_z : n_z + n_y**2].reshape(-1, n_y, n_y)
    yhat = x @ v.C.T + known @ v.H[:, :n_known].T
    after, outputs = x @ v.F.T + known @ v.G[:, :n_known].T, (T @ yhat[:, :, None])[:, :, 0]
    y = z[:, n_known:n_z]
    if not feeds_back:
        return _Step(after, outputs, T, np.zeros((len(z), n, n_y)), known, y)
    onto, L = v.G[:, n_known:], z[:, n_z + n_y**2 :].reshape(-1, n, n_y)
    missing = np.isnan(y)
    y = np.where(missing, yhat, y)
    after = after + y @ onto.T + (L @ (y - yhat)[:, :, None])[:, :, 0]
    return _Step(after, outputs, T, np.where(missing[:, None, :], onto, -L), known, y)


# ---- Kalman gains after gaps: those of the model with the covariance of its innovations, found in rounds.


def with_constant_gain(segment: Segment, n_states: int, *, feeds_back: bool) -> Segment:
    """Return a segment for a `GapKernel`, in which missing outputs do not count and the gain stays as it is."""
    n, n_y = segment.outputs.shape
    T = (np.eye(n_y) * ~np.isnan(segment.measured)[:, None, :]).reshape(n, -1)
    columns = np.hstack([T, np.zeros((n, n_states * n_y))]) if feeds_back else T
    return replace(segment, gains=GapGains(columns, np.zeros((n_y, n_y))))


class _Filter(NamedTuple):
    """Filter of a model over blocks: gains beyond the constant one, and covariances of the errors.

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
    filter_ = _filter(v, blocks, flat(in_groups(parts, blocks.length)) > 0, innovation)
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
    y = in_groups([segment.targets for segment in segments], blocks.length)
    return replace(blocks, y=y, segments=tuple(segments), _regressors={})


def _filter(v: PredictorValues, blocks: Blocks, measured: BoolArray, innovation: FloatArray) -> _Filter:
    """Run the filter in all blocks side by side, until each begins with the covariance at the end of the one before."""
    (length, width, n_y), n = measured.shape, len(v.F)
    K = v.G[:, -n_y:] if blocks.predictor.feeds_back else np.zeros((n, n_y))
    A, eye = v.F + K @ v.C, np.eye(n_y)
    first = np.zeros(width, bool)
    first[blocks.window_first[blocks.segment_first]] = True
    start = np.zeros((width, n, n))
    gains, covariances = np.zeros((length, width, n, n_y)), np.empty((length, width, n_y, n_y))
    while True:
        P = start
        for k in range(length):
            both = measured[k][:, :, None] & measured[k][:, None, :]
            PC = P @ v.C.T
            S = np.where(both, v.C @ PC + innovation, eye)
            across = (A @ PC + K @ innovation) * measured[k][:, None, :]
            gain = np.linalg.solve(S, across.swapaxes(1, 2)).swapaxes(1, 2)
            gains[k], covariances[k] = gain - K * measured[k][:, None, :], S
            P = A @ P @ A.T + K @ innovation @ K.T - gain @ across.swapaxes(1, 2)
            P = (P + P.swapaxes(1, 2)) / 2
        following = np.concatenate([np.zeros((1, n, n)), P[:-1]])
        following[first] = 0.0
        if not K.any() or np.abs(following - start).max() <= 1e-9 * max(np.abs(following).max(), np.finfo(float).tiny):
            return _Filter(gains, covariances)
        start = following
