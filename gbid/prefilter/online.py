"""Online prefilter for a controller, sample by sample; where no spike is found, equal to the offline filter."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from gbid.arrays import FloatArray
from gbid.errors import DataError, UsageError
from gbid.prefilter.runout import RunoutMap


class OnlinePrefilter:
    """Online prefilter: run-out map, constant offset and median, one sample at a time (paper, Sec. 3.5 and conclusion).

    The results are those of `gbid.prefilter` on the whole recording, to the last bit, with three differences that every
    causal filter has:

    - Spikes stay. To tell a spike from a step of the signal, the offline filter needs later samples: seven to judge a
      sample, two to replace it. Where the offline filter finds no spike, both filters agree. A controller that must not
      see spikes takes ``median=3``.
    - The median of 3 needs the next sample. `step` therefore returns the value of ``median // 2`` samples ago: one
      sample (0.2 ms) for the median of 3 in the paper, none for ``median=1``. The first ``median // 2`` calls return
      None. `finish` returns the remaining values.
    - The mean of a recording is known only at its end. Online it is replaced by a constant `offset`. The default zero
      makes the mean of the map the zero and equals the offline filter with ``remove_mean=False``. With
      ``offset=report.offsets["p"]`` of an earlier recording the same mean is removed as from that one.

    Parameters
    ----------
    runout_map : RunoutMap or None
        Map from `gbid.identify_runout` at the present operating point; None removes no run-out.
    offset : (n_channels,) array, optional
        Offset that is subtracted after the map [m]; zero by default.
    median : int
        Size of the median, odd; 1 for none.

    Raises
    ------
    UsageError
        When `median` is not odd and positive, or when `offset` does not fit the channels of the map.

    Examples
    --------
    >>> online = OnlinePrefilter(None, median=3)
    >>> [online.step([value], None) for value in (0.0, 1.0, 2.0)]
    [None, array([0.]), array([1.])]
    >>> online.finish()
    [array([2.])]
    """

    def __init__(self, runout_map: RunoutMap | None, *, offset: npt.ArrayLike | None = None, median: int = 1) -> None:
        if median < 1 or median % 2 == 0:
            raise UsageError(f"median = {median}; give an odd number of samples, 1 for none")
        self._map = runout_map
        self._offset = None if offset is None else np.atleast_1d(np.asarray(offset, dtype=float))
        if runout_map is not None and self._offset is not None and self._offset.shape != runout_map.mean.shape:
            raise UsageError(f"offset has shape {self._offset.shape}, the run-out map {runout_map.mean.shape} channels")
        self._half = median // 2
        self._window: deque[FloatArray] = deque(maxlen=median)
        self.start()

    @property
    def delay(self) -> int:
        """Delay of the output in samples: half the size of the median, rounded down."""
        return self._half

    def change_map(self, runout_map: RunoutMap) -> None:
        """Use another map from the next sample on, as at another operating point; the state is kept.

        Parameters
        ----------
        runout_map : RunoutMap
            The new map, of the same channels.

        Raises
        ------
        UsageError
            When the channels differ.
        """
        if self._map is None or self._map.mean.shape != runout_map.mean.shape:
            raise UsageError("change_map: the new run-out map has other channels than the one before")
        self._map = runout_map

    def start(self) -> None:
        """Reset the filter and forget all earlier samples."""
        self._window.clear()
        self._count = 0

    def step(self, position: Sequence[float] | FloatArray, angle: float | None) -> FloatArray | None:
        """Return the filtered position after one more sample.

        Parameters
        ----------
        position : (n_channels,) sequence of float
            Measured disc position [m].
        angle : float or None
            Shaft angle [rad], wrapped or not; None is allowed when the map needs no angle.

        Returns
        -------
        (n_channels,) array or None
            The filtered position of `delay` samples ago [m]; None for the first samples.

        Raises
        ------
        DataError
            When a number is not finite, when the channels do not fit the map, or when the angle is missing. The state
            is not changed, so the caller may leave the sample out and go on.
        """
        newest = self._without_runout(np.asarray(position, dtype=float), angle)
        self._window.append(newest)
        self._count += 1
        if self._count <= self._half:
            return None
        if self._count <= 2 * self._half:  # the first samples stay as they are, as offline
            return self._window[self._count - 1 - self._half].copy()
        return np.asarray(np.sort(np.array(self._window), axis=0)[self._half])

    def finish(self) -> list[FloatArray]:
        """Return the remaining values and reset the filter; as offline, the median does not change these last samples.

        Returns
        -------
        list of (n_channels,) array
            At most `delay` values, the oldest first [m].
        """
        held = min(self._half, self._count)
        rest = list(self._window)[len(self._window) - held :]
        self.start()
        return rest

    def _without_runout(self, position: FloatArray, angle: float | None) -> FloatArray:
        if position.ndim != 1 or not np.isfinite(position).all():
            raise DataError(f"position {position} is not one sample of finite numbers; leave the sample out")
        made, value = self._map, position
        if made is not None:
            if position.shape != made.mean.shape:
                raise DataError(f"position has {len(position)} channels, the run-out map {len(made.mean)}")
            if not made.needs_angle:
                value = value - made.mean
            elif angle is None or not np.isfinite(angle):
                raise DataError(f"angle = {angle}; the run-out map needs the shaft angle [rad] of each sample")
            else:
                value = value - made.evaluate(np.array([float(angle)]))[0]
        return np.asarray(value if self._offset is None else value - self._offset)
