"""Alignment of recordings without encoder index: the run-out shows the offset of the shaft angle."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from gbid.arrays import FloatArray
from gbid.brief import Brief
from gbid.errors import DataError, UsageError
from gbid.prefilter.runout import TURN, RunoutMap
from gbid.prefilter.shaft import ShaftMotion, shaft_motion
from gbid.recording import Recording

SURE = 5.0
"""Number of standard deviations by which every other offset must be worse."""
INDEX_OFF = np.deg2rad(10.0)
"""Smallest rotation of a recording's run-out against the map that shows a missed index [rad]."""
_GRID = 3600  # evaluated offsets; the minima are refined
_MAX_BLOCKS = 20


@dataclass(frozen=True, eq=False)
class IndexAlignment(Brief):
    """Offset between the zero of the encoder in a recording and that of a run-out map.

    Attributes
    ----------
    offset : float
        Angle to add to the recorded angle, within [0, 2 pi) [rad].
    std : float
        Its standard deviation [rad].
    margin : float
        Number of standard deviations by which the next best offset is worse. It is small for run-out with few
        harmonics, which repeats after part of a turn.
    next_best : float
        The next best offset [rad].
    explained : float
        Share of the mean square of the synchronous motion that the aligned map explains. It is near 1 when the map
        holds for the recording, and small or negative for another operating point or machine.
    offsets, misfit : (n,) array
        Evaluated offsets [rad], and the squared deviation at each, in squared standard deviations, for a figure.
    """

    offset: float
    std: float
    margin: float
    next_best: float
    explained: float
    offsets: FloatArray
    misfit: FloatArray

    @property
    def sure(self) -> bool:
        """Whether the next best offset is worse by 5 standard deviations or more and the map explains at least half."""
        return self.margin >= SURE and self.explained >= 0.5

    def apply(self, rec: Recording) -> Recording:
        """Return the recording with its angle counted from the zero of the map.

        Parameters
        ----------
        rec : Recording
            The aligned recording, or another one from the same run of the encoder.

        Raises
        ------
        DataError
            When the offset is not sure. If you know the offset, add it to phi yourself.
        """
        if not self.sure:
            raise DataError(
                f"recording {rec.name!r}: the missing index cannot be found from the run-out: "
                f"{np.rad2deg(self.offset):.1f} or {np.rad2deg(self.next_best):.1f} degrees "
                f"({self.margin:.1f} standard deviations apart, {self.explained:.0%} explained); "
                "use a longer recording, or one with the index"
            )
        note = f"{np.rad2deg(self.offset):.3f} degrees added to phi (std {np.rad2deg(self.std):.3f})"
        aligned = rec.with_signals(phi=np.mod(rec.signal("phi") + self.offset, TURN))
        return replace(aligned, provenance={**rec.provenance, "index": note})


def align_index(runout_map: RunoutMap, recording: Recording, *, orders: int = 10) -> IndexAlignment:
    r"""Return the angle offset of a recording whose encoder had no index.

    Let :math:`A_n` be the harmonics of the recorded position over the recorded angle, and :math:`M_n` those of the
    map. They differ by a rotation: :math:`A_n = M_n e^{i n \delta}`. The offset minimises :math:`J(\delta) = \sum_n
    |A_n - M_n e^{i n \delta}|^2 / \sigma_n^2` over all channels. This is a circular correlation with one weight for
    each harmonic. The variance :math:`\sigma_n^2` comes from the scatter between parts of the recording and from the
    residuals of the map. The piezos may move, because their motion only adds scatter. The curvature at the minimum
    gives the standard deviation. The margin of the choice is :math:`\sqrt{J(\delta_2) - J(\delta)}`, where
    :math:`\delta_2` is the next lowest minimum.

    Parameters
    ----------
    runout_map : RunoutMap
        Map from recordings with one common zero of the angle, at the same operating point.
    recording : Recording
        Recording with p and phi and at least 8 turns. The piezos may move.
    orders : int
        Number of harmonics, at most those of the map.

    Returns
    -------
    IndexAlignment

    Raises
    ------
    UsageError
        When `orders` is below 1, or when the map is of a shaft at rest.
    DataError
        When signals are missing, when channels differ, or when there are too few turns.
    """
    if orders < 1:
        raise UsageError(f"orders = {orders}; give at least 1")
    if not runout_map.needs_angle:
        raise UsageError("the run-out map is that of a shaft at rest; it knows no angle to align")
    p, motion = recording.signal("p"), shaft_motion(recording)
    if recording.channels["p"] != runout_map.channels:
        raise DataError(f"recording {recording.name!r} and the run-out map differ in the channels of p")
    if motion.turns < 8:
        raise DataError(
            f"recording {recording.name!r}: {motion.turns:.1f} turns are too few to find the index; "
            "at least 8 are needed"
        )
    expected = _map_phasors(runout_map, orders)
    n = np.arange(1.0, len(expected) + 1)
    parts = _phasors(motion, p, n)
    measured = parts.mean(axis=0)
    variance = parts.var(axis=0, ddof=1) / len(parts)  # sum for the real and imaginary part
    # The map has errors, too: white noise of rms_after, averaged over the samples in its turns.
    n_map = recording.n_samples * max(runout_map.turns, 1.0) / motion.turns
    variance = variance + 4 * runout_map.rms_after**2 / n_map
    variance = np.maximum(variance, 1e-12 * float(np.abs(expected).max()) ** 2)  # noise-free data: finite weights

    def misfit(offset: FloatArray) -> FloatArray:
        turned = expected[None] * np.exp(1j * n[None, :, None] * offset[:, None, None])
        return np.asarray(np.sum(2 * np.abs(measured[None] - turned) ** 2 / variance[None], axis=(1, 2)))

    grid = np.arange(_GRID) * TURN / _GRID
    curve = misfit(grid)
    minima = np.flatnonzero((curve <= np.roll(curve, 1)) & (curve < np.roll(curve, -1)))
    refined = [_refined(misfit, grid[i]) for i in minima]
    refined.sort(key=lambda entry: entry[1])
    offset, least, curvature = refined[0]
    other, other_misfit = refined[1][:2] if len(refined) > 1 else ((offset + np.pi) % TURN, float(curve.max()))
    aligned = expected * np.exp(1j * n[:, None] * offset)
    return IndexAlignment(
        offset=offset,
        std=float(np.sqrt(2 / curvature)),
        margin=float(np.sqrt(max(other_misfit - least, 0.0))),
        next_best=other,
        explained=float(1 - np.sum(np.abs(measured - aligned) ** 2) / np.sum(np.abs(measured) ** 2)),
        offsets=grid,
        misfit=curve,
    )


