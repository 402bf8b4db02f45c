"""Problem with each segment of a record as one window: it has fewer unknowns for the last iterations."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from gbid.arrays import FloatArray, IntArray
from gbid.identify.kernel.blocks import Blocks, cut
from gbid.identify.nlp.record_group import RecordGroup
from gbid.identify.nlp.shooting import Shooting

_LONG = 128  # samples of a block; a record of many shorter ones takes longer to link


def in_one_window(problem: Shooting) -> tuple[Shooting, IntArray]:
    """Join the windows of each segment.

    Parameters
    ----------
    problem : Shooting

    Returns
    -------
    Shooting
        Windows of different segments stay linked.
    (n_unknowns of the joined problem,) integer array
        Where its unknowns are among those of the problem given.
    """
    parts = tuple(replace(part, blocks=_joined(part)) for part in problem.parts)
    firsts = np.concatenate(
        [
            first + part.blocks.segment_first
            for part, first in zip(problem.parts, problem.first_window[:-1], strict=True)
        ]
    )
    segment_of = np.searchsorted(firsts, np.arange(problem.n_windows), side="right") - 1
    between = np.isin(problem.links[:, 1], firsts)  # a segment is entered only at its first window
    links = segment_of[problem.links[between]].reshape(-1, 2)
    n, n_t = problem.n_states, problem.n_theta
    starts = (n_t + firsts[:, None] * n + np.arange(n)).ravel()
    extra = problem.extra and problem.extra.moved_to(segment_of[problem.extra.windows])
    joined = replace(problem, parts=parts, links=links, extra=extra, _last={}, _met={})
    return joined, np.concatenate([np.arange(n_t), starts])


def _joined(part: RecordGroup) -> Blocks:
    """Return the segments of a part as one window each, in the blocks that are there where these are not short."""
    if part.blocks.length >= _LONG:
        return part.blocks.by_whole_segments()
    return cut(part.blocks.segments, part.predictor, None)


def in_windows(problem: Shooting, joined: Shooting, unknowns: FloatArray) -> FloatArray:
    """Unknowns of a problem at a point of `in_one_window`'s: the windows start where the model passes by."""
    theta, starts = joined.unpack(unknowns)
    passed = [
        _along(part, v, starts[a:b])
        for v, part, a, b in zip(
            problem.values(theta), problem.parts, joined.first_window[:-1], joined.first_window[1:], strict=True
        )
    ]
    return problem.pack(theta, np.concatenate(passed))


def _along(part: RecordGroup, v: Any, starts: FloatArray) -> FloatArray:
    """State at the start of each window, (n_windows, n), from those of the segments."""
    blocks = part.blocks
    return part.kernel.begin(v, blocks.by_whole_segments(), starts)[:, blocks.window_first].T
