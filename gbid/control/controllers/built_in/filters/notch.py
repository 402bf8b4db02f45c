"""Proportional controller with a notch filter per axis."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from gbid.control.controllers.parts import AxisGain, PerAxis, in_series, inside, second_order


@dataclass(frozen=True)
class NotchStructure(PerAxis):
    r"""Proportional controller with a notch per axis.

    .. math:: K_i(s) = \kappa_i \frac{s^2 + 2 d_i \zeta_i \omega_i s + \omega_i^2}
                                     {s^2 + 2 \zeta_i \omega_i s + \omega_i^2}
                       \left(\frac{p_{lp}}{s + p_{lp}}\right)^n

    The gains per axis are ``kappa`` [m/m], ``frequency`` [kHz], ``width`` (zeta) and ``depth`` (d, the gain at the
    frequency: 0 blocks it, 1 is no notch, above 1 is a peak).

    Parameters
    ----------
    lower, upper : float
        Bounds of kappa [m/m].
    frequency_khz, width, depth : (lowest, highest)
        Bounds of frequency [kHz], width and depth.
    lowpass_hz, order, tune_corner, axes
        As in `PStructure`.
    """

    lower: float = -3.0
    upper: float = 3.0
    frequency_khz: tuple[float, float] = (0.02, 1.5)
    width: tuple[float, float] = (0.05, 3.0)
    depth: tuple[float, float] = (0.01, 4.0)
    name: str = "notch"

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check_bounds(self.lower, self.upper)
        self._check_ranges("frequency_khz", "width", "depth")

    def _axis_gains(self) -> tuple[AxisGain, ...]:
        return (
            AxisGain("kappa", inside(0.0, (self.lower, self.upper)), self.lower, self.upper, "m/m"),
            AxisGain("frequency", inside(0.15, self.frequency_khz), *self.frequency_khz, "kHz"),
            AxisGain("width", inside(0.7, self.width), *self.width, ""),
            AxisGain("depth", inside(0.5, self.depth), *self.depth, ""),
        )

    def _filter(self, gain: Mapping[str, Any], lowpass: tuple[Any, ...]) -> tuple[Any, Any, Any, Any]:
        kappa, zeta = gain["kappa"], gain["width"]
        b = (kappa, 2 * gain["depth"] * zeta * kappa, kappa)
        return in_series(lowpass, second_order(b, gain["frequency"], zeta))
