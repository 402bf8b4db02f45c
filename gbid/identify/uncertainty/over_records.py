"""What whole records say of parameters and initial states together, Gauss-Newton and as it is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from gbid.arrays import FloatArray, IntArray
from gbid.identify.kernel.blocks import cut
from gbid.identify.kernel.sweep import block_sums, joined, link, powers_of, start_hessians
from gbid.identify.nlp.adjoint import own_gradients
from gbid.identify.nlp.exact_columns import PartHessian, exact_columns
from gbid.identify.nlp.one_window import in_one_window
from gbid.identify.nlp.shooting import RecordGroup, Shooting


class Fine(NamedTuple):
    """A part cut anew, each segment as one window of short blocks, and the windows these segments start with."""

    part: RecordGroup
    windows: IntArray


class Information(NamedTuple):
    """Second derivatives of ``sum e' W e / 2`` by the parameters and, after them, the records' initial states.

    Attributes
    ----------
    hessian : (n_all, n_all) array
        Gauss-Newton.
    observed : (n_all, n_all) array or None
        As it is, with what Gauss-Newton leaves out of the parameters' columns.
    scores : list of (n_blocks, n_all) array
        For each record, gradient of each block of samples; empty where they were not asked for.
    """

    hessian: FloatArray
    observed: FloatArray | None
    scores: list[FloatArray]


def by_piece(problem: Shooting, block: int) -> list[Fine]:
    """Cut each segment into blocks of at most `block` samples."""
    fine = []
    for part, first in zip(problem.parts, problem.first_window[:-1], strict=True):
        blocks = cut(part.blocks.segments, part.predictor, None, longest_block=block)
        fine.append(Fine(replace(part, blocks=blocks), first + part.blocks.segment_first))
    return fine


def information_over_records(
    problem: Shooting,
    fine: list[Fine],
    theta: FloatArray,
    starts: FloatArray,
    record_window: IntArray,
    weight: FloatArray,
    *,
    scores: bool = False,
    observed: bool = False,
) -> Information:
    """Run a pass over whole segments and refer everything to parameters and the records' initial states.

    Parameters
    ----------
    problem : Shooting
        Parameters not tied.
    fine : list of Fine
        Its parts by segments.
    theta : (n_p,) array
    starts : (n_windows, n) array
    record_window : (n_records,) integer array
        First window of each record.
    weight : (n_y, n_y) array
    scores : bool
        Whether the gradients of single blocks are wanted.
    observed : bool
        Whether the Hessian as it is is wanted: a pass for each parameter.
    """
    n, n_p = problem.n_states, problem.n_theta
    n_all = n_p + len(record_window) * n
    record_of = {int(window): i for i, window in enumerate(record_window)}
    chains: dict[int, tuple[FloatArray, int]] = {}  # start of the segment at a window: sensitivity, record
    for window, record in record_of.items():
        T = np.zeros((n, n_all))
        T[:, n_p + record * n : n_p + (record + 1) * n] = np.eye(n)
        chains[window] = T, record
    gathered: list[list[tuple[int, FloatArray]]] = [[] for _ in record_window]
    passes = []
    for v, (part, windows) in zip(problem.values(theta), fine, strict=True):
        powers = powers_of(v.F, part.blocks.length)
        sums, free = block_sums(v, part.blocks, starts[windows], weight, powers, part.engine)
        linked = link(part.blocks, sums.end_theta, powers)
        whole = joined(part.blocks, sums, start_hessians(part.blocks, free), linked)
        passes.append((part, windows, sums, whole, linked))
    _follow_pieces(problem, passes, chains)
    hessian = np.zeros((n_all, n_all))
    curvatures = [np.diag(whole.hessian) for *_, whole, _ in passes]
    exact = _all_columns(problem, theta, starts, curvatures, weight) if observed else []
    as_it_is = np.zeros((n_all, n_all))
    for k, (part, windows, sums, whole, linked) in enumerate(passes):
        along = [chains[int(window)][0] for window in windows]
        _add(hessian, part.index, PartHessian(whole.hessian, whole.hessian_mixed), whole.hessian_start, along)
        if observed:
            own = PartHessian((exact[k].theta + exact[k].theta.T) / 2, exact[k].mixed)
            _add(as_it_is, part.index, own, whole.hessian_start, along)
        for i, window in enumerate(windows):
            T, record = chains[int(window)]
            if scores:
                here = slice(part.blocks.window_first[i], part.blocks.window_first[i] + part.blocks.window_size[i])
                g, gx = sums.gradient[here], sums.gradient_start[here]
                block = (gx[:, None, :] @ linked.by_start[here])[:, 0] @ T
                block[:, part.index] += g + (gx[:, None, :] @ linked.by_theta[here])[:, 0]
                gathered[record].append((int(window), block))
    ordered = [np.concatenate([b for _, b in sorted(parts, key=lambda item: item[0])]) for parts in gathered if parts]
    return Information(hessian, as_it_is if observed else None, ordered)


def _add(
    total: FloatArray, index: IntArray, own: PartHessian, of_starts: FloatArray, along: Sequence[FloatArray]
) -> None:
    """Add a part's Hessian, its windows' starts referred to everything by the sensitivities `along`."""
    total[np.ix_(index, index)] += own.theta
    for mixed, of_start, T in zip(own.mixed, of_starts, along, strict=True):
        across = mixed @ T
        total[index] += across
        total[:, index] += across.T
        total += T.T @ of_start @ T


def _follow_pieces(problem: Shooting, passes: list, chains: dict[int, tuple[FloatArray, int]]) -> None:  # type: ignore[type-arg]
    """Carry sensitivities from segment to segment of a record, over the stretches that are left out."""
    piece_of = {}
    last_window = {}
    for k, (_, windows, *_) in enumerate(passes):
        original = problem.parts[k].blocks
        ends = np.append(original.segment_first[1:], original.n_windows) - 1 + problem.first_window[k]
        for i, window in enumerate(windows):
            piece_of[int(window)] = (k, i)
            last_window[int(ends[i])] = int(window)
    for a, b in problem.links:
        if int(b) in piece_of and int(a) in last_window:
            T, record = chains[last_window[int(a)]]
            k, i = piece_of[last_window[int(a)]]
            part, _, _, whole, _ = passes[k]
            following = whole.end_start[i] @ T
            following[:, part.index] += whole.end_theta[i]
            chains[int(b)] = following, record


def _all_columns(
    problem: Shooting, theta: FloatArray, starts: FloatArray, curvatures: list[FloatArray], weight: FloatArray
) -> list[PartHessian]:
    """Exact columns of all parameters, with each segment as one window."""
    joined, kept = in_one_window(problem)
    _, starts = joined.unpack(problem.pack(theta, starts)[kept])
    ends, values = np.zeros_like(starts), problem.values(theta)
    for _ in joined.links:  # from the last segments of the records to the first: how the cost depends on where they end
        made = own_gradients(joined, values, starts, ends, weight)
        ends[joined.links[:, 0]] = np.concatenate([own.starts for own in made])[joined.links[:, 1]]
    return exact_columns(joined, theta, starts, ends, curvatures, weight)
