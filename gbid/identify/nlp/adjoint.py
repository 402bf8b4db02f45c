"""Gradient of the Lagrangian by the adjoint: less work than a pass with sensitivities.

``w`` are the weighted errors, and ``a[k]`` is the derivative of the cost by the state at sample k. The adjoint runs
backwards, ``a[k] = F' a[k+1] - C' w[k]``, from the multipliers of the gaps at the end of a window. Derivatives by the
entries of F and G are sums of products of ``a`` with states and regressors. Those by C and H use ``w``.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from gbid.arrays import FloatArray
from gbid.identify.kernel.blocks import Blocks
from gbid.identify.kernel.sweep import from_starts, powers_of, scan
from gbid.identify.nlp.record_group import GroupGradient, RecordGroup
from gbid.identify.nlp.shooting import Shooting
from gbid.identify.predictor import PredictorValues


def on_ends(problem: Shooting, lam_gaps: FloatArray) -> FloatArray:
    """Return the multipliers at the window ends, (n_windows, n), in physical units; zero without a next window."""
    ends = np.zeros((problem.n_windows, problem.n_states))
    ends[problem.links[:, 0]] = lam_gaps.reshape(-1, problem.n_states) / problem.state_scale
    return ends


def own_gradients(
    problem: Shooting,
    values: list[PredictorValues],
    starts: FloatArray,
    ends: FloatArray,
    weight: FloatArray,
) -> list[GroupGradient]:
    """Return gradients of cost and weighted window ends, by the parameters of each predictor and its window starts.

    Parameters
    ----------
    problem : Shooting
        Problem of the fit.
    values : list of PredictorValues
        Predictor of each part.
    starts : (n_windows, n) array
        States at the starts of the windows.
    ends : (n_windows, n) array
        Multipliers at the ends of the windows.
    weight : (n_y, n_y) array
        Constant weight of the errors; with it, parts do not depend on each other.

    Returns
    -------
    list of GroupGradient
        Gradients of each part in physical units, without the prior; not finite when the errors overflow.
    """
    windows = [slice(a, b) for a, b in pairwise(problem.first_window)]
    found = []
    for v, part, own in zip(values, problem.parts, windows, strict=True):
        prediction = from_starts(v, part.blocks, starts[own], part.engine)
        weighted = weight @ prediction.errors * part.blocks.used[:, :, None]
        sums, start = _of_part(v, part, weighted, prediction.states, ends[own])
        found.append(GroupGradient(_by_parameters(v, sums), start))
    return found


def _of_part(
    v: PredictorValues, part: RecordGroup, weighted: FloatArray, states: FloatArray, last: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return derivatives by the entries of ``[F G; C H]`` and by the windows' starts, (n_windows, n)."""
    blocks, n = part.blocks, len(v.F)
    at_end = np.zeros((n, len(blocks.size)))
    at_end[:, blocks.window_first + blocks.window_size - 1] = last.T
    at_start, sums = part.engine.adjoint(v, blocks, weighted, states, at_end)
    if blocks.per_window > 1:
        at_start = _back_along_windows(blocks, at_start, powers_of(v.F, blocks.length)[-1])
        followed = np.setdiff1d(np.arange(blocks.n_blocks), blocks.window_first) - 1
        at_end[:, followed] = at_start[:, followed + 1]
        _, sums = part.engine.adjoint(v, blocks, weighted, states, at_end)
    return sums, at_start[:, blocks.window_first].T


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
    n = len(v.F)
    return np.asarray(
        np.tensordot(v.dF, sums[:n, :n], 2)
        + np.tensordot(v.dG, sums[:n, n:], 2)
        + np.tensordot(v.dC, sums[n:, :n], 2)
        + np.tensordot(v.dH, sums[n:, n:], 2)
    )
