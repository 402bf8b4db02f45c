"""Biquad controller: a second-order filter per axis."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import inf
from typing import Any

import casadi as ca
import numpy as np

from gbid.control.controllers.per_axis import AxisGain, PerAxis
from gbid.errors import UsageError


@dataclass(frozen=True)
class BiquadStructure(PerAxis):
    r"""Biquad controller: one second-order filter per axis.

    .. math:: K_i(s) = \frac{b_{2,i} s^2 + b_{1,i} \omega_i s + b_{0,i} \omega_i^2}
                            {s^2 + 2 \zeta_i \omega_i s + \omega_i^2}
                       \left(\frac{p_{lp}}{s + p_{lp}}\right)^n

    The numerator is scaled by the frequency of the filter, so that all gains are of order one: ``b0`` is the static
    gain and ``b2`` the gain at high frequency. The gains per axis are ``b0``, ``b1``, ``b2`` [m/m], ``frequency``
    [kHz] (``omega = 2 pi 1000 frequency``) and ``damping`` [-]. The bounds of the last two keep the filter stable.

    Parameters
    ----------
    lowpass_hz, order, tune_corner
        As in `PStructure`; by default there is no low-pass.
    gain_limit : float
        Bound on the magnitude of b0, b1 and b2 [m/m].
    frequency_khz, damping : (lowest, highest)
        Bounds of the frequency [kHz] and damping factor of the filter.
    """

    order: int = 0
    gain_limit: float = 5.0
    frequency_khz: tuple[float, float] = (0.02, 1.5)
    damping: tuple[float, float] = (0.05, 3.0)
    name: str = "biquad"

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 < self.gain_limit < inf:
            raise UsageError(f"controller 'biquad': gain_limit = {self.gain_limit}; give a positive number")
        for name in ("frequency_khz", "damping"):
            low, high = (float(bound) for bound in getattr(self, name))
            if not 0 < low < high < inf:
                raise UsageError(
                    f"controller 'biquad': {name} = ({low:g}, {high:g}); give two positive numbers, lower first"
                )
            object.__setattr__(self, name, (low, high))

    def _axis_gains(self) -> tuple[AxisGain, ...]:
        limit = self.gain_limit
        frequency, damping = (
            min(max(middle, low), high) for middle, (low, high) in ((0.15, self.frequency_khz), (0.7, self.damping))
        )
        return (
            *(AxisGain(f"b{i}", 0.0, -limit, limit, "m/m") for i in range(3)),
            AxisGain("frequency", frequency, *self.frequency_khz, "kHz"),
            AxisGain("damping", damping, *self.damping, ""),
        )

    def _filter(self, gain: Mapping[str, Any], lowpass: tuple[Any, ...]) -> tuple[Any, Any, Any, Any]:
        w, z = 2e3 * np.pi * gain["frequency"], gain["damping"]
        # states w^2/den and w s/den; s^2/den = 1 - 2 z (second) - (first)
        A = ca.blockcat([[ca.SX(1, 1), ca.SX(w)], [ca.SX(-w), ca.SX(-2 * z * w)]])
        B = ca.vertcat(0, w)
        C = ca.horzcat(gain["b0"] - gain["b2"], gain["b1"] - 2 * z * gain["b2"])
        A_lp, B_lp, C_lp, D_lp = lowpass
        n = A_lp.shape[0]
        series = ca.blockcat([[A_lp, ca.SX(n, 2)], [B @ C_lp, A]])
        return series, ca.vertcat(B_lp, B @ D_lp), ca.horzcat(gain["b2"] * C_lp, C), gain["b2"] * D_lp
