"""Data of the gain explorer in the page: numbers of the model, ranges, and gains at the start."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from gbid.control import HalfSine, PStructure
from gbid.lpv import LPVModel
from gbid.report.html.page import Templated

PEAK_SENSITIVITY = 2.6
"""Largest peak of S_o without a warning: the default cap of `gbid.tune`."""
GAIN_RANGE = (-1.0, 3.0)
CORNER_RANGE = (100.0, 2500.0)
FREQUENCY_RANGE = (5.0, 1000.0)


def explorer_model(model: LPVModel, impact: HalfSine) -> dict[str, Any]:
    """Return the numbers from which the page computes the loop.

    Parameters
    ----------
    model : LPVModel
        Model with actuators.
    impact : HalfSine
        Impact; the page chooses its direction.

    Returns
    -------
    dict
        coefficients (Eq. 16), actuators (Eq. 12), pade_order, impact (peak [N], duration [s], mass [kg]),
        frequency [Hz] (first and last), peak_sensitivity.
    """
    return {
        "name": model.name,
        "coefficients": {key: list(values) for key, values in model.coefficients.items()},
        "actuators": dict(model.actuators),
        "pade_order": model.pade_order,
        "impact": {"peak": impact.peak_n, "duration": impact.duration_s, "mass": impact.mass_kg},
        "frequency": list(FREQUENCY_RANGE),
        "peak_sensitivity": PEAK_SENSITIVITY,
    }


def explorer_part(
    model: LPVModel,
    words: str,
    points: Sequence[tuple[float, float]],
    designs: Sequence[tuple[str, Any, Mapping[str, float]]],
    impact: HalfSine,
) -> Templated:
    """Return the gain explorer as a block of the page.

    Parameters
    ----------
    model : LPVModel
        Model with actuators.
    words : str
        Description of the model.
    points : sequence of (pressure_bar, speed_rpm)
        Operating points [bar], [rpm]. The explorer starts at the one nearest to the middle of the domain.
    designs : sequence of (name, structure, gains)
        Designs. P controllers with a first-order low-pass become buttons; the explorer starts with the last of them.
    impact : HalfSine
        Impact of the response.
    """
    buttons: list[tuple[str, list[float | None]]] = [("no feedback", [0.0, 0.0, None])]
    for name, structure, gains in designs:
        if isinstance(structure, PStructure) and structure.order == 1:
            corner = 1e3 * gains["lowpass_khz"] if structure.tune_corner else structure.lowpass_hz
            buttons.append((name, [gains["kappa_x"], gains["kappa_y"], corner]))
    pressures, speeds = model.domain.pressure_bar, model.domain.speed_rpm
    middle = [(low + high) / 2 for low, high in (pressures, speeds)]

    def far(point: tuple[float, float]) -> float:
        return abs(point[0] - middle[0]) / (pressures[1] - pressures[0] or 1) + abs(point[1] - middle[1]) / (
            speeds[1] - speeds[0] or 1
        )

    start = min(points, key=far) if points else (middle[0], middle[1])
    gain_x, gain_y, lowpass = buttons[-1][1]
    controls = [
        ("pressure", "Injection pressure", "bar", *pressures, 0.05, start[0]),
        ("speed", "Speed", "rpm", *speeds, 50, start[1]),
        ("kappa_x", "Gain κx", "m/m", *GAIN_RANGE, 0.005, gain_x),
        ("kappa_y", "Gain κy", "m/m", *GAIN_RANGE, 0.005, gain_y),
        ("corner", "Low-pass corner", "Hz", *CORNER_RANGE, 10, lowpass or 1000.0),
    ]
    keys = ("name", "label", "unit", "low", "high", "step", "value")
    return Templated(
        "explorer.html.j2",
        {
            "words": words,
            "model": explorer_model(model, impact),
            "controls": [dict(zip(keys, control, strict=True)) for control in controls],
            "buttons": buttons,
        },
    )
