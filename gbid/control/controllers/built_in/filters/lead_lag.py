"""Lead-lag controller per axis."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from gbid.control.controllers.parts import AxisGain, PerAxis, first_order, in_series, inside


@dataclass(frozen=True)
class LeadLagStructure(PerAxis):
    r"""Lead-lag controller: one first-order section per axis.

    .. math:: K_i(s) = \frac{\kappa_{\infty,i}\, s + \kappa_{0,i}\, \omega_i}{s + \omega_i}
                       \left(\frac{p_{lp}}{s + p_{lp}}\right)^n

    The gains per axis are ``low`` (at rest) and ``high`` (at high frequency) [m/m], and ``corner`` [kHz]. With high
    above low it leads, below low it lags.

    Parameters
    ----------
    gain_limit : float
        Bound on the magnitude of the gains [m/m].
    corner_khz : (lowest, highest)
        Bounds of the corner [kHz].
    lowpass_hz, order, tune_corner, axes
        As in `PStructure`.
    """

    gain_limit: float = 5.0
    corner_khz: tuple[float, float] = (0.02, 1.5)
    name: str = "lead-lag"

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check_positive(gain_limit=self.gain_limit)
        self._check_ranges("corner_khz")

    def _axis_gains(self) -> tuple[AxisGain, ...]:
        limit = self.gain_limit
        return (
            AxisGain("low", 0.0, -limit, limit, "m/m"),
            AxisGain("high", 0.0, -limit, limit, "m/m"),
            AxisGain("corner", inside(0.15, self.corner_khz), *self.corner_khz, "kHz"),
        )

    def _filter(self, gain: Mapping[str, Any], lowpass: tuple[Any, ...]) -> tuple[Any, Any, Any, Any]:
        return in_series(lowpass, first_order(gain["low"], gain["high"], gain["corner"]))
