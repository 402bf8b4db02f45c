"""Proportional and integral controller per axis."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import casadi as ca

from gbid.control.controllers.parts import AxisGain, PerAxis, in_series, inside


@dataclass(frozen=True)
class PIStructure(PerAxis):
    r"""Proportional and integral controller with low-pass.

    .. math:: K_i(s) = \left(\kappa_i + \frac{k_{I,i}}{s}\right) \left(\frac{p_{lp}}{s + p_{lp}}\right)^n

    The gains per axis are ``kappa`` [m/m] and ``ki`` [1/s]. Feedback is positive, so a negative ``ki`` is stable, and
    the disc then returns to its set point under a steady force.

    Parameters
    ----------
    lower, upper : float
        Bounds of kappa [m/m].
    ki : (lowest, highest)
        Bounds of the integral gain [1/s], below zero.
    lowpass_hz, order, tune_corner, axes
        As in `PStructure`.
    """

    lower: float = -3.0
    upper: float = 3.0
    ki: tuple[float, float] = (-1000.0, -1.0)
    name: str = "PI"

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check_bounds(self.lower, self.upper)
        self._check_ranges("ki", positive=False)

    def _axis_gains(self) -> tuple[AxisGain, ...]:
        return (
            AxisGain("kappa", inside(0.0, (self.lower, self.upper)), self.lower, self.upper, "m/m"),
            AxisGain("ki", inside(-20.0, self.ki), *self.ki, "1/s"),
        )

    def _filter(self, gain: Mapping[str, Any], lowpass: tuple[Any, ...]) -> tuple[Any, Any, Any, Any]:
        return in_series(lowpass, (ca.SX(1, 1), ca.SX(1), ca.SX(gain["ki"]), ca.SX(gain["kappa"])))
