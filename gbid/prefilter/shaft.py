"""What a recording says about its shaft: whether it turns, and whether that fits its conditions."""

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
        As measured [rad], wrapped or not.
    turns : float
        Turns made during the recording, zero for a shaft that stands still.
    """

    angle: FloatArray
    turns: float


def shaft_motion(rec: Recording) -> ShaftMotion:
    """Read the shaft angle phi and hold it against the speed the recording claims.

    Parameters
    ----------
    rec : Recording
        With signal phi (one channel, rad); condition ``speed_rpm`` is compared when there.

    Returns
    -------
    ShaftMotion
        Angle and number of turns.

    Raises
    ------
    DataError
        When phi is missing or has more than one channel, the shaft makes less than one turn without standing
        still, or phi turns at another speed than ``speed_rpm`` (2 %).
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
        found = 60.0 * turns / max((rec.n_samples - 1) * rec.sample_time, rec.sample_time)
        if abs(found - abs(claimed)) > _SPEED_TOLERANCE * abs(claimed) + 1e-9:
            raise DataError(
                f"recording {rec.name!r}: phi turns at {found:.1f} rpm, but speed_rpm = {claimed:g}; "
                "check the encoder and the condition"
            )
    if 0.0 < turns < 1.0:
        raise DataError(
            f"recording {rec.name!r}: the shaft makes {turns:.2f} of a turn, neither still nor a whole turn; "
            "the run-out map needs every angle"
        )
    return ShaftMotion(angle, turns)
