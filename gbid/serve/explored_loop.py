"""Closed loop of one design for any gains at one operating point: the numbers that the gain explorer draws."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import inf, isfinite
from typing import Any

import numpy as np

from gbid.arrays import ComplexArray
from gbid.control import controller_at, impact_response, sampled_loop, sensitivities
from gbid.control.loop.damping import smallest_damping
from gbid.control.loop.margins import static_amplification
from gbid.control.loop.norm import largest_singular_values
from gbid.control.loop.sampled import exact_plant
from gbid.errors import UsageError
from gbid.poles import is_real, oscillatory_modes
from gbid.report.reader.designs import AssessedDesign
from gbid.structure import LinearModel

_SHOWN_S = 0.2  # length of the impact response
_EVERY = 10  # the response has a sample each 0.02 ms; the page draws every tenth
_FREQUENCIES = 300
_RANGE = (5.0, 1000.0)  # Hz


@dataclass(frozen=True)
class Explored:
    """Settings of the explorer.

    Attributes
    ----------
    pressure_bar, speed_rpm : float
        Operating point [bar], [rpm].
    gains : dict of str to float
        A value for every parameter of the controller.
    axis : {"x", "y"}
        Direction of the impact.
    sampled : bool
        Whether poles and sensitivity are those of the sampled loop with exact delays and computation time.
    """

    pressure_bar: float
    speed_rpm: float
    gains: Mapping[str, float]
    axis: str = "x"
    sampled: bool = False


def explored_loop(design: AssessedDesign, asked: Explored) -> dict[str, Any]:
    """Return the loop of a design with other gains, as numbers for JSON.

    Parameters
    ----------
    design : AssessedDesign
        Design with plant, structure, sample time and impact.
    asked : Explored
        Operating point and gains.

    Returns
    -------
    dict
        stable, damping, peak {value, frequency_hz}, static_amplification, modes [[frequency_hz, damping, decay_per_s]],
        open_modes, real [1/s], frequency_hz, largest, xx, yy (magnitudes of S_o), time_s, closed_m, open_m (motion
        along the axis of the impact; null where it is not finite), stack_travel_m. The impact acts on the
        continuous loop.

    Raises
    ------
    UsageError
        When the axis or a gain is unknown, a gain is not finite, or the point lies outside the domain.
    """
    names = [parameter.name for parameter in design.structure.parameters]
    unknown = [name for name in asked.gains if name not in names]
    if unknown or asked.axis not in ("x", "y"):
        raise UsageError(f"explorer: no gain {unknown[0]!r}" if unknown else f"explorer: axis = {asked.axis!r}")
    gains = {**design.figures.gains, **asked.gains}
    if not all(isfinite(value) for value in gains.values()):
        raise UsageError("explorer: give finite gains")
    point = asked.pressure_bar, asked.speed_rpm
    plant, controller = design.plant.plant_at(*point), controller_at(design.structure, gains, *point)
    continuous = sensitivities(plant, controller)
    if asked.sampled:
        sampled = sampled_loop(exact_plant(design.plant, *point), controller, design.sample_time, method=design.method)
        loop, closed, damping = sampled.sensitivities, sampled.closed, sampled.damping
    else:
        loop, closed = continuous, continuous.model("plant")
        damping = smallest_damping(closed)
    top = min(_RANGE[1], 0.5 / design.sample_time) if asked.sampled else _RANGE[1]
    frequency = np.geomspace(_RANGE[0], top, _FREQUENCIES)
    S = loop.response("output", frequency)
    stable = closed.is_stable()
    peak = loop.peak("output")
    place = "xy".index(asked.axis)
    impact = design.impact.towards(90.0 * place)
    response = impact_response(plant, controller, impact, duration_s=_SHOWN_S)
    alone = impact_response(plant, None, impact, duration_s=_SHOWN_S)
    rates = _rates(closed)
    return {
        "stable": stable,
        "damping": damping,
        "peak": {"value": _finite(peak.value), "frequency_hz": _finite(peak.frequency_hz)},
        "static_amplification": _finite(static_amplification(loop) if stable else inf),
        "modes": _modes(rates),
        "open_modes": _modes(_rates(plant)),
        "real": sorted(rates[is_real(rates)].real.tolist()),
        "frequency_hz": frequency.tolist(),
        "largest": largest_singular_values(S).tolist(),
        "xx": np.abs(S[:, 0, 0]).tolist(),
        "yy": np.abs(S[:, 1, 1]).tolist(),
        "time_s": alone.time_s[::_EVERY].tolist(),
        "closed_m": _drawn(response.p, place),
        "open_m": _drawn(alone.p, place),
        "stack_travel_m": _finite(response.stack_travel_m),
    }


def _rates(model: LinearModel) -> ComplexArray:
    """Return the poles in continuous time [rad/s]; of a sampled model those that last for more than a sample."""
    rates = model.poles()
    return rates if model.dt is None else rates[-rates.real * model.dt < 1]


def _modes(rates: ComplexArray) -> list[list[float]]:
    """Return frequency [Hz], damping factor and decay rate [1/s] of the oscillatory modes, by frequency."""
    return [[hz, damping, 2 * np.pi * hz * damping] for hz, damping in oscillatory_modes(rates).tolist()]


def _drawn(positions: Any, place: int) -> list[float | None]:
    return [_finite(float(value)) for value in np.asarray(positions)[::_EVERY, place]]


def _finite(value: float) -> float | None:
    """Return a number for JSON, which has no infinity."""
    return float(value) if isfinite(value) else None
