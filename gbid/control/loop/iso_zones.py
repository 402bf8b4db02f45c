"""Zones of ISO 14839-3 for the stability margin of a loop, by the peak of its sensitivity in each axis."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from math import inf, nan
from typing import Literal

import numpy as np
import numpy.typing as npt

from gbid.arrays import FloatArray
from gbid.brief import Brief, Description, brief
from gbid.control.loop.norm import refine_maxima
from gbid.control.loop.sensitivity import Sensitivities

Zone = Literal["A", "B", "C", "D"]
ISO_LIMITS: dict[Zone, float] = {"A": 3.0, "B": 4.0, "C": 5.0, "D": inf}
"""Upper limits of the peak of the sensitivity in each zone (ISO 14839-3: 9.5 dB, 12 dB and 14 dB)."""


@dataclass(frozen=True, eq=False)
class SensitivityZones(Brief):
    """Sensitivity of each axis of a loop, its peak and its zone.

    Attributes
    ----------
    frequency_hz : (n,) array
        Frequencies [Hz].
    magnitude : (n, n_axes) array
        Magnitude of the sensitivity of each axis, with the loops of the other axes closed.
    peak : (n_axes,) array
        Its largest value over all frequencies; inf for a loop that is not stable.
    peak_hz : (n_axes,) array
        Frequency of the peak [Hz].
    zone : tuple of {"A", "B", "C", "D"}
        Zone of each axis: newly commissioned machines lie in A, B is acceptable for long operation, C for a limited
        time, D is likely to cause damage.
    axes : tuple of str
        Names of the axes.
    """

    frequency_hz: FloatArray
    magnitude: FloatArray
    peak: FloatArray
    peak_hz: FloatArray
    zone: tuple[Zone, ...]
    axes: tuple[str, ...]

    def _brief(self) -> Description:
        about = ", ".join(
            f"{axis} zone {zone} (peak {peak:.3f})"
            for axis, zone, peak in zip(self.axes, self.zone, self.peak, strict=True)
        )
        return brief(self, about)


def iso_zone(peak: float) -> Zone:
    """Return the zone of ISO 14839-3 of a peak of the sensitivity.

    Parameters
    ----------
    peak : float
        Largest magnitude of the sensitivity of an axis; inf for a loop that is not stable.

    Returns
    -------
    {"A", "B", "C", "D"}
        The zone; a limit belongs to the zone below it.

    Examples
    --------
    >>> iso_zone(2.6), iso_zone(4.5)
    ('A', 'C')
    """
    return next((zone for zone, limit in ISO_LIMITS.items() if peak <= limit), "D")


def sensitivity_zones(loop: Sensitivities, frequency_hz: npt.ArrayLike | None = None) -> SensitivityZones:
    """Return the sensitivity of each axis of a loop with its zone of ISO 14839-3.

    Parameters
    ----------
    loop : Sensitivities
        Result of `gbid.sensitivities`.
    frequency_hz : (n,) array, optional
        Frequencies of the curves [Hz]; by default a grid that is dense around the poles. Peaks are found between these
        frequencies, too.

    Returns
    -------
    SensitivityZones

    Raises
    ------
    UsageError
        When frequencies are not finite.

    Notes
    -----
    ISO 14839-3 measures the sensitivity axis by axis: a disturbance is added to the signal of one sensor, and all axes
    are under control. These are the diagonal entries of ``S_o``. The largest singular value, `Sensitivities.peak`, is
    never smaller.
    """
    f = loop.grid() if frequency_hz is None else np.atleast_1d(np.asarray(frequency_hz, float))
    f = f[f > 0] if frequency_hz is None else f
    names = loop.plant.output_names
    stable = loop.is_stable()

    def of_axis(i: int, at: FloatArray) -> FloatArray:
        return np.asarray(np.abs(loop.response("output", at)[:, i, i]))

    peaks = [
        refine_maxima(partial(of_axis, i), loop.grid(), rounds=6) if stable else (inf, nan) for i in range(len(names))
    ]
    magnitude = np.column_stack([of_axis(i, f) for i in range(len(names))])
    values = np.array([value for value, _ in peaks])
    return SensitivityZones(
        frequency_hz=f,
        magnitude=magnitude,
        peak=values,
        peak_hz=np.array([place for _, place in peaks]),
        zone=tuple(iso_zone(value) for value in values.tolist()),
        axes=names,
    )
