"""Run-out map: sensor reading over the shaft angle while the piezos are at rest."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np

from gbid.arrays import FloatArray
from gbid.brief import Brief
from gbid.errors import DataError
from gbid.hdf5 import Stored
from gbid.prefilter.cos_sin import cos_sin, cos_sin_of_one

TURN = 2 * np.pi


@dataclass(frozen=True, eq=False)
class RunoutMap(Brief):
    r"""Map of run-out and unbalance response over the shaft angle, the filter F_r(phi) of Sec. 3.5 of the paper.

    It has the form of harmonics, :math:`F(\phi) = m + \sum_n a_n \cos n\phi + b_n \sin n\phi`, or of a table over the
    angle with linear interpolation. It is made by `identify_runout`.

    Attributes
    ----------
    method : str
        ``"harmonics"``, ``"bins"``, or ``"mean"`` when the shaft stood still.
    mean : (n_channels,) array
        m, the mean position [m].
    orders : (n_orders,) array
        Harmonic orders n; empty unless the method is ``"harmonics"``.
    cosine, sine : (n_orders, n_channels) array
        a and b [m].
    angles : (n_angles,) array
        Angles of the table within [0, 2 pi) [rad], ascending; empty unless the method is ``"bins"``.
    table : (n_angles, n_channels) array
        Deviation from the mean at these angles [m].
    channels : tuple of str
        Names of the channels.
    conditions : dict of str to float
        Operating point of the map.
    sources : tuple of str
        Names of the recordings from which it was made.
    turns : float
        Number of turns of the shaft in these recordings.
    rms_before, rms_after : (n_channels,) array
        Root mean square of these recordings about their mean, before and after the map [m].
    notes : tuple of str
        Remarks for the reader of the result.
    """

    method: str
    mean: Annotated[FloatArray, Stored("m", "mean disc position", "channels")]
    orders: Annotated[FloatArray, Stored("1", "harmonic order", "orders")]
    cosine: Annotated[FloatArray, Stored("m", "cosine coefficients of the harmonics", "orders channels")]
    sine: Annotated[FloatArray, Stored("m", "sine coefficients of the harmonics", "orders channels")]
    angles: Annotated[FloatArray, Stored("rad", "shaft angle of the table", "angles")]
    table: Annotated[FloatArray, Stored("m", "deviation from the mean over the shaft angle", "angles channels")]
    channels: Annotated[tuple[str, ...], Stored(shape="channels")]
    conditions: Mapping[str, float]
    sources: tuple[str, ...]
    turns: float
    rms_before: Annotated[FloatArray, Stored("m", "rms of the stationary recordings about their mean", "channels")]
    rms_after: Annotated[FloatArray, Stored("m", "rms of what the map leaves of them", "channels")]
    notes: tuple[str, ...] = ()

    @property
    def needs_angle(self) -> bool:
        """Whether the map depends on the angle; the map of a shaft at rest is the mean alone."""
        return self.method != "mean"

    def evaluate(self, phi: FloatArray) -> FloatArray:
        """Return the map at given shaft angles.

        Parameters
        ----------
        phi : (n,) array
            Shaft angles [rad], wrapped or not.

        Returns
        -------
        (n, n_channels) array
            F_r(phi) with the mean [m].
        """
        value = np.tile(self.mean, (len(phi), 1))
        if self.orders.size:
            self._add_harmonics(phi, value)
        if self.angles.size:
            for channel, column in enumerate(self.table.T):
                value[:, channel] += np.interp(phi, self.angles, column, period=TURN)
        return value

    def _add_harmonics(self, phi: FloatArray, value: FloatArray) -> None:
        """Add the harmonics by angle addition, with rounding that does not depend on the number of angles."""
        # The online filter calls this with one angle, the offline filter with many. A matrix product would round
        # differently in the two cases; products and sums one by one give the same bits. Numbers take a tenth of the
        # time of arrays of one number.
        if len(phi) == 1:
            value[0] = self._summed(*cos_sin_of_one(float(phi[0])), value[0].tolist())
        else:
            value[:] = np.transpose(self._summed(*cos_sin(np.asarray(phi, dtype=float)), list(value.T)))

    def _summed(self, cos_1: Any, sin_1: Any, sums: list[Any]) -> list[Any]:
        """Return sums by channel plus the harmonics, numbers or arrays as cosine and sine of the angle are."""
        cos_n, sin_n = cos_1, sin_1
        rows = zip(self.orders.tolist(), self.cosine.tolist(), self.sine.tolist(), strict=True)
        coefficients = {int(order): list(zip(a, b, strict=True)) for order, a, b in rows}
        for order in range(1, max(coefficients) + 1):
            if order > 1:
                cos_n, sin_n = cos_n * cos_1 - sin_n * sin_1, sin_n * cos_1 + cos_n * sin_1
            if order in coefficients:
                sums = [v + (cos_n * a + sin_n * b) for v, (a, b) in zip(sums, coefficients[order], strict=True)]
        return sums

    def amplitudes(self, n_orders: int = 10) -> FloatArray:
        """Return the amplitudes of the harmonics 1, 2, ... of the map.

        Parameters
        ----------
        n_orders : int
            Number of harmonics for a table; a map of harmonics returns its own.

        Returns
        -------
        (n_orders, n_channels) array
            Amplitudes [m]; no rows for a shaft at rest.
        """
        if self.method == "harmonics":
            return np.asarray(np.hypot(self.cosine, self.sine))
        if self.method == "bins":
            n_points = 64 * max(n_orders, len(self.angles))
            spectrum = np.fft.rfft(self.evaluate(np.arange(n_points) * TURN / n_points), axis=0)
            return np.asarray(np.abs(spectrum[1 : n_orders + 1]) * 2 / n_points)
        return np.zeros((0, len(self.mean)))

    def check_conditions(self, name: str, conditions: Mapping[str, float]) -> None:
        """Refuse a recording at another operating point than that of the map.

        Parameters
        ----------
        name : str
            Name of the recording, for the message.
        conditions : dict of str to float
            Operating point of the recording.

        Raises
        ------
        DataError
            When a condition differs; the text gives both values.
        """
        key = differing_condition(self.conditions, conditions)
        if key:
            raise DataError(
                f"recording {name!r}: {key} = {conditions.get(key)}, but the run-out map was made at "
                f"{self.conditions.get(key)} (from {', '.join(self.sources)}); make a map at this operating "
                "point or allow any condition"
            )


def differing_condition(one: Mapping[str, float], other: Mapping[str, float]) -> str | None:
    """Return the scheduling variable in which two operating points differ by more than 1 %, or None."""
    for key in ("pressure_bar", "speed_rpm"):
        a, b = one.get(key), other.get(key)
        if (a is None) != (b is None):
            return key
        if a is not None and b is not None and abs(a - b) > 0.01 * max(abs(a), abs(b)):
            return key
    return None
