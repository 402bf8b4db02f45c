"""Full proportional controller: two by two gains."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from gbid.control.controllers.parts import AxisGain, Crossed, inside


@dataclass(frozen=True)
class FullPStructure(Crossed):
    r"""Proportional controller with cross-coupling and low-pass.

    .. math:: K(s) = \begin{pmatrix} \kappa_{xx} & \kappa_{xy} \\ \kappa_{yx} & \kappa_{yy} \end{pmatrix}
                     \left(\frac{p_{lp}}{s + p_{lp}}\right)^n

    Parameters
    ----------
    lower, upper : float
        Bounds of the gains [m/m].
    lowpass_hz, order, tune_corner, axes
        As in `PStructure`.
    """

    lower: float = -3.0
    upper: float = 3.0
    name: str = "full P"

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check_bounds(self.lower, self.upper)

    def _axis_gains(self) -> tuple[AxisGain, ...]:
        return ()

    def _crossed_gains(self) -> tuple[AxisGain, ...]:
        return (AxisGain("kappa", inside(0.0, (self.lower, self.upper)), self.lower, self.upper, "m/m"),)

    def _filter(self, gain: Mapping[str, Any], lowpass: tuple[Any, ...]) -> tuple[Any, Any, Any, Any]:
        A, B, C, D = lowpass
        return A, B, gain["kappa"] * C, gain["kappa"] * D
