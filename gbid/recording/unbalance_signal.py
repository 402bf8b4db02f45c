"""Signal of the direction and size of an unbalance force, for structures with an unbalance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gbid.errors import DataError
from gbid.recording.recording import Recording
from gbid.units import SIGNALS

_RPM = np.pi / 30


def with_unbalance(recording: Recording) -> Recording:
    """Return a recording with the signal ``unbalance``: Omega^2 cos(phi) and Omega^2 sin(phi) [rad^2/s^2].

    An unbalance of eccentricity e and angle theta accelerates the rotor by e Omega^2 in the direction phi + theta. With
    this signal as input, `gbid.RotorBearing` (``unbalance=True``) estimates e and theta along. The tangential force of
    the angular acceleration is left out: it is smaller by the angular acceleration over Omega^2.

    Parameters
    ----------
    recording : Recording
        Recording with phi [rad], and with speed_rpm as a signal or condition.

    Returns
    -------
    Recording

    Raises
    ------
    DataError
        When the shaft angle or the speed is missing.
    """
    if "phi" not in recording.signals or recording.signal("phi").shape[1] != 1:
        raise DataError(f"recording {recording.name!r} has no signal 'phi' of one channel; the unbalance turns with it")
    if "speed_rpm" in recording.signals:
        speed = recording.signal("speed_rpm")[:, 0]
    elif "speed_rpm" in recording.conditions:
        speed = np.full(recording.n_samples, float(recording.conditions["speed_rpm"]))
    else:
        raise DataError(f"recording {recording.name!r} has no speed_rpm; the force grows with its square")
    phi, size = recording.signal("phi")[:, 0], (speed * _RPM) ** 2
    turned = np.column_stack([size * np.cos(phi), size * np.sin(phi)])
    kind = SIGNALS["unbalance"]
    return replace(
        recording,
        signals={**recording.signals, "unbalance": turned},
        units={**recording.units, "unbalance": kind.unit},
        channels={**recording.channels, "unbalance": kind.channels},
    )
