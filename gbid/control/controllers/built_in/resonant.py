"""Proportional controller with a resonant term at the speed of rotation per axis."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca

from gbid.control.controllers.parts import AxisGain, PerAxis, in_parallel, in_series, inside, second_order


@dataclass(frozen=True)
class ResonantStructure(PerAxis):
    r"""Proportional controller with a resonant term at the speed, against synchronous vibration.

    .. math:: K_i(s) = \kappa_i L(s) + \frac{c_i \omega s + s_i \omega^2}{s^2 + 2 w_i \omega s + \omega^2}, \quad
              \omega^2 = \Omega^2 + \omega_0^2

    L is the low-pass. The gains per axis are ``kappa``, ``sine`` (s) and ``cosine`` (c) [m/m], and ``width`` (w). The
    frequency follows the speed: `gbid.tune` schedules this structure, and at each operating point it is another filter.
    A narrow term is a slow mode of the loop, whose damping counts like that of others.

    Parameters
    ----------
    lowest_hz : float
        Frequency of the term at rest, ``omega_0 / 2 pi`` [Hz].
    gain_limit : float
        Bound on the magnitude of the gains [m/m].
    width : (lowest, highest)
        Bounds of the damping factor of the term.
    speed_rpm : float or casadi.SX
        Speed of rotation; set by the schedule.
    lowpass_hz, order, tune_corner, axes
        As in `PStructure`; the low-pass acts on kappa.
    """

    lowest_hz: float = 20.0
    gain_limit: float = 3.0
    width: tuple[float, float] = (0.02, 2.0)
    speed_rpm: Any = 0.0
    name: str = "resonant"

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check_positive(gain_limit=self.gain_limit, lowest_hz=self.lowest_hz)
        self._check_ranges("width")

    def at_speed(self, speed_rpm: Any) -> ResonantStructure:
        """Return the structure at a speed, a number or a symbol [rpm]."""
        return replace(self, speed_rpm=speed_rpm)

    def _axis_gains(self) -> tuple[AxisGain, ...]:
        limit = self.gain_limit
        return (
            *(AxisGain(name, 0.0, -limit, limit, "m/m") for name in ("kappa", "sine", "cosine")),
            AxisGain("width", inside(0.7, self.width), *self.width, ""),
        )

    def _filter(self, gain: Mapping[str, Any], lowpass: tuple[Any, ...]) -> tuple[Any, Any, Any, Any]:
        hz = ca.sqrt((self.speed_rpm / 60) ** 2 + self.lowest_hz**2)
        term = second_order((gain["sine"], gain["cosine"], 0.0), hz / 1e3, gain["width"])
        straight = in_series(lowpass, (ca.SX(0, 0), ca.SX(0, 1), ca.SX(1, 0), ca.SX(gain["kappa"])))
        return in_parallel(straight, term)
