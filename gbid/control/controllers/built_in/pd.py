"""Decentralised proportional and derivative controller."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from gbid.control.controllers.parts import AxisGain, PerAxis, inside
from gbid.core.errors import UsageError


@dataclass(frozen=True)
class PDStructure(PerAxis):
    r"""Decentralised proportional and derivative controller; the low-pass makes it proper.

    .. math:: K_i(s) = (\kappa_i + k_{d,i} s) \left(\frac{p_{lp}}{s + p_{lp}}\right)^n, \quad n \ge 1

    The gains are ``kappa_x``, ``kappa_y`` [m/m], ``kd_x``, ``kd_y`` [ms].

    Parameters
    ----------
    lowpass_hz, order, tune_corner, axes
        As in `PStructure`; the order is at least 1.
    lower, upper : float
        Bounds of the proportional gains [m/m].
    kd_limit_ms : float
        Bound on the magnitude of the derivative gains [ms].
    """

    lower: float = -3.0
    upper: float = 3.0
    kd_limit_ms: float = 3.0
    name: str = "PD"

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check_bounds(self.lower, self.upper)
        self._check_positive(kd_limit_ms=self.kd_limit_ms)
        if self.order == 0:
            raise UsageError("controller 'PD': order = 0; without a low-pass it is not proper, give at least 1")

    def _axis_gains(self) -> tuple[AxisGain, ...]:
        start = inside(0.0, (self.lower, self.upper))
        return (
            AxisGain("kappa", start, self.lower, self.upper, "m/m"),
            AxisGain("kd", 0.0, -self.kd_limit_ms, self.kd_limit_ms, "ms"),
        )

    def _filter(self, gain: Mapping[str, Any], lowpass: tuple[Any, ...]) -> tuple[Any, Any, Any, Any]:
        A, B, C, _ = lowpass
        seconds = 1e-3 * gain["kd"]  # D = 0: the derivative of the last stage is C (A x + B p)
        return A, B, gain["kappa"] * C + seconds * (C @ A), seconds * (C @ B)
