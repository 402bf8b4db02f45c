"""Full biquad controller: a second-order filter per input, with a numerator to each output."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from gbid.control.controllers.parts import AxisGain, Crossed, in_series, pole_gains, second_order


@dataclass(frozen=True)
class FullBiquadStructure(Crossed):
    r"""Biquad controller with cross-coupling: the filters of an input share their denominator.

    .. math:: K_{ij}(s) = \frac{b_{2,ij} s^2 + b_{1,ij} \omega_j s + b_{0,ij} \omega_j^2}
                               {s^2 + 2 \zeta_j \omega_j s + \omega_j^2} \left(\frac{p_{lp}}{s + p_{lp}}\right)^n

    The gains are ``b0_xx`` ... ``b2_yy`` [m/m], and ``frequency`` [kHz] and ``damping`` of each input.

    Parameters
    ----------
    gain_limit : float
        Bound on the magnitude of the numerators' gains [m/m].
    frequency_khz, damping : (lowest, highest)
        Bounds of frequency [kHz] and damping factor, which keep the filters stable.
    lowpass_hz, order, tune_corner, axes
        As in `PStructure`; by default there is no low-pass.
    """

    order: int = 0
    gain_limit: float = 5.0
    frequency_khz: tuple[float, float] = (0.02, 1.5)
    damping: tuple[float, float] = (0.05, 3.0)
    name: str = "full biquad"

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check_positive(gain_limit=self.gain_limit)
        self._check_ranges("frequency_khz", "damping")

    def _axis_gains(self) -> tuple[AxisGain, ...]:
        return pole_gains(self.frequency_khz, self.damping)

    def _crossed_gains(self) -> tuple[AxisGain, ...]:
        return tuple(AxisGain(f"b{i}", 0.0, -self.gain_limit, self.gain_limit, "m/m") for i in range(3))

    def _filter(self, gain: Mapping[str, Any], lowpass: tuple[Any, ...]) -> tuple[Any, Any, Any, Any]:
        b = [gain[f"b{i}"] for i in range(3)]
        return in_series(lowpass, second_order(b, gain["frequency"], gain["damping"]))
