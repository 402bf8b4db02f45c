"""Shaft angle of a recording: whether the shaft turns, and whether this fits the stated speed."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gbid.arrays import FloatArray
from gbid.errors import DataError
from gbid.recording import Recording

_STILL = np.deg2rad(1.0)
_SPEED_TOLERANCE = 0.02


class ShaftMotion(NamedTuple):
    """Shaft angle of one recording.

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
    """Return the mean speed of the shaft by its angle phi [1/s]; None without an angle or for less than one turn."""
    if "phi" not in rec.signals or rec.signal("phi").shape[1] != 1 or rec.n_samples < 2:
        return None
    course = np.unwrap(rec.signal("phi")[:, 0])
    turns = abs(float(course[-1] - course[0])) / (2 * np.pi)
    return turns / ((rec.n_samples - 1) * rec.sample_time) if turns >= 1 else None


def shaft_motion(rec: Recording) -> ShaftMotion:
    """Return the shaft angle phi, after a comparison with the stated speed.

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
            f"recording {rec.name!r}: the shaft makes {turns:.2f} of a turn, neither still nor a whole turn; "
            "the run-out map needs every angle"
        )
    return ShaftMotion(angle, turns)
