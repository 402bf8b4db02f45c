"""Performance figures of a design at one operating point."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import inf

import numpy as np

from gbid.control.controllers.scheduled import Scheduled, controller_at
from gbid.control.impact.half_sine import HalfSine, ImpactResponse, impact_response
from gbid.control.loop.damping import smallest_damping
from gbid.control.loop.margins import DiskMargin, disk_margin, static_amplification, static_stiffness_ratio
from gbid.control.loop.norm import Peak
from gbid.control.loop.sampled import exact_plant, sampled_loop
from gbid.control.loop.sampling import Method
from gbid.control.loop.sensitivity import sensitivities
from gbid.lpv import LPVModel
from gbid.structure import PiezoPair, evaluate
from gbid.structure.linear import Structure

FIGURES = (
    "damping",
    "peak_output",
    "peak_control",
    "disk_margin",
    "static_amplification",
    "stiffness_ratio",
    "slowest_decay_hz",
    "impact_p_m",
    "stack_travel_m",
    "decay_time_s",
    "sampled_damping",
    "sampled_peak_output",
)
"""Figures by which designs are compared."""

LOWEST_IS_WORST = ("damping", "disk_margin", "stiffness_ratio", "slowest_decay_hz", "sampled_damping")


@dataclass(frozen=True)
class PointAssessment:
    """Performance figures of a design at one operating point.

    Attributes
    ----------
    pressure_bar, speed_rpm : float
        Operating point.
    stable : bool
        Whether the continuous loop is stable.
    damping : float
        Smallest damping factor of the oscillatory modes of the continuous loop; -1 for an unstable real pole.
    modes : tuple of (frequency_hz, damping)
        Oscillatory modes by rising frequency.
    slowest_decay_hz : float
        Decay rate of the slowest pole, real or complex, over 2 pi [Hz]; negative when it is unstable.
    peak_output, peak_control : Peak
        Largest singular values of S_o and K S_o over frequency.
    disk : DiskMargin
        Disk margin of all loops together, at the positions.
    static_amplification : float
        Largest singular value of S_o at zero frequency; infinite for an unstable loop.
    stiffness_ratio : tuple of float
        Static stiffness of the closed loop over that of the open loop, x and y; NaN for an unstable loop.
    impact_p_m, impact_r_m : float
        Largest motion of the disc and largest ``|r|`` after the impact, the larger of x and y [m].
    stack_travel_m : float
        Largest motion of one stack from its middle after the impact [m].
    exceeds_travel : bool
        Whether this motion is larger than the travel of a stack.
    decay_time_s : float
        Time until the motion of the disc after the impact stays below 5 % of its peak, the longer of x and y [s].
    sampled_stable : bool
        Whether the sampled loop is stable.
    sampled_damping : float
        Smallest damping factor of the sampled loop, with computation time and exact delays, over the modes that last
        longer than a sample.
    sampled_peak_output : Peak
        Largest singular value of S_o of the sampled loop.
    """

    pressure_bar: float
    speed_rpm: float
    stable: bool
    damping: float
    modes: tuple[tuple[float, float], ...]
    slowest_decay_hz: float
    peak_output: Peak
    peak_control: Peak
    disk: DiskMargin
    static_amplification: float
    stiffness_ratio: tuple[float, ...]
    impact_p_m: float
    impact_r_m: float
    stack_travel_m: float
    exceeds_travel: bool
    decay_time_s: float
    sampled_stable: bool
    sampled_damping: float
    sampled_peak_output: Peak

    def figures(self) -> dict[str, float]:
        """Return the figures by which designs are compared, in the order of `FIGURES`."""
        values = (
            self.damping,
            self.peak_output.value,
            self.peak_control.value,
            self.disk.alpha,
            self.static_amplification,
            min(self.stiffness_ratio) if self.stable else -inf,
            self.slowest_decay_hz,
            self.impact_p_m,
            self.stack_travel_m,
            self.decay_time_s,
            self.sampled_damping,
            self.sampled_peak_output.value,
        )
        return dict(zip(FIGURES, values, strict=True))

    @property
    def sampling_cost(self) -> float:
        """Damping that is lost by sampling and computation; negative when their delay increases the damping."""
        return self.damping - self.sampled_damping


def assess_point(
    lpv: LPVModel,
    structure: Structure | Scheduled,
    gains: Mapping[str, float],
    point: tuple[float, float],
    sample_time: float,
    computation: float,
    method: Method,
    impact: HalfSine,
    piezo_travel_m: float,
) -> PointAssessment:
    """Return all figures of a design at one operating point; see `gbid.assess` for the arguments."""
    plant, controller = lpv.plant_at(*point), controller_at(structure, gains, *point)
    loop = sensitivities(plant, controller)
    closed = loop.model("plant")
    actuators = evaluate(PiezoPair(), lpv.actuators, plant.input_names, ("u_x", "u_y"))
    impacts = [
        impact_response(plant, controller, turned, actuators=actuators, piezo_travel_m=piezo_travel_m)
        for turned in (impact.towards(0.0), impact.towards(90.0))
    ]
    sampled = sampled_loop(exact_plant(lpv, *point), controller, sample_time, computation_s=computation, method=method)
    stable = closed.is_stable()
    stiffness = static_stiffness_ratio(loop) if stable else np.full(len(plant.C), np.nan)
    return PointAssessment(
        *point,
        stable,
        smallest_damping(closed),
        tuple(closed.modes()),
        float(-loop.poles.real.max() / (2 * np.pi)),
        loop.peak("output"),
        loop.peak("control"),
        disk_margin(loop),
        static_amplification(loop) if stable else inf,
        tuple(float(ratio) for ratio in stiffness),
        _largest(impacts, "peak_p_m"),
        _largest(impacts, "peak_r_m"),
        _largest(impacts, "stack_travel_m"),
        any(impact.exceeds_travel for impact in impacts),
        _largest(impacts, "decay_time_s"),
        sampled.stable,
        sampled.damping,
        sampled.peak_output,
    )


def _largest(impacts: Sequence[ImpactResponse], figure: str) -> float:
    return max(float(getattr(impact, figure)) for impact in impacts)
