"""Positive position feedback per axis."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from gbid.control.controllers.parts import AxisGain, PerAxis, in_series, inside, pole_gains, second_order


@dataclass(frozen=True)
class PPFStructure(PerAxis):
    r"""Positive position feedback: a second-order low-pass per axis (Goh and Caughey 1985).

    .. math:: K_i(s) = \frac{\kappa_i \omega_i^2}{s^2 + 2 \zeta_i \omega_i s + \omega_i^2}

    The gains per axis are ``kappa`` [m/m], ``frequency`` [kHz] and ``damping``. It falls by 40 dB per decade, so that
    modes above its frequency are hardly excited.

    Parameters
    ----------
    lower, upper : float
        Bounds of kappa [m/m].
    frequency_khz, damping : (lowest, highest)
        Bounds of frequency [kHz] and damping factor of the filter.
    lowpass_hz, order, tune_corner, axes
        As in `PStructure`; by default there is no further low-pass.
    """

    order: int = 0
    lower: float = 0.0
    upper: float = 3.0
    frequency_khz: tuple[float, float] = (0.02, 1.5)
    damping: tuple[float, float] = (0.05, 3.0)
    name: str = "PPF"

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check_bounds(self.lower, self.upper)
        self._check_ranges("frequency_khz", "damping")

    def _axis_gains(self) -> tuple[AxisGain, ...]:
        return (
            AxisGain("kappa", inside(0.0, (self.lower, self.upper)), self.lower, self.upper, "m/m"),
            *pole_gains(self.frequency_khz, self.damping),
        )

    def _filter(self, gain: Mapping[str, Any], lowpass: tuple[Any, ...]) -> tuple[Any, Any, Any, Any]:
        return in_series(lowpass, second_order((gain["kappa"], 0.0, 0.0), gain["frequency"], gain["damping"]))
