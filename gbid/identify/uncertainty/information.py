"""Information of records on parameters and initial states: Hessians of the cost and gradients of blocks."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from gbid.arrays import FloatArray, IntArray
from gbid.identify.kernel.blocks import LONGEST_BLOCK, Blocks, cut
from gbid.identify.kernel.kernel_protocol import Traced
from gbid.identify.kernel.sweep import Sweep, tied
from gbid.identify.nlp.adjoint import own_gradients
from gbid.identify.nlp.omitted_part import PartHessian, omitted_part
from gbid.identify.nlp.one_window import in_one_window
from gbid.identify.nlp.shooting import Shooting
from gbid.identify.uncertainty.sensitivities import (
    RecordSensitivities,
    joined_segments,
    of_segment,
    tied_sensitivities,
    tied_values,
)

_BLOCKS, _SHORTEST = 64, 8  # number of blocks of a record, in which scores are summed; samples in the shortest


class Information(NamedTuple):
    """Second derivatives of ``sum e' W e / 2`` by the parameters and, after them, the initial states of the records.

    Attributes
    ----------
    hessian : (n_all, n_all) array
        Gauss-Newton Hessian.
    shaped : (n_all, n_all) array
        Gauss-Newton Hessian with another weight.
    observed : (n_all, n_all) array or None
        Exact Hessian in the columns of the parameters.
    sensitivities : iterator of RecordSensitivities
        Sensitivities of the predictions of each record, which are made one by one.
    """

    hessian: FloatArray
    shaped: FloatArray
    observed: FloatArray | None
    sensitivities: Iterator[RecordSensitivities]


class RecordInformation(NamedTuple):
    """Information of one record on its own parameters and then its initial state, for the cost ``sum e' W e / 2``.

    Attributes
    ----------
    hessian : (m, m) array
        Gauss-Newton Hessian.
    scores : (n_blocks, m) array
        Minus the gradient, for each block of consecutive samples.
    """

    hessian: FloatArray
    scores: FloatArray


def information_over_records(
    problem: Shooting,
    block: int,
    theta: FloatArray,
    starts: FloatArray,
    record_window: IntArray,
    weight: FloatArray,
    *,
    shaped: FloatArray | None = None,
    observed: bool = False,
) -> Information:
    """Return the information of all records, from a pass over whole segments.

    Parameters
    ----------
    problem : Shooting
        Problem of the fit.
    block : int
        Largest number of samples of a block, for which gradients are summed.
    theta : (n_p,) array
        Free parameters.
    starts : (n_windows, n) array
        Initial states of the windows.
    record_window : (n_records,) integer array
        First window of each record.
    weight : (n_y, n_y) array
        Weight W of the errors.
    shaped : (n_y, n_y) array, optional
        Another weight, for a second Gauss-Newton Hessian.
    observed : bool
        Whether the exact Hessian is computed.

    Returns
    -------
    Information
        Derivatives by parameters and initial states.
    """
    n, n_p = problem.n_states, problem.n_theta
    n_all = n_p + len(record_window) * n
    chains: dict[int, tuple[FloatArray, int]] = {}  # start of the segment at a window: sensitivity, record
    for record, window in enumerate(record_window):
        T = np.zeros((n, n_all))
        T[:, n_p + record * n : n_p + (record + 1) * n] = np.eye(n)
        chains[int(window)] = T, record
    weights = [weight] if shaped is None else [weight, shaped]
    cuts, passes = [], []
    for v, part, first in zip(problem.values(theta), problem.parts, problem.first_window[:-1], strict=True):
        if observed or part.blocks.length < block:  # sensitivities are made of short blocks
            cuts.append(cut(part.blocks.segments, part.predictor, None, longest_block=block))
        else:
            cuts.append(part.blocks.by_whole_segments())
        begin = starts[first + part.blocks.segment_first]
        passes.append(part.kernel.trace(v, cuts[-1], begin, weights))
    sums = [[tied(each.sums, part.tie) for each in own] for part, own in zip(problem.parts, passes, strict=True)]
    _follow_segments(problem, [own[0] for own in sums], chains)
    gauss_newton = [np.zeros((n_all, n_all)) for _ in passes[0]]
    omitted = _omitted(problem, theta, starts, [own[0] for own in sums], weight) if observed else []
    whole = np.zeros((n_all, n_all))
    for k, (part, own) in enumerate(zip(problem.parts, sums, strict=True)):
        windows = problem.first_window[k] + part.blocks.segment_first
        along = [chains[int(window)][0] for window in windows]
        for total, each in zip(gauss_newton, own, strict=True):
            _add(total, part.index, PartHessian(each.hessian, each.hessian_mixed), each.hessian_start, along)
        if observed:
            more = _symmetric(omitted[k], part.tie)
            exact = PartHessian(own[0].hessian + more.theta, own[0].hessian_mixed + more.mixed)
            _add(whole, part.index, exact, own[0].hessian_start, along)
    sensitivities = _sensitivities(problem, theta, cuts, [own[0] for own in passes], chains)
    return Information(gauss_newton[0], gauss_newton[-1], whole if observed else None, sensitivities)


def record_information(
    problem: Shooting, theta: FloatArray, starts: FloatArray, record_window: IntArray, weight: FloatArray
) -> list[RecordInformation]:
    """Return the information of each record on its own parameters, from one pass.

    Parameters
    ----------
    problem : Shooting
        Problem with one segment per record.
    theta : (n_p,) array
        Free parameters.
    starts : (n_windows, n) array
        Initial states of the windows.
    record_window : (n_records,) integer array
        First window of each record.
    weight : (n_y, n_y) array
        Weight W of the errors.

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
            (own,) = part.kernel.trace(v, blocks, starts[first + window][None], [weight])
            mixed = own.sums.hessian_mixed[0]
            found[int(first + window)] = RecordInformation(
                np.block([[own.sums.hessian, mixed], [mixed.T, own.sums.hessian_start[0]]]),
                -_scores(own),
            )
    return [found[int(window)] for window in record_window]


