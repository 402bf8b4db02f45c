"""Biquad controller: a second-order filter per axis."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from gbid.control.controllers.parts import AxisGain, PerAxis, in_series, pole_gains, second_order


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
    lowpass_hz, order, tune_corner, axes
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
        self._check_positive(gain_limit=self.gain_limit)
        self._check_ranges("frequency_khz", "damping")

    def _axis_gains(self) -> tuple[AxisGain, ...]:
        limit = self.gain_limit
        return (
            *(AxisGain(f"b{i}", 0.0, -limit, limit, "m/m") for i in range(3)),
            *pole_gains(self.frequency_khz, self.damping),
        )

    def _filter(self, gain: Mapping[str, Any], lowpass: tuple[Any, ...]) -> tuple[Any, Any, Any, Any]:
        b = [gain[f"b{i}"] for i in range(3)]
        return in_series(lowpass, second_order(b, gain["frequency"], gain["damping"]))
