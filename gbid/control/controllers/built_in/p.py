"""Decentralised proportional controller (paper, Eq. 21)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from gbid.control.controllers.parts import AxisGain, PerAxis, inside


@dataclass(frozen=True)
class PStructure(PerAxis):
    r"""Decentralised proportional controller with low-pass (paper, Eq. 21).

    .. math:: K_i(s) = \kappa_i \left(\frac{p_{lp}}{s + p_{lp}}\right)^n

    The gains are ``kappa_x``, ``kappa_y`` [m/m].

    Parameters
    ----------
    lowpass_hz : float
        Corner frequency of the low-pass [Hz].
    order : int
        Order n of the low-pass; 0 for none.
    tune_corner : bool
        Whether the corner frequency is a gain as well, ``lowpass_khz`` [kHz].
    lower, upper : float
        Bounds of the gains [m/m].
    axes : tuple of str
        Names of the axes; ``("",)`` for one input and one output with plain names.
    """

    lower: float = 0.0
    upper: float = 3.0
    name: str = "P"

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check_bounds(self.lower, self.upper)

    def _axis_gains(self) -> tuple[AxisGain, ...]:
        return (AxisGain("kappa", inside(0.0, (self.lower, self.upper)), self.lower, self.upper, "m/m"),)

    def _filter(self, gain: Mapping[str, Any], lowpass: tuple[Any, ...]) -> tuple[Any, Any, Any, Any]:
        A, B, C, D = lowpass
        return A, B, gain["kappa"] * C, gain["kappa"] * D
