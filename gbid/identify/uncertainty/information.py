"""What each record alone says about its own parameters, at an estimate that all records share."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gbid.arrays import FloatArray, IntArray
from gbid.identify.kernel.blocks import LONGEST_BLOCK, cut
from gbid.identify.kernel.sweep import block_sums, joined, link, powers_of, start_hessians
from gbid.identify.nlp.shooting import Shooting

_BLOCKS, _SHORTEST = 64, 8  # blocks of a record, within which scores are summed; samples in the shortest


class RecordInformation(NamedTuple):
    """One record's share of the cost ``sum e' W e / 2``, its own parameters first, then its initial state.

    Attributes
    ----------
    hessian : (m, m) array
        Gauss-Newton, by the predictor's own parameters and the record's initial state.
    scores : (n_blocks, m) array
        Minus the gradient, of each of the blocks of samples that follow one another.
    """

    hessian: FloatArray
    scores: FloatArray


def record_information(
    problem: Shooting, theta: FloatArray, starts: FloatArray, record_window: IntArray, weight: FloatArray
) -> list[RecordInformation]:
    """Run one pass over each record by itself.

    Parameters
    ----------
    problem : Shooting
        Each record in one segment.
    theta : (n_p,) array
    starts : (n_windows, n) array
    record_window : (n_records,) integer array
        First window of each record.
    weight : (n_y, n_y) array

    Returns
    -------
    list of RecordInformation
        In the order of the records.
    """
    found = {}
    for v, part, first in zip(problem.values(theta), problem.parts, problem.first_window[:-1], strict=True):
        for segment, window in zip(part.blocks.segments, part.blocks.segment_first, strict=True):
            length = min(max(len(segment.outputs) // _BLOCKS, _SHORTEST), LONGEST_BLOCK)
            blocks = cut([segment], part.predictor, None, longest_block=length)
            powers = powers_of(v.F, blocks.length)
            start = starts[first + window][None]
            sums, free = block_sums(v, blocks, start, weight, powers, part.engine)
            linked = link(blocks, sums.end_theta, powers)
            whole = joined(blocks, sums, start_hessians(blocks, free), linked)
            mixed = whole.hessian_mixed[0]
            live = slice(0, blocks.n_blocks)
            g, gx = sums.gradient[live], sums.gradient_start[live][:, None, :]
            by_own = g + (gx @ linked.by_theta[live])[:, 0]
            by_start = (gx @ linked.by_start[live])[:, 0]
            found[int(first + window)] = RecordInformation(
                np.block([[whole.hessian, mixed], [mixed.T, whole.hessian_start[0]]]), -np.hstack([by_own, by_start])
            )
    return [found[int(window)] for window in record_window]


def profiled(information: RecordInformation, kept: IntArray) -> RecordInformation:
    """Eliminate all but the kept parameters: what is left to know of them when the rest is estimated along."""
    H, scores = information
    rest = np.setdiff1d(np.arange(len(H)), kept)
    scale = 1 / np.sqrt(np.maximum(np.diag(H)[rest], 1e-300))
    inner = H[np.ix_(rest, rest)] * np.outer(scale, scale)
    onto = np.linalg.pinv(inner, rcond=1e-12, hermitian=True) @ (H[np.ix_(rest, kept)] * scale[:, None])
    onto *= scale[:, None]
    return RecordInformation(
        H[np.ix_(kept, kept)] - H[np.ix_(kept, rest)] @ onto, scores[:, kept] - scores[:, rest] @ onto
    )