def profiled(information: RecordInformation, kept: IntArray) -> RecordInformation:
    """Return the information on the kept parameters when all others are estimated, too (Schur complement)."""
    H, scores = information
    rest = np.setdiff1d(np.arange(len(H)), kept)
    scale = 1 / np.sqrt(np.maximum(np.diag(H)[rest], 1e-300))
    inner = H[np.ix_(rest, rest)] * np.outer(scale, scale)
    onto = np.linalg.pinv(inner, rcond=1e-12, hermitian=True) @ (H[np.ix_(rest, kept)] * scale[:, None])
    onto *= scale[:, None]
    return RecordInformation(
        H[np.ix_(kept, kept)] - H[np.ix_(kept, rest)] @ onto, scores[:, kept] - scores[:, rest] @ onto
    )


def _scores(own: Traced) -> FloatArray:
    """Return the gradient of each block by the parameters and the start of its window."""
    live = slice(0, int(own.linked.by_theta.shape[0]))
    by_start = own.by_block.gradient_start[live][:, None, :]
    by_theta = own.by_block.gradient[live] + (by_start @ own.linked.by_theta)[:, 0]
    return np.hstack([by_theta, (by_start @ own.linked.by_start)[:, 0]])


def _sensitivities(
    problem: Shooting,
    theta: FloatArray,
    cuts: Sequence[Blocks],
    passes: Sequence[Traced],
    chains: dict[int, tuple[FloatArray, int]],
) -> Iterator[RecordSensitivities]:
    """Make the sensitivities of one record after the other; those of all records would fill the memory."""
    of_record: dict[int, list[tuple[int, int, int]]] = {}  # windows, parts and places of its segments
    for k, (part, first) in enumerate(zip(problem.parts, problem.first_window[:-1], strict=True)):
        for i, window in enumerate(part.blocks.segment_first):
            at = int(first + window)
            of_record.setdefault(chains[at][1], []).append((at, k, i))
    values = problem.values(theta)
    predictions = [
        part.kernel.passed(v, blocks, own.begin)
        for v, part, blocks, own in zip(values, problem.parts, cuts, passes, strict=True)
    ]

    def of(own_segments: list[tuple[int, int, int]]) -> RecordSensitivities:
        segments, feedback = [], None
        for at, k, i in sorted(own_segments):
            own, part = (
                of_segment(problem.parts[k].kernel, values[k], cuts[k], predictions[k], passes[k].linked, i),
                problem.parts[k],
            )
            segments.append((tied_sensitivities(own, part.tie), part.index, chains[at][0]))
            if part.predictor.feeds_back and part.predictor.horizon == 1:
                feedback = tied_values(part.kernel.feedback(values[k], cuts[k], predictions[k]), part.tie), part.index
        return joined_segments(segments, feedback)

    return (of(of_record[record]) for record in sorted(of_record))  # holds none that it has given away


