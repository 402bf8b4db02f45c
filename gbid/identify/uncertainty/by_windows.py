"""Sensitivities of the predictions of an unstable model, from its shooting windows.

Over a whole record the sensitivities by the initial state of an unstable model grow without bound. Within a window they
do not. So the state at the start of each window is written as a bounded function of the parameters and of a few further
coordinates: of all trajectories that close the gaps, those of least norm, and an orthonormal basis of the free ones.
The coordinates stand for the initial states. The covariance of the parameters does not depend on this choice.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from scipy.sparse import bmat, csc_array, eye_array
from scipy.sparse.linalg import splu

from gbid.arrays import BoolArray, FloatArray, IntArray
from gbid.identify.nlp.record_group import RecordGroup
from gbid.identify.nlp.shooting import Shooting
from gbid.identify.uncertainty.information import Information
from gbid.identify.uncertainty.sensitivities import RecordSensitivities

_GROWTH = 1e3  # of a model over a record, up to which one pass over the record is accurate


class WindowSlopes(NamedTuple):
    """Sensitivities within the windows of a part, by its parameters and, after them, the state at a window's start.

    Attributes
    ----------
    psi : (n_windows, n_samples, n_y, n_own + n) array
        Derivatives of the predictions.
    errors : (n_windows, n_samples, n_y) array
        Prediction errors.
    counted : (n_windows, n_samples) boolean array
        Whether a sample is in the cost; false beyond the end of a shorter window.
    size : (n_windows,) integer array
        Number of samples of each window.
    end : (n_windows, n, n_own + n) array
        Derivatives of the state after the last sample.
    """

    psi: FloatArray
    errors: FloatArray
    counted: BoolArray
    size: IntArray
    end: FloatArray


class WindowedRecord(NamedTuple):
    """Sensitivities of a record by all parameters and its own coordinates of free trajectories.

    Attributes
    ----------
    psi : (n_samples, n_y, n_p + n) array
    errors : (n_samples, n_y) array
    counted : (n_samples,) boolean array
    """

    psi: FloatArray
    errors: FloatArray
    counted: BoolArray


def windowed_records(
    problem: Shooting, theta: FloatArray, starts: FloatArray, record_window: IntArray, *, known_starts: BoolArray
) -> Iterator[WindowedRecord]:
    """Yield the sensitivities of each record.

    Parameters
    ----------
    problem : Shooting
        Problem of the fit.
    theta : (n_p,) array
        Free parameters.
    starts : (n_windows, n) array
        Initial states of the windows, with all gaps closed.
    record_window : (n_records,) integer array
        First window of each record.
    known_starts : (n_records, n) boolean array
        Initial states that were given instead of estimated.
    """
    n, n_p = problem.n_states, problem.n_theta
    slopes = [
        window_slopes(part, v, starts[a:b])
        for v, part, a, b in zip(
            problem.values(theta), problem.parts, problem.first_window[:-1], problem.first_window[1:], strict=True
        )
    ]
    following = {int(a): int(b) for a, b in problem.links}
    for first, known in zip(record_window, known_starts, strict=True):
        chain = [int(first)]
        while chain[-1] in following:
            chain.append(following[chain[-1]])
        parts = np.searchsorted(problem.first_window, chain, side="right") - 1
        ends = np.zeros((len(chain), n, n_p + n))
        for i, (k, window) in enumerate(zip(parts, chain, strict=True)):
            own = slopes[k].end[window - problem.first_window[k]]
            ends[i][:, problem.parts[k].index] = _onto(own[:, :-n], problem.parts[k].tie)
            ends[i][:, n_p:] = own[:, -n:]
        along = _trajectories(ends[:-1, :, n_p:], ends[:-1, :, :n_p], problem.state_scale, known)
        psi, errors, counted = [], [], []
        for k, window, T in zip(parts, chain, along, strict=True):
            own, at = slopes[k], window - problem.first_window[k]
            live = slice(0, int(own.size[at]))
            by_start = own.psi[at, live, :, -n:] @ T
            by_start[:, :, problem.parts[k].index] += _onto(own.psi[at, live, :, :-n], problem.parts[k].tie)
            counts = own.counted[at, live]
            psi.append(by_start * counts[:, None, None])
            errors.append(own.errors[at, live] * counts[:, None])
            counted.append(counts)
        yield WindowedRecord(np.concatenate(psi), np.concatenate(errors), np.concatenate(counted))


def _onto(slopes: FloatArray, tie: FloatArray | None) -> FloatArray:
    """Return derivatives (..., n_own) by the parameters to which those of a predictor are tied."""
    return slopes if tie is None else np.asarray(slopes @ tie)


def window_slopes(part: RecordGroup, v: Any, starts: FloatArray) -> WindowSlopes:
    """Return the sensitivities within each window.

    Parameters
    ----------
    part : RecordGroup
        Part of the problem.
    v
        Its predictor at the estimate.
    starts : (n_windows, n) array
        States at the starts of its windows.
    """
    blocks, kernel = part.blocks, part.kernel
    n_windows, n_y = blocks.n_windows, blocks.y.shape[2]
    place, own_blocks = blocks.by_window
    (traced,) = kernel.trace(v, blocks, starts, [np.eye(n_y)])
    prediction, linked = kernel.passed(v, blocks, traced.begin), traced.linked
    flat = kernel.sensitivities(v, blocks, prediction, linked, slice(0, blocks.n_blocks))
    psi = flat.reshape(n_y, -1, blocks.n_blocks, blocks.length)[:, :, place].transpose(2, 3, 4, 0, 1)

    def rows(values: FloatArray) -> FloatArray:
        """Return values (n_groups, length, n, lanes) as (n_windows, n_samples, n)."""
        flat = values.transpose(0, 3, 1, 2).reshape(-1, blocks.length, values.shape[2])
        return np.asarray(flat[place].reshape(n_windows, -1, values.shape[2]))

    used = rows(blocks.used[:, :, None])[:, :, 0] > 0
    used &= np.repeat(own_blocks, blocks.length, axis=1)
    size = np.where(own_blocks, blocks.size[place], 0).sum(axis=1)
    end = np.concatenate([linked.end_theta, linked.end_start], axis=2)
    return WindowSlopes(psi.reshape(n_windows, -1, n_y, end.shape[2]), rows(prediction.errors), used, size, end)


def _trajectories(by_start: FloatArray, by_theta: FloatArray, scale: FloatArray, known: BoolArray) -> FloatArray:
    """Return the derivatives of the window starts, (n_windows, n, n_p + n), that close the linearised gaps.

    `by_start` (n_windows - 1, n, n) and `by_theta` (n_windows - 1, n, n_p) are the derivatives of the windows' ends.
    `known` (n,) tells which states of the first start do not move; their coordinates stay zero.
    """
    links, n = len(by_start), len(scale)
    n_p, size = by_theta.shape[2], (links + 1) * n
    blocks = [[None] * (links + 1) for _ in range(links)]
    for i, step in enumerate(by_start / scale[:, None] * scale):
        blocks[i][i], blocks[i][i + 1] = csc_array(-step), eye_array(n)
    right = (by_theta / scale[:, None]).reshape(-1, n_p)
    gaps = csc_array(bmat(blocks)) if links else csc_array((0, size))
    if known.any():
        still = csc_array(eye_array(n, size))[known]
        gaps = csc_array(bmat([[still], [gaps]])) if links else csc_array(still)
        right = np.vstack([np.zeros((int(known.sum()), n_p)), right])
    sides = np.zeros((size, 2 * n))  # a free trajectory is seen at the first window or, where it grows, at the last
    sides[:n, :n] = sides[-n:, n:] = np.eye(n)
    if gaps.shape[0]:
        try:
            factors = splu(csc_array(gaps @ gaps.T))
        except RuntimeError as singular:  # far from a solution: the model grows beyond rounding in a window
            raise np.linalg.LinAlgError("the gaps between windows depend on each other") from singular
        following = gaps.T @ factors.solve(right)
        sides -= gaps.T @ factors.solve(np.asarray(gaps @ sides))
    else:
        following = np.zeros((size, n_p))
    free = np.zeros((size, n))
    free[:, ~known] = np.linalg.svd(sides, full_matrices=False)[0][:, : n - int(known.sum())]
    return np.asarray(np.hstack([following, free]).reshape(links + 1, n, n_p + n) * scale[:, None])


def information_by_windows(
    problem: Shooting,
    theta: FloatArray,
    starts: FloatArray,
    record_window: IntArray,
    weight: FloatArray,
    shaped: FloatArray,
    *,
    known_starts: BoolArray,
) -> Information:
    """Return the information of all records, as `information_over_records` does, for an unstable model.

    The Hessian is that of Gauss-Newton; the exact one is not computed.

    Parameters
    ----------
    problem, theta, starts, record_window, known_starts
        As for `windowed_records`.
    weight, shaped : (n_y, n_y) array
        Weights of the errors for the two Hessians.
    """
    n, n_p = problem.n_states, problem.n_theta
    n_all = n_p + len(record_window) * n
    hessians = np.zeros((2, n_all, n_all))
    sensitivities = []
    records = windowed_records(problem, theta, starts, record_window, known_starts=known_starts)
    for i, record in enumerate(records):
        columns = np.concatenate([np.arange(n_p), n_p + i * n + np.arange(n)])
        for total, W in zip(hessians, (weight, shaped), strict=True):
            total[np.ix_(columns, columns)] += np.einsum("kyi,yz,kzj->ij", record.psi, W, record.psi, optimize=True)
        psi = np.ascontiguousarray(record.psi.transpose(1, 2, 0))
        sensitivities.append(RecordSensitivities(columns, psi, record.errors, record.counted > 0))
    return Information(hessians[0], hessians[1], None, iter(sensitivities))


def grows(problem: Shooting, theta: FloatArray, starts: FloatArray) -> bool:
    """Return whether the model grows so much over a record that sensitivities have to be taken by windows."""
    longest = max(segment.outputs.shape[0] for part in problem.parts for segment in part.blocks.segments)
    rate = problem.rate(theta, starts)
    return bool(np.log(max(rate, np.finfo(float).tiny)) * longest > np.log(_GROWTH))
