"""Segments of records: cut at left-out samples, grouped by predictor, and the links between windows."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from gbid.arrays import FloatArray, IntArray
from gbid.errors import DataError, UsageError
from gbid.identify.data import Record
from gbid.identify.kernel.blocks import LANES, LONGEST_BLOCK, Segment, cut
from gbid.identify.kernel.engine import EngineName, RunEngine
from gbid.identify.kernel.general_predictor import GeneralPredictor
from gbid.identify.kernel.kernel_protocol import Kernel
from gbid.identify.nlp.record_group import RecordGroup
from gbid.identify.problem.either_kind import choose_kernel


@dataclass(frozen=True, eq=False)
class Stretch:
    """Consecutive samples of a record that all count, or a gap between such."""

    segment: Segment
    is_gap: bool


def stretches(record: Record, ranges: Sequence[tuple[int, int]], predictor: GeneralPredictor) -> list[Stretch]:
    """Cut a record at what is left out.

    Without feedback of the outputs the model runs through and those samples just do not count. With feedback
    the model runs through them on its own: a stretch of simulation between two of prediction.
    """
    n = record.n_samples
    counts = np.ones(n)
    for start, stop in ranges:
        if not 0 <= start < stop <= n:
            raise DataError(f"recording {record.name!r}: left out samples {start} to {stop} are not within its {n}")
        counts[start:stop] = 0.0
    if counts.all():
        return [Stretch(Segment(record.inputs, record.outputs), False)]
    if not counts.any():
        raise DataError(f"recording {record.name!r}: all samples are left out")
    if not predictor.feeds_back:
        return [Stretch(Segment(record.inputs, record.outputs, counts), False)]
    if predictor.horizon > 1:
        raise UsageError("left_out with a disturbance gain and a horizon beyond 1 is not possible; choose one")
    edges = [0, *(np.flatnonzero(np.diff(counts)) + 1).tolist(), n]
    return [
        Stretch(Segment(record.inputs, record.outputs, counts, start=a, stop=b), counts[a] == 0)
        for a, b in itertools.pairwise(edges)
    ]


_Key = tuple[int, tuple[int, ...], bytes]  # of a predictor, its parameters, and how they are tied


def in_pieces(stretches: Sequence[Stretch], edges: Sequence[int]) -> list[tuple[Stretch, int]]:
    """Cut stretches of a record at further samples; return each with the number of its piece, from 0."""
    found = []
    for stretch in stretches:
        own = stretch.segment
        stop = len(own.outputs) if own.stop is None else own.stop
        inside = [own.start, *(e for e in edges if own.start < e < stop), stop]
        for a, b in itertools.pairwise(inside):
            piece = sum(e <= a for e in edges)
            found.append((Stretch(replace(own, start=a, stop=b), stretch.is_gap), piece))
    return found


class GroupBuilder:
    """Collects segments of the same predictor and parameters, and cuts them together.

    Parameters
    ----------
    window : int or None
        Samples in a shooting window; None for one window for each segment.
    begin : dict of str to float
        Start values, at which the engine looks which entries of the predictor are zero for good.
    engine : {"auto", "compiled", "numpy"}
    """

    def __init__(self, window: int | None, begin: Mapping[str, float], engine: EngineName) -> None:
        self._window, self._begin, self._engine = window, begin, engine
        self._groups: dict[_Key, tuple[GeneralPredictor, FloatArray | None, list[Segment]]] = {}
        self._order: list[tuple[_Key, int]] = []
        self.engine_name: RunEngine = "numpy"
        self.notes: list[str] = []

    def add(
        self, predictor: GeneralPredictor, index: tuple[int, ...], segment: Segment, tie: FloatArray | None = None
    ) -> None:
        """Add a segment; `index` and `tie` as in `RecordGroup`."""
        key = (id(predictor), index, b"" if tie is None else tie.tobytes())
        _, _, segments = self._groups.setdefault(key, (predictor, tie, []))
        self._order.append((key, len(segments)))
        segments.append(segment)

    def build(self) -> tuple[tuple[RecordGroup, ...], list[tuple[int, int]]]:
        """Return the parts, and first and last window (over all parts) of each segment in the order of adding."""
        parts, windows_of = [], {}
        kernels: dict[int, Kernel] = {}
        base = 0
        for key, (predictor, tie, segments) in self._groups.items():
            predictor_id, index, _ = key
            if predictor_id not in kernels:
                chosen = choose_kernel(self._engine, predictor, self._begin)
                kernels[predictor_id] = chosen.kernel
                self.engine_name = chosen.name
                self.notes += chosen.notes
            # A lone short segment fills all lanes with blocks of itself.
            longest = max(len(s.part(s.outputs)) for s in segments)
            size = -(-longest // LANES) if len(segments) == 1 and tie is not None else LONGEST_BLOCK
            blocks = cut(segments, predictor, self._window, longest_block=min(size, LONGEST_BLOCK))
            part = RecordGroup(predictor, blocks, np.array(index), kernels[predictor_id], tie)
            parts.append(part)
            ends = np.append(blocks.segment_first[1:], blocks.n_windows) - 1
            for i, (a, b) in enumerate(zip(blocks.segment_first, ends, strict=True)):
                windows_of[key, i] = (base + int(a), base + int(b))
            base += blocks.n_windows
        return tuple(parts), [windows_of[item] for item in self._order]


def links_of(windows: list[tuple[int, int]], counts: list[int]) -> IntArray:
    """Return the links: neighbouring windows within each segment, and across the segments of one record."""
    links, i = [], 0
    for count in counts:
        for j in range(count):
            first, last = windows[i + j]
            links += [(w, w + 1) for w in range(first, last)]
            if j + 1 < count:
                links.append((last, windows[i + j + 1][0]))
        i += count
    return np.array(links, dtype=np.int64).reshape(-1, 2)


def record_windows(windows: list[tuple[int, int]], counts: list[int]) -> IntArray:
    """Return the first window of each record, from the windows and numbers of segments."""
    firsts = np.cumsum([0, *counts[:-1]])
    return np.array([windows[i][0] for i in firsts])
