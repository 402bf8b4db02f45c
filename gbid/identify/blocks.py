"""Records cut into equal blocks that run side by side."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from gbid.identify.data import FitData
from gbid.identify.predictor import Predictor

FloatArray = npt.NDArray[np.float64]
LONGEST_BLOCK = 512  # samples; longer shooting windows are made of several blocks, see gbid.identify.sweep


@dataclass(frozen=True, eq=False)
class Blocks:
    """Regressors and outputs of all records in blocks, the last block of a record padded with zeros.

    Attributes
    ----------
    z : (length, n_z, n_blocks) array
    y : (length, n_outputs, n_blocks) array
    used : (length, n_blocks) array
        1 for a sample that counts, 0 for padding.
    per_window : int
        Blocks in a shooting window; the last window of a record may have fewer.
    window_first : (n_windows,) integer array
        First block of each window.
    window_size : (n_windows,) integer array
        Number of blocks in each window.
    record_first : (n_records,) integer array
        First window of each record.
    n_samples : int
        Samples that count.
    """

    z: FloatArray
    y: FloatArray
    used: FloatArray
    per_window: int
    window_first: npt.NDArray[np.int64]
    window_size: npt.NDArray[np.int64]
    record_first: npt.NDArray[np.int64]
    n_samples: int

    @property
    def length(self) -> int:
        """Samples in a block."""
        return len(self.z)

    @property
    def n_blocks(self) -> int:
        """Number of blocks."""
        return int(self.z.shape[2])

    @property
    def n_windows(self) -> int:
        """Number of shooting windows."""
        return len(self.window_first)

    @property
    def linked(self) -> npt.NDArray[np.int64]:
        """Windows whose end must meet the start of the next, shape (n_gaps,)."""
        last = np.append(self.record_first[1:], self.n_windows) - 1
        return np.setdiff1d(np.arange(self.n_windows), last)


def cut(data: FitData, predictor: Predictor, window: int | None) -> Blocks:
    """Cut records into shooting windows and these into blocks.

    Parameters
    ----------
    data : FitData
    predictor : Predictor
        Says what the regressors are.
    window : int or None
        Samples in a shooting window; None takes each record as one window. A window longer than a block is
        rounded up to whole blocks.

    Returns
    -------
    Blocks
    """
    longest = max(record.n_samples for record in data.records)
    window = longest if window is None else min(window, longest)
    per_window = -(-window // LONGEST_BLOCK)
    length = -(-window // per_window)
    z_parts, y_parts, used_parts = [], [], []
    first: list[int] = []
    size: list[int] = []
    record_first: list[int] = []
    n_blocks = 0
    for record in data.records:
        count = -(-record.n_samples // length)
        z = np.zeros((count * length, predictor.n_z))
        y = np.zeros((count * length, predictor.n_outputs))
        used = np.zeros(count * length)
        z[: record.n_samples] = predictor.regressors(record.inputs, record.outputs)
        y[: record.n_samples] = record.outputs
        used[: record.n_samples] = 1.0
        z_parts.append(z.reshape(count, length, -1))
        y_parts.append(y.reshape(count, length, -1))
        used_parts.append(used.reshape(count, length))
        record_first.append(len(first))
        starts = np.arange(0, count, per_window)
        first += list(n_blocks + starts)
        size += list(np.minimum(per_window, count - starts))
        n_blocks += count

    def stacked(parts: list[FloatArray]) -> FloatArray:
        return np.ascontiguousarray(np.concatenate(parts).transpose(1, 2, 0))

    return Blocks(
        stacked(z_parts),
        stacked(y_parts),
        np.ascontiguousarray(np.concatenate(used_parts).T),
        per_window,
        np.array(first),
        np.array(size),
        np.array(record_first),
        data.n_samples,
    )
