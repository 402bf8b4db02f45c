"""Shooting windows of records, cut into blocks that run in parallel lanes; results of a pass."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from gbid.core.arrays import BoolArray, FloatArray, IntArray
from gbid.identify.data import FitData
from gbid.identify.predictor import GeneralPredictor

LONGEST_BLOCK = 512  # samples; a longer shooting window consists of several blocks, see gbid.identify.kernel.sums
_LONGEST_WITH_GAPS = 64  # the same where numpy runs all blocks side by side, sample by sample
_KEPT_BYTES = 2**21  # regressors that stay where others are made: those of a short record are wanted again soon
_AT_ONCE = 32_768  # samples whose regressors are made together
LANES = 8  # blocks in one group, as in vectors.c: number of doubles in the widest vector register


class GapGains(NamedTuple):
    """Weights and Kalman gains of the samples of a segment, for a `gbid.identify.kernel.gaps.GapKernel`.

    Attributes
    ----------
    columns : (n_samples, m) array
        Entries of T (n_y, n_y) and L of each sample of the record; they stand behind its regressors.
    absent : (n_y, n_y) array
        Expected products of the weighted errors that are missing in samples with other outputs.
    spread : float
        What is added to -2 log-likelihood: the logarithms of the determinants of the covariances of errors over that of
        the innovations, less ``1 + log(2 pi)`` for each output that is missing beside others.
    """

    columns: FloatArray
    absent: FloatArray
    spread: float = 0.0


@dataclass(frozen=True, eq=False)
class Segment:
    """Consecutive samples of a record.

    Attributes
    ----------
    inputs : (n_samples, n_inputs) array
        Inputs of the whole record, because delayed and following inputs are outside the part.
    outputs : (n_samples, n_outputs) array
        Outputs of the whole record.
    counts : (n_samples,) array or None
        1 for samples in the cost, 0 for samples left out; None when all count.
    start, stop : int
        First sample and the sample after the last; `stop` is None at the end of the record.
    weights : (n_samples,) array or None
        Weights of the squared errors of all samples of the record; None when all are 1.
    missing : (n_samples, n_outputs) boolean array or None
        Outputs of the record that are missing, with values in their place; None when none is.
    gains : GapGains or None
        What a kernel for missing samples needs; None for other kernels.
    time : (n_samples,) array or None
        Irregular times of the record [s]; None for even ones.
    """

    inputs: FloatArray
    outputs: FloatArray
    counts: FloatArray | None = None
    start: int = 0
    stop: int | None = None
    weights: FloatArray | None = None
    missing: BoolArray | None = None
    gains: GapGains | None = None
    time: FloatArray | None = None

    @property
    def is_plain(self) -> bool:
        """Whether all outputs are measured, at even times."""
        return self.missing is None and self.time is None

    @property
    def present(self) -> BoolArray:
        """Which outputs of the segment are measured, (n, n_outputs)."""
        return ~np.isnan(self.part(self.measured))

    @property
    def measured(self) -> FloatArray:
        """Outputs of the whole record, NaN where they are missing."""
        return self.outputs if self.missing is None else np.where(self.missing, np.nan, self.outputs)

    @property
    def targets(self) -> FloatArray:
        """Outputs to predict, (n, n_outputs), multiplied by the weights of `gains`."""
        if self.gains is None:
            return self.part(self.outputs)
        n_y = self.outputs.shape[1]
        T = self.gains.columns[:, : n_y**2].reshape(-1, n_y, n_y)
        return self.part(np.einsum("kij,kj->ki", T, self.outputs))

    def part(self, rows: FloatArray) -> FloatArray:
        """Return the rows of a record's array that belong to the segment."""
        return rows[self.start : self.stop]

    @property
    def is_left_out(self) -> bool:
        """Whether no sample of the segment is in the cost."""
        return self.counts is not None and not self.part(self.counts).any()


