"""Problem with each segment of a record as one window: it has fewer unknowns for the last iterations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gbid.arrays import FloatArray, IntArray
from gbid.identify.kernel.blocks import Blocks, cut
from gbid.identify.kernel.sweep import forced_states, powers_of
from gbid.identify.nlp.shooting import Shooting
from gbid.identify.predictor import PredictorValues


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
    parts = tuple(replace(part, blocks=cut(part.blocks.segments, part.predictor, None)) for part in problem.parts)
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
    joined = replace(problem, parts=parts, links=links, _last={}, _met={})
    return joined, np.concatenate([np.arange(n_t), starts])


def in_windows(problem: Shooting, joined: Shooting, unknowns: FloatArray) -> FloatArray:
    """Unknowns of a problem at a point of `in_one_window`'s: the windows start where the model passes by."""
    theta, starts = joined.unpack(unknowns)
    passed = [
        _along(v, part.blocks, starts[a:b])
        for v, part, a, b in zip(
            problem.values(theta), problem.parts, joined.first_window[:-1], joined.first_window[1:], strict=True
        )
    ]
    return problem.pack(theta, np.concatenate(passed))


def _along(v: PredictorValues, blocks: Blocks, starts: FloatArray) -> FloatArray:
    """State at the start of each window, (n_windows, n), from those of the segments."""
    forced, transition = forced_states(v, blocks)[-1], powers_of(v.F, blocks.length)[-1]
    passed = np.zeros((blocks.n_windows, len(transition)))
    passed[blocks.segment_first] = starts
    for window in blocks.linked:
        state = passed[window]
        for block in range(blocks.window_first[window], blocks.window_first[window] + blocks.window_size[window]):
            state = transition @ state + forced[:, block]
        passed[window + 1] = state
    return passed
