"""Run-out maps over the shaft angle, portable cosine and sine, shaft motion of a recording, running median."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, NamedTuple

import numpy as np
import scipy

from gbid.core.arrays import FloatArray
from gbid.core.brief import Brief
from gbid.core.errors import DataError, UsageError
from gbid.core.hdf5 import Stored
from gbid.core.notes import DataNote
from gbid.recording import Recording
from gbid.recording.quality import find_problems

# ---- Cosine and sine from elementary operations: the same bits on every machine, and in C.

QUARTERS_PER_RADIAN = 0.6366197723675814
QUARTER = (1.5707963267341256, 6.077100506506192e-11)
"""A quarter turn as a sum of 33 bits and the rest; multiples of the first part are exact up to 2^20 quarters."""
SINE = (
    -1.66666666666666324348e-01,
    8.33333333332248946124e-03,
    -1.98412698298579493134e-04,
    2.75573137070700676789e-06,
    -2.50507602534068634195e-08,
    1.58969099521155010221e-10,
)
"""Coefficients of z^3, z^5, ... of the sine within an eighth of a turn."""
COSINE = (
    4.16666666666666019037e-02,
    -1.38888888888741095749e-03,
    2.48015872894767294178e-05,
    -2.75573143513906633035e-07,
    2.08757232129817482790e-09,
    -1.13596475577881948265e-11,
)
"""Coefficients of z^4, z^6, ... of the cosine within an eighth of a turn."""


def cos_sin(angle: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return cosine and sine of angles, within 2e-16 of the exact values.

    Cosine and sine of the C library and of numpy differ from machine to machine in the last bit. Here each result is
    a fixed sequence of sums and products, which are the same everywhere (IEEE 754). The generated C source of
    `gbid.export` has the same sequence.

    Parameters
    ----------
    angle : (n,) array
        Angles [rad], up to 1e6 in magnitude.

    Returns
    -------
    tuple of (n,) array
        Cosine and sine.

    Notes
    -----
    Reduction to an eighth of a turn after Cody and Waite; the polynomials are those of the public fdlibm (Sun
    Microsystems, 1993).
    """
    quarters = np.floor(angle * QUARTERS_PER_RADIAN + 0.5)
    cosine, sine = _within_a_quarter(angle, quarters)
    turned = np.asarray(quarters, dtype=np.int64) & 3
    swap = (turned & 1) == 1
    found_cosine, found_sine = np.where(swap, sine, cosine), np.where(swap, cosine, sine)
    return (
        np.where((turned == 1) | (turned == 2), -found_cosine, found_cosine),
        np.where(turned >= 2, -found_sine, found_sine),
    )


def cos_sin_of_one(angle: float) -> tuple[float, float]:
    """Return cosine and sine of one angle, bit for bit as `cos_sin` but ten times as fast.

    Parameters
    ----------
    angle : float
        Angle [rad], up to 1e6 in magnitude.
    """
    quarters = math.floor(angle * QUARTERS_PER_RADIAN + 0.5)
    cosine, sine = _within_a_quarter(angle, float(quarters))
    return ((cosine, sine), (-sine, cosine), (-cosine, -sine), (sine, -cosine))[quarters & 3]


def _within_a_quarter(angle: Any, quarters: Any) -> tuple[Any, Any]:
    """Return cosine and sine of angles minus their nearest quarter turns (numbers or arrays)."""
    rest = (angle - quarters * QUARTER[0]) - quarters * QUARTER[1]
    z = rest * rest
    return 1.0 - (0.5 * z - z * (z * _polynomial(COSINE, z))), rest + (z * rest) * _polynomial(SINE, z)


def _polynomial(coefficients: tuple[float, ...], z: Any) -> Any:
    """Return ``c0 + z (c1 + z (c2 + ...))``."""
    value: Any = coefficients[-1]
    for coefficient in coefficients[-2::-1]:
        value = coefficient + z * value
    return value


TURN = 2 * np.pi