@dataclass(frozen=True, eq=False)
class Blocks:
    """Segments cut into blocks of equal length, in groups of eight (`lanes`); short blocks are padded.

    Attributes
    ----------
    y : (n_groups, length, n_outputs, lanes) array
        Outputs to predict.
    used : (n_groups, length, lanes) array
        Root of the weight of a sample in the cost: 1 without weights; 0 for a sample left out and for padding.
    size : (n_groups * lanes,) integer array
        Number of samples in each block: `length`, or fewer in the last block of a segment; 0 for padding.
    per_window : int
        Number of blocks in a shooting window; the last window of a segment may have fewer.
    window_first, window_size : (n_windows,) integer array
        First block and number of blocks of each window.
    segment_first : (n_segments,) integer array
        First window of each segment.
    n_samples : int
        Number of samples in the cost.
    predictor : GeneralPredictor
        Predictor of these blocks; it defines the regressors.
    segments : tuple of Segment
        Segments in the blocks.
    ends_from_zero : list of (predictor, (n, W) array)
        Ends of blocks that begin at zero, for the last predictor; kept by the kernel.
    """

    y: FloatArray
    used: FloatArray
    size: IntArray
    per_window: int
    window_first: IntArray
    window_size: IntArray
    segment_first: IntArray
    n_samples: int
    predictor: GeneralPredictor
    segments: tuple[Segment, ...]
    _regressors: dict[tuple[int, ...], FloatArray] = field(default_factory=dict)
    ends_from_zero: list[tuple[Any, FloatArray]] = field(default_factory=list)

    @property
    def gains(self) -> list[GapGains]:
        """GapGains of the segments, without segments that have none."""
        return [segment.gains for segment in self.segments if segment.gains is not None]

    @property
    def length(self) -> int:
        """Number of samples in a block."""
        return int(self.y.shape[1])

    @property
    def lanes(self) -> int:
        """Number of blocks in a group."""
        return int(self.y.shape[3])

    @property
    def n_windows(self) -> int:
        """Number of shooting windows."""
        return len(self.window_first)

    @property
    def n_blocks(self) -> int:
        """Number of blocks, not counting padding."""
        return int(self.window_size.sum())

    @cached_property
    def uneven(self) -> IntArray:
        """Blocks with samples outside the cost, or with a weight other than 1."""
        return np.flatnonzero((self.used != 1).any(axis=1))

    @cached_property
    def followed(self) -> IntArray:
        """Blocks with a next block in their window."""
        return np.setdiff1d(np.arange(self.n_blocks), self.window_first) - 1

    @cached_property
    def by_window(self) -> tuple[IntArray, BoolArray]:
        """Indices of the blocks of each window, (n_windows, per_window), and a mask of valid entries."""
        place = np.arange(self.per_window)
        return np.minimum(self.window_first[:, None] + place, self.n_blocks - 1), place < self.window_size[:, None]

    @property
    def window_samples(self) -> list[tuple[Segment, int]]:
        """Segment of each window, and the index of its first sample in the record."""
        blocks = self.window_first[self.segment_first]
        of = np.searchsorted(self.segment_first, np.arange(self.n_windows), side="right") - 1
        within = (self.window_first - blocks[of]) * self.length
        return [(self.segments[i], self.segments[i].start + k) for i, k in zip(of, within.tolist(), strict=True)]

    def z(self, shift: tuple[int, ...]) -> FloatArray:
        """Return the regressors for given whole-sample delays, shape (n_groups, length, n_z, lanes)."""
        if shift not in self._regressors:
            if len(self._regressors) > 3:
                self._regressors.clear()
            self._regressors[shift] = in_groups(self._rows(shift), self.length, len(self.y))
        return self._regressors[shift]

    def release(self) -> None:
        """Free the memory of large regressors; they are recomputed when needed, in less time than a pass."""
        if sum(rows.nbytes for rows in self._regressors.values()) > _KEPT_BYTES:
            self._regressors.clear()

    def _rows(self, shift: tuple[int, ...]) -> Iterator[FloatArray]:
        """Yield the regressors of consecutive batches of blocks, in memory that is reused."""
        count = max(1, _AT_ONCE // self.length) * self.length
        for p in self.segments:
            stop = len(p.inputs) if p.stop is None else p.stop
            edges = [(first, min(first + count, stop)) for first in range(p.start, stop, count)]
            rows = self.predictor.regressor_rows(p.inputs, p.measured, shift, edges, p.time)
            for made, (first, end) in zip(rows, edges, strict=True):
                yield made if p.gains is None else np.hstack([made, p.gains.columns[first:end]])

    def with_segments(self, segments: Iterable[Segment]) -> Blocks:
        """Return the blocks with regressors of other segments, which have the same lengths."""
        return replace(self, segments=tuple(segments), _regressors={}, ends_from_zero=[])

    def with_samples_of(self, other: Blocks) -> Blocks:
        """Return the blocks with the sample weights of other blocks of these records; outputs are shared."""
        return replace(self, used=other.used, y=self.y if self.gains else other.y)

    def by_whole_segments(self) -> Blocks:
        """Return the blocks with one window for each segment."""
        first = self.window_first[self.segment_first]
        size = np.diff(np.append(first, self.n_blocks))
        every = np.arange(len(first))
        return replace(self, per_window=int(size.max()), window_first=first, window_size=size, segment_first=every)

    def by_group(self, values: FloatArray) -> FloatArray:
        """Return values of blocks, (n, W), in the layout of the compiled passes, (n_groups, n, lanes)."""
        return np.ascontiguousarray(values.reshape(len(values), -1, self.lanes).transpose(1, 0, 2))

    def side_by_side(self, values: FloatArray, some: slice) -> FloatArray:
        """Return values of selected blocks, (n_groups, length, n, lanes), as (length, n, n_blocks)."""
        groups = slice(some.start // self.lanes, -(-some.stop // self.lanes))
        rows = values[groups].transpose(1, 2, 0, 3).reshape(self.length, values.shape[2], -1)
        skipped = groups.start * self.lanes
        return rows[:, :, some.start - skipped : some.stop - skipped]

    def by_segment(self, values: FloatArray) -> list[FloatArray]:
        """Return values of blocks, (n_groups, length, n, lanes), as an array (n_samples, n) for each segment."""
        rows = values.transpose(0, 3, 1, 2).reshape(-1, self.length, values.shape[2])
        edges = pairwise([*self.window_first[self.segment_first].tolist(), self.n_blocks])
        return [rows[a:b].reshape(-1, values.shape[2])[: int(self.size[a:b].sum())] for a, b in edges]


def cut(
    data: FitData | Sequence[Segment],
    predictor: GeneralPredictor,
    window: int | None,
    *,
    longest_block: int = LONGEST_BLOCK,
) -> Blocks:
    """Cut segments into shooting windows, and these into blocks.

    Parameters
    ----------
    data : FitData or sequence of Segment
        Records, or parts of them.
    predictor : GeneralPredictor
        Predictor, which defines the regressors.
    window : int or None
        Number of samples in a shooting window; None makes each segment one window. A window that is longer than a block
        is rounded up to whole blocks.
    longest_block : int
        Largest number of samples in a block.

    Returns
    -------
    Blocks
        Blocks in groups, with the windows and segments that they belong to.
    """
    if isinstance(data, FitData):
        data = [Segment(record.inputs, record.outputs) for record in data.records]
    segments = tuple(data)
    if any(segment.gains is not None for segment in segments):
        longest_block = min(longest_block, _LONGEST_WITH_GAPS)
    targets = [segment.targets for segment in segments]
    longest = max(len(target) for target in targets)
    window = longest if window is None else min(window, longest)
    per_window = -(-window // longest_block)
    length = -(-window // per_window)
    first, size, segment_first, block_size = list[int](), list[int](), list[int](), list[int]()
    for target in targets:
        n = len(target)
        count = -(-n // length)
        starts = np.arange(0, count, per_window)
        segment_first.append(len(first))
        first += (len(block_size) + starts).tolist()
        size += np.minimum(per_window, count - starts).tolist()
        block_size += [length] * (count - 1) + [n - (count - 1) * length]
    n_groups = -(-len(block_size) // LANES)
    y = in_groups(targets, length, n_groups)
    block_size += [0] * (n_groups * LANES - len(block_size))
    return Blocks(
        y,
        _use(segments, length, n_groups),
        np.array(block_size, np.int64),
        per_window,
        np.array(first),
        np.array(size),
        np.array(segment_first),
        int(sum(_of_samples(segment, segment.counts).sum() for segment in segments)),
        predictor,
        segments,
    )


def reweighted(blocks: Blocks, weights: Sequence[FloatArray]) -> Blocks:
    """Return blocks with new weights of the squared errors; weights are one array for each segment."""
    segments = []
    for segment, squared in zip(blocks.segments, weights, strict=True):
        full = np.ones(len(segment.outputs))
        segment.part(full)[:] = squared
        segments.append(replace(segment, weights=full))
    used = _use(segments, blocks.length, len(blocks.y))
    return replace(blocks, segments=tuple(segments), used=used)


def _use(segments: Sequence[Segment], length: int, n_groups: int) -> FloatArray:
    """Return the square roots of sample weights as groups of blocks, (n_groups, length, lanes)."""
    counts = (_of_samples(segment, segment.counts) for segment in segments)
    rows = (
        used if segment.weights is None else used * np.sqrt(_of_samples(segment, segment.weights))
        for segment, used in zip(segments, counts, strict=True)
    )
    return in_groups(rows, length, n_groups)[:, :, 0]


def _of_samples(segment: Segment, values: FloatArray | None) -> FloatArray:
    """Return a record's values at the samples of a segment, (n, 1); ones for None."""
    return segment.part(np.broadcast_to(1.0, len(segment.outputs)) if values is None else values)[:, None]


def in_groups(parts: Iterable[FloatArray], length: int, n_groups: int) -> FloatArray:
    """Return (n_samples, n) arrays as groups of blocks, (n_groups, length, n, lanes)."""
    block = 0
    for part in parts:
        if not block:
            groups = np.zeros((n_groups, length, part.shape[1], LANES))
            by_block = groups.transpose(0, 3, 1, 2)
        for first in range(0, len(part), length):
            piece = part[first : first + length]
            by_block[block // LANES, block % LANES, : len(piece)] = piece
            block += 1
    return groups


class BlockSums(NamedTuple):
    """Results of a pass: sums over all blocks, and values of each of the W blocks (with padding).

    Attributes
    ----------
    hessian : (n_p, n_p) array
        Gauss-Newton Hessian by the parameters.
    products : (n_y, n_y) array
        Sum of the products of errors.
    gradient : (W, n_p) array
        Gradient by the parameters.
    gradient_start : (W, n) array
        Gradient by the start state of each block.
    mixed : (W, n_p, n) array
        Gauss-Newton Hessian by parameters and start state.
    end : (W, n) array
        State at the end of each block.
    end_theta : (W, n, n_p) array
        Derivative of this state by the parameters.
    """

    hessian: FloatArray
    products: FloatArray
    gradient: FloatArray
    gradient_start: FloatArray
    mixed: FloatArray
    end: FloatArray
    end_theta: FloatArray


class Prediction(NamedTuple):
    """States and errors of all blocks in a pass without sensitivities.

    Attributes
    ----------
    states : (n_groups, length, n, lanes) array
    errors : (n_groups, length, n_y, lanes) array
        ``y - yhat``, zero where samples do not count.
    end : (n, W) array
        State after the whole length of each block, padding included.
    """

    states: FloatArray
    errors: FloatArray
    end: FloatArray

    @property
    def products(self) -> FloatArray:
        """Products ``sum e e'`` of the errors of each block, (W, n_y, n_y)."""
        e = self.errors.transpose(0, 3, 2, 1)
        return np.asarray(e @ e.swapaxes(2, 3)).reshape(-1, e.shape[2], e.shape[2])


def per_block(values: FloatArray) -> FloatArray:
    """Return values of groups of blocks, (n_groups, ..., lanes), block by block, (W, ...)."""
    return np.ascontiguousarray(np.moveaxis(values, -1, 1)).reshape(-1, *values.shape[1:-1])


def at_windows(blocks: Blocks, starts: FloatArray) -> FloatArray:
    """Return window starts (n_windows, n) as block starts, (n, W), where every window is one block."""
    begin = np.zeros((starts.shape[1], len(blocks.size)))
    begin[:, : blocks.n_windows] = starts.T
    return begin
