"""Actuators and rotor-bearing in series: paper, Eqs. 3 and 20."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import casadi as ca

from gbid.discretise import Hold
from gbid.errors import UsageError
from gbid.structure.linear import as_names
from gbid.structure.parameter import Parameter, Values
from gbid.structure.piezo_pair import PiezoPair
from gbid.structure.rotor_bearing import RotorBearing


@dataclass(frozen=True)
class Plant:
    """``G = G_rb G_act``: from the references r to the piezo positions u and the disc position p.

    The references are held between samples, so this structure has no error from the hold. States are those of
    the actuators, then those of the rotor-bearing.

    Parameters
    ----------
    bearing : RotorBearing
    actuators : PiezoPair
    outputs : ("u", "p") or ("p",)
        What it explains. From r to p alone the actuators' gain and the input gain enter only as their
        product, so a fit must then hold the actuators' parameters (``fit(..., fixed={...})``).
    """

    bearing: RotorBearing = field(default_factory=RotorBearing)
    actuators: PiezoPair = field(default_factory=PiezoPair)
    outputs: tuple[str, ...] = ("u", "p")
    name: str = "plant"
    inputs: tuple[str, ...] = ("r",)
    intersample: Hold = "zoh"

    def __post_init__(self) -> None:
        outputs: str | Sequence[str] = self.outputs
        object.__setattr__(self, "outputs", as_names(outputs))
        if self.outputs not in (("u", "p"), ("p",)):
            raise UsageError(f"{self.name}: outputs = {self.outputs}; choose ('u', 'p') or ('p',)")
        if self.actuators.disturbance_gain != "none":
            raise UsageError(f"{self.name}: the actuators' disturbance gain must be 'none' in series")

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Those of the actuators, then those of the rotor-bearing."""
        return (*self.actuators.parameters, *self.bearing.parameters)

    def matrices(self, p: Values) -> dict[str, Any]:
        """Return A, B, C, D and K of the series for parameters by name."""
        act, rb = self.actuators.matrices(p), self.bearing.matrices(p)
        n_a, n_b = act["A"].shape[0], rb["A"].shape[0]
        A = ca.blockcat([[act["A"], ca.SX(n_a, n_b)], [rb["B"] @ act["C"], rb["A"]]])
        B = ca.vertcat(act["B"], ca.SX(n_b, 2))
        to_u = ca.horzcat(act["C"], ca.SX(2, n_b))
        to_p = ca.horzcat(rb["D"] @ act["C"], rb["C"])
        with_u = "u" in self.outputs
        K = ca.vertcat(ca.SX(n_a, 2), rb["K"])
        return {
            "A": A,
            "B": B,
            "C": ca.vertcat(to_u, to_p) if with_u else to_p,
            "D": ca.SX(4 if with_u else 2, 2),
            "K": ca.horzcat(ca.SX(n_a + n_b, 2), K) if with_u else K,
        }