def _symmetric(own: PartHessian, tie: FloatArray | None) -> PartHessian:
    """Return the symmetric part of what Gauss-Newton omits, by the parameters to which those of the part are tied."""
    theta = (own.theta + own.theta.T) / 2
    return PartHessian(theta, own.mixed) if tie is None else PartHessian(tie.T @ theta @ tie, tie.T @ own.mixed)


def _add(
    total: FloatArray, index: IntArray, own: PartHessian, of_starts: FloatArray, along: Sequence[FloatArray]
) -> None:
    """Add the Hessian of a part; the sensitivities `along` convert its starts of windows to all unknowns."""
    total[np.ix_(index, index)] += own.theta
    for mixed, of_start, T in zip(own.mixed, of_starts, along, strict=True):
        across = mixed @ T
        total[index] += across
        total[:, index] += across.T
        total += T.T @ of_start @ T


def _follow_segments(problem: Shooting, sums: Sequence[Sweep], chains: dict[int, tuple[FloatArray, int]]) -> None:
    """Propagate sensitivities from segment to segment of a record, over the stretches that are left out."""
    place: dict[int, tuple[int, int, int]] = {}  # last window of a segment: its first one, its part, its place there
    firsts = set()
    for k, (part, first) in enumerate(zip(problem.parts, problem.first_window[:-1], strict=True)):
        begin = part.blocks.segment_first
        ends = np.append(begin[1:], part.blocks.n_windows) - 1
        place |= {int(first + b): (int(first + a), k, i) for i, (a, b) in enumerate(zip(begin, ends, strict=True))}
        firsts |= {int(first + a) for a in begin}
    for a, b in problem.links:
        if int(b) in firsts and int(a) in place:
            window, k, i = place[int(a)]
            T, record = chains[window]
            following = sums[k].end_start[i] @ T
            following[:, problem.parts[k].index] += sums[k].end_theta[i]
            chains[int(b)] = following, record


def _omitted(
    problem: Shooting, theta: FloatArray, starts: FloatArray, sums: Sequence[Sweep], weight: FloatArray
) -> list[PartHessian]:
    """Return what Gauss-Newton omits for all parameters, with each segment as one window."""
    joined_up, kept = in_one_window(problem)
    _, starts = joined_up.unpack(problem.pack(theta, starts)[kept])
    ends, values = np.zeros_like(starts), problem.values(theta)
    for _ in joined_up.links:  # backwards from the last segments: derivative of the cost by the ends of segments
        made = own_gradients(joined_up, values, starts, ends, weight)
        ends[joined_up.links[:, 0]] = np.concatenate([own.starts for own in made])[joined_up.links[:, 1]]
    return omitted_part(joined_up, theta, starts, ends, [np.diag(s.hessian) for s in sums], weight)
