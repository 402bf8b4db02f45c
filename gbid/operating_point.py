"""Operating points in words."""

from __future__ import annotations


def point_label(pressure_bar: float, speed_rpm: float) -> str:
    """Return the label of an operating point, for people.

    Parameters
    ----------
    pressure_bar : float
        Supply pressure [bar].
    speed_rpm : float
        Shaft speed [rpm].

    Returns
    -------
    str
        For example ``"6 bar, 4000 rpm"``.
    """
    return f"{pressure_bar:g} bar, {speed_rpm:g} rpm"