@dataclass(frozen=True, eq=False)
class RunoutMap(Brief):
    r"""Map of run-out and unbalance response over the shaft angle: the filter F_r(phi) of Sec. 3.5 of the paper.

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
        """Whether the map depends on the angle; for a shaft at rest it is a mean only."""
        return self.method != "mean"

    def evaluate(self, phi: FloatArray) -> FloatArray:
        """Return the values of the map at shaft angles.

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
        """Add the harmonics by angle addition; rounding does not depend on the number of angles."""
        # The online filter calls this with one angle, the offline filter with many. A matrix product would round
        # differently in the two cases; products and sums one by one give the same bits. Numbers take a tenth of the
        # time of arrays of one number.
        if len(phi) == 1:
            value[0] = self._summed(*cos_sin_of_one(float(phi[0])), value[0].tolist())
        else:
            value[:] = np.transpose(self._summed(*cos_sin(np.asarray(phi, dtype=float)), list(value.T)))

    def _summed(self, cos_1: Any, sin_1: Any, sums: list[Any]) -> list[Any]:
        """Return sums by channel with the harmonics added; cosine and sine may be numbers or arrays."""
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
        """Refuse a recording whose operating point differs from the map's.

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
        if key := differing_condition(self.conditions, conditions):
            raise DataError(
                f"recording {name!r}: {key} = {conditions.get(key)}, but the run-out map was made at "
                f"{self.conditions.get(key)} (from {', '.join(self.sources)}); make a map at this operating "
                "point or allow any condition"
            )


def differing_condition(first: Mapping[str, float], second: Mapping[str, float]) -> str | None:
    """Return the scheduling variable in which two operating points differ by more than 1 %, or None."""
    for key in ("pressure_bar", "speed_rpm"):
        a, b = first.get(key), second.get(key)
        if (a is None) != (b is None):
            return key
        if a is not None and b is not None and abs(a - b) > 0.01 * max(abs(a), abs(b)):
            return key
    return None


# ---- Shaft angle of a recording, compared with the stated speed.

_STILL = np.deg2rad(1.0)
_SPEED_TOLERANCE = 0.02


class ShaftMotion(NamedTuple):
    """Shaft angle and number of turns of one recording.

    Attributes
    ----------
    angle : (n_samples,) array
        Measured angle [rad], wrapped or not.
    turns : float
        Number of turns during the recording; zero for a shaft at rest.
    """

    angle: FloatArray
    turns: float


def turns_per_second(rec: Recording) -> float | None:
    """Return the mean shaft speed from the angle phi [1/s]; None without an angle or below one turn."""
    if "phi" not in rec.signals or rec.signal("phi").shape[1] != 1 or rec.n_samples < 2:
        return None
    course = np.unwrap(rec.signal("phi")[:, 0])
    turns = abs(float(course[-1] - course[0])) / (2 * np.pi)
    return turns / ((rec.n_samples - 1) * rec.sample_time) if turns >= 1 else None


def shaft_motion(rec: Recording) -> ShaftMotion:
    """Return the shaft angle phi after a check against the stated speed.

    Parameters
    ----------
    rec : Recording
        Recording with the signal phi (one channel, rad). The condition ``speed_rpm`` is compared when it is given.

    Returns
    -------
    ShaftMotion
        Angle and number of turns.

    Raises
    ------
    DataError
        When phi is missing or has more than one channel, when a moving shaft makes less than one turn, or when phi
        turns at another speed than ``speed_rpm`` (2 %).
    """
    if "phi" not in rec.signals:
        raise DataError(f"recording {rec.name!r} has no signal 'phi'; the run-out map needs the shaft angle [rad]")
    phi = rec.signal("phi")
    if phi.shape[1] != 1:
        raise DataError(f"recording {rec.name!r}: signal 'phi' has {phi.shape[1]} channels, expected one angle")
    angle = phi[:, 0]
    course = np.unwrap(angle)
    turns = 0.0 if np.ptp(course) < _STILL else abs(float(course[-1] - course[0])) / (2 * np.pi)
    claimed = rec.conditions.get("speed_rpm")
    if claimed is not None:
        measured = 60.0 * turns / max((rec.n_samples - 1) * rec.sample_time, rec.sample_time)
        if abs(measured - abs(claimed)) > _SPEED_TOLERANCE * abs(claimed) + 1e-9:
            raise DataError(
                f"recording {rec.name!r}: phi turns at {measured:.1f} rpm, but speed_rpm = {claimed:g}; "
                "check the encoder and the condition"
            )
    if 0.0 < turns < 1.0:
        raise DataError(
            f"recording {rec.name!r}: the shaft makes {turns:.2f} of a turn, less than a whole one; "
            "the run-out map needs every angle"
        )
    return ShaftMotion(angle, turns)


# ---- Running median (paper, Sec. 3.5).


def sensor_notes(rec: Recording, position: str) -> list[str]:
    """Return notes on clipped position channels, and on jumps and stops of the shaft angle."""
    signals = [name for name in (position, "phi") if name in rec.signals]
    problems = find_problems(rec, signals, ("saturated", "encoder"))
    return [DataNote.CLIPPED(q.text) if q.kind == "saturated" else DataNote.ANGLE_JUMPS(q.text) for q in problems]


def running_median(values: FloatArray, size: int) -> FloatArray:
    """Return the running median over `size` samples of each channel (paper, Sec. 3.5: size 3).

    The median removes spikes of one sample, but it has two side effects. Of white noise, size 3 leaves 45 % of the
    variance and colours it: the correlation of neighbours is 0.55, that of samples two apart is 0.26. Each crest of a
    wave of amplitude a and angular frequency w is reduced by up to a (w T)^2 / 2, which is 0.12 um of 10 um at 125 Hz
    and T = 0.2 ms. Residual tests that assume white noise detect both effects. Size 1 switches the filter off.

    Parameters
    ----------
    values : (n_samples, n_channels) array
        The signal.
    size : int
        Number of samples, odd; 1 changes nothing.

    Returns
    -------
    (n_samples, n_channels) array
        Filtered signal; the ``size // 2`` samples at each end are unchanged.

    Raises
    ------
    UsageError
        When `size` is not odd and positive, or when it is longer than the signal.
    """
    if size < 1 or size % 2 == 0:
        raise UsageError(f"median = {size}; give an odd number of samples, 1 for none")
    if size > len(values):
        raise UsageError(f"median = {size} is longer than the {len(values)} samples of the signal")
    half = size // 2
    filtered = np.array(values, dtype=float)
    if half:
        filtered[half:-half] = scipy.ndimage.median_filter(values, size=(size, 1))[half:-half]
    return filtered