def refuse_lost_index(runout_map: RunoutMap, recording: Recording) -> None:
    """Refuse a recording whose run-out is that of the map but rotated; the map would then add run-out.

    Parameters
    ----------
    runout_map : RunoutMap
        A map over the angle.
    recording : Recording
        Recording with p and phi at the same operating point. One that is too short for an estimate is accepted.

    Raises
    ------
    DataError
        When the zero of the angle is another one.
    """
    try:
        found = align_index(runout_map, recording)
    except DataError:
        return  # too short for an estimate of the rotation
    off = abs(np.angle(np.exp(1j * found.offset)))
    if found.sure and off > max(INDEX_OFF, SURE * found.std):
        raise DataError(
            f"recording {recording.name!r}: its run-out is that of {', '.join(runout_map.sources)}, but rotated by "
            f"{np.rad2deg(off):.1f} degrees (std {np.rad2deg(found.std):.1f}), so phi does not start at the "
            "same zero: the encoder missed its index; write prefilter: align_index: true, or record again"
        )


def _map_phasors(runout_map: RunoutMap, orders: int) -> FloatArray:
    """Return the complex amplitudes of the harmonics 1, 2, ... of the map, (n_orders, n_channels)."""
    highest = int(runout_map.orders.max()) if runout_map.orders.size else len(runout_map.angles) // 2
    n_points = 4096
    values = runout_map.evaluate(np.arange(n_points) * TURN / n_points)
    return np.asarray(np.fft.rfft(values, axis=0)[1 : min(orders, highest) + 1] * 2 / n_points)


def _phasors(motion: ShaftMotion, p: FloatArray, orders: FloatArray) -> FloatArray:
    """Return the complex amplitudes in several parts of whole turns, (n_parts, n_orders, n_channels)."""
    course = np.abs(np.unwrap(motion.angle) - motion.angle[0])
    n_parts = int(min(_MAX_BLOCKS, motion.turns // 2))
    edges = np.searchsorted(course, TURN * np.floor(motion.turns / n_parts) * np.arange(n_parts + 1))
    parts = []
    for first, last in pairwise(edges):
        phase = np.outer(motion.angle[first:last], orders)
        basis = np.hstack([np.ones((last - first, 1)), np.cos(phase), np.sin(phase)])
        solution = np.linalg.lstsq(basis, p[first:last], rcond=None)[0]
        cosine, sine = np.split(solution[1:], 2)
        parts.append(cosine - 1j * sine)
    return np.array(parts)


def _refined(misfit: object, start: float) -> tuple[float, float, float]:
    """Return the minimum of the parabola through three neighbours: its place, its value and the curvature."""
    assert callable(misfit)
    step = TURN / _GRID
    for _ in range(3):
        low, mid, high = misfit(np.array([start - step, start, start + step]))
        curvature = (low - 2 * mid + high) / step**2
        if curvature <= 0:
            break
        start = start + np.clip((low - high) / (2 * step * curvature), -step, step)
        step /= 4
    value = float(misfit(np.array([start]))[0])
    return float(np.mod(start, TURN)), value, float(max(curvature, 1e-300))
