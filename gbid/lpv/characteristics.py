"""Characteristics of the machine from its key parameters: delays, modes and static gains."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from gbid.arrays import FloatArray
from gbid.poles import oscillatory_modes
from gbid.structure import KEY_PARAMETERS

CHARACTERISTICS = (
    *("tau_x", "tau_y"),
    *("omega_1", "omega_2", "zeta_1", "zeta_2"),
    *("g_xx", "g_xy", "g_yx", "g_yy"),
)
"""Names in order: delays [s], natural frequencies [Hz], damping factors, static gains [m/m]."""

UNITS = {"tau": "s", "omega": "Hz", "zeta": "1", "g": "m/m"}
"""Unit by the name's first part."""

PUBLISHED_RMS = {
    "tau_x": 0.088e-3,
    "tau_y": 0.041e-3,
    "omega_1": 1.13,
    "omega_2": 0.58,
    "zeta_1": 0.0104,
    "zeta_2": 0.0063,
    "g_xx": 0.0031,
    "g_xy": 0.0022,
    "g_yx": 0.0027,
    "g_yy": 0.0031,
}
"""Rms deviations that the paper gives for its 86 recordings (Sec. 4)."""

PUBLISHED_LARGEST_GAIN = 0.016
"""Largest deviation of a static gain in the paper [m/m] (Sec. 4)."""


def characteristics(values: npt.ArrayLike) -> FloatArray:
    """Return the delays, modes and static gains of key parameters.

    Parameters
    ----------
    values : (n, 14) array
        Key parameters in the order of `gbid.structure.KEY_PARAMETERS`, SI per kg.

    Returns
    -------
    (n, 10) array
        Characteristics in the order of `CHARACTERISTICS`. Modes are by rising frequency. They are nan when there are
        not exactly two oscillatory modes.
    """
    values = np.atleast_2d(np.asarray(values, float))
    column = {key: values[:, i] for i, key in enumerate(KEY_PARAMETERS)}
    K, D, B = (
        np.stack([column[f"{letter}_{pair}"] for pair in ("xx", "xy", "yx", "yy")], axis=-1).reshape(-1, 2, 2)
        for letter in "kdb"
    )
    A = np.zeros((len(values), 4, 4))
    A[:, :2, 2:], A[:, 2:, :2], A[:, 2:, 2:] = np.eye(2), K, D
    poles = np.linalg.eigvals(A)
    modes = np.full((len(values), 4), np.nan)
    for i, p in enumerate(poles):
        found = oscillatory_modes(p)
        if len(found) == 2:
            modes[i] = found.T.ravel()
    gains = -np.linalg.solve(K, B).reshape(-1, 4)
    return np.column_stack([column["tau_x"], column["tau_y"], modes, gains])


@dataclass(frozen=True)
class Deviation:
    """Deviation of the recordings from the surfaces in one characteristic.

    Attributes
    ----------
    name, unit : str
        Name and unit of the characteristic.
    rms, largest : float
        Root mean square and largest absolute value of estimate minus surface, in `unit`.
    recording : str
        Recording with the largest deviation.
    published_rms : float
        Rms deviation in the paper, for its machine.
    """

    name: str
    unit: str
    rms: float
    largest: float
    recording: str
    published_rms: float


def deviations(estimated: FloatArray, surface: FloatArray, recordings: tuple[str, ...]) -> tuple[Deviation, ...]:
    """Return the deviations of estimated characteristics from those of the surfaces, both (n, 10), by recording.

    Rows without two modes do not count for the modes.
    """
    rows = []
    for j, name in enumerate(CHARACTERISTICS):
        away = estimated[:, j] - surface[:, j]
        known = np.flatnonzero(np.isfinite(away))
        worst = known[int(np.argmax(np.abs(away[known])))] if len(known) else None
        rows.append(
            Deviation(
                name,
                UNITS[name.partition("_")[0]],
                float(np.sqrt(np.mean(away[known] ** 2))) if len(known) else np.nan,
                float(np.abs(away[worst])) if worst is not None else np.nan,
                recordings[worst] if worst is not None else "",
                PUBLISHED_RMS[name],
            )
        )
    return tuple(rows)
