"""Proportional, integral and derivative controller with filter per axis."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import casadi as ca

from gbid.control.controllers.built_in.pi import PIStructure
from gbid.control.controllers.parts import AxisGain
from gbid.core.errors import UsageError


@dataclass(frozen=True)
class PIDStructure(PIStructure):
    r"""Proportional, integral and derivative controller; the low-pass makes it proper.

    .. math:: K_i(s) = \left(\kappa_i + \frac{k_{I,i}}{s} + k_{d,i} s\right)
                       \left(\frac{p_{lp}}{s + p_{lp}}\right)^n, \quad n \ge 1

    The gains per axis are ``kappa`` [m/m], ``ki`` [1/s] and ``kd`` [ms].

    Parameters
    ----------
    kd_limit_ms : float
        Bound on the magnitude of the derivative gains [ms].
    lower, upper, ki, lowpass_hz, order, tune_corner, axes
        As in `PIStructure`; the order is at least 1.
    """

    kd_limit_ms: float = 3.0
    name: str = "PID"

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check_positive(kd_limit_ms=self.kd_limit_ms)
        if self.order == 0:
            raise UsageError("controller 'PID': order = 0; without a low-pass it is not proper, give at least 1")

    def _axis_gains(self) -> tuple[AxisGain, ...]:
        return (*super()._axis_gains(), AxisGain("kd", 0.0, -self.kd_limit_ms, self.kd_limit_ms, "ms"))

    def _filter(self, gain: Mapping[str, Any], lowpass: tuple[Any, ...]) -> tuple[Any, Any, Any, Any]:
        A, B, C, D = super()._filter(gain, lowpass)
        n, seconds = lowpass[0].shape[0], 1e-3 * gain["kd"]
        # D = 0 of the low-pass: the derivative of its last stage is C (A x + B p)
        rate = ca.horzcat(lowpass[2] @ lowpass[0], ca.SX(1, A.shape[0] - n))
        return A, B, C + seconds * rate, D + seconds * (lowpass[2] @ lowpass[1])
