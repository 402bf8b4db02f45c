"""Piezo travel under a blow, as a limit of a design."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from gbid.control.closed_matrices import FloatArray
from gbid.control.impact import HalfSine, impact_response
from gbid.control.limits import ExtraLimit
from gbid.control.scheduled import Scheduled, controller_at
from gbid.lpv import LPVModel
from gbid.structure.linear import Structure

UNSTABLE = 1e3
"""What an unstable loop counts as: so many times the limit."""


def travel_limit(
    lpv: LPVModel,
    structure: Structure | Scheduled,
    actuator: Mapping[str, float] | None,
    points: FloatArray,
    impact: HalfSine,
    piezo_travel_m: float,
) -> ExtraLimit:
    """Limit the motion of every stack to half its travel, under the blow in x and in y at every operating point.

    Parameters
    ----------
    lpv : LPVModel
    structure : Structure or Scheduled
    actuator : dict of str to float, optional
    points : (m, 2) array
        Pressure [bar], speed [rpm].
    impact : HalfSine
    piezo_travel_m : float
        Whole travel of a stack [m].
    """
    model = lpv if actuator is None else replace(lpv, actuators=dict(actuator))
    plants = [model.plant_at(float(P), float(Omega)) for P, Omega in points]
    names = [parameter.name for parameter in structure.parameters]
    limit = piezo_travel_m / 2

    def largest(gains: FloatArray) -> float:
        values = dict(zip(names, map(float, gains), strict=True))
        worst = 0.0
        for (P, Omega), plant in zip(points, plants, strict=True):
            controller = controller_at(structure, values, float(P), float(Omega))
            for direction in (0.0, 90.0):
                blow = replace(impact, direction_deg=direction)
                response = impact_response(plant, controller, blow, duration_s=0.05, piezo_travel_m=piezo_travel_m)
                worst = max(worst, min(response.peak_r_m, UNSTABLE * limit))
        return max(worst, 1e-12)

    return ExtraLimit("piezo travel", largest, limit)
