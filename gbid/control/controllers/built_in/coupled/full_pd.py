"""Full proportional and derivative controller: two by two gains of each kind."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from gbid.control.controllers.parts import AxisGain, Crossed, inside
from gbid.core.errors import UsageError


@dataclass(frozen=True)
class FullPDStructure(Crossed):
    r"""Proportional and derivative controller with cross-coupling; the low-pass makes it proper.

    .. math:: K_{ij}(s) = (\kappa_{ij} + k_{d,ij} s) \left(\frac{p_{lp}}{s + p_{lp}}\right)^n, \quad n \ge 1

    Parameters
    ----------
    lower, upper : float
        Bounds of kappa [m/m].
    kd_limit_ms : float
        Bound on the magnitude of the derivative gains [ms].
    lowpass_hz, order, tune_corner, axes
        As in `PStructure`; the order is at least 1.
    """

    lower: float = -3.0
    upper: float = 3.0
    kd_limit_ms: float = 3.0
    name: str = "full PD"

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check_bounds(self.lower, self.upper)
        self._check_positive(kd_limit_ms=self.kd_limit_ms)
        if self.order == 0:
            raise UsageError("controller 'full PD': order = 0; without a low-pass it is not proper, give at least 1")

    def _axis_gains(self) -> tuple[AxisGain, ...]:
        return ()

    def _crossed_gains(self) -> tuple[AxisGain, ...]:
        return (
            AxisGain("kappa", inside(0.0, (self.lower, self.upper)), self.lower, self.upper, "m/m"),
            AxisGain("kd", 0.0, -self.kd_limit_ms, self.kd_limit_ms, "ms"),
        )

    def _filter(self, gain: Mapping[str, Any], lowpass: tuple[Any, ...]) -> tuple[Any, Any, Any, Any]:
        A, B, C, _ = lowpass
        seconds = 1e-3 * gain["kd"]
        return A, B, gain["kappa"] * C + seconds * (C @ A), seconds * (C @ B)
