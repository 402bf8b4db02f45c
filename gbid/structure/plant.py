"""Structure of actuators and rotor-bearing in series (paper, Eqs. 3 and 20)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import casadi as ca

from gbid.brief import Brief
from gbid.discretise import Hold
from gbid.errors import UsageError
from gbid.structure.linear import as_names
from gbid.structure.parameter import Parameter, Values
from gbid.structure.piezo_pair import PiezoPair
from gbid.structure.rotor_bearing import RotorBearing


@dataclass(frozen=True)
class Plant(Brief):
    """Plant ``G = G_rb G_act``: from the references r to the piezo positions u and the disc position p.

    The references are really held between samples, so zero-order hold is exact for this structure. The states are
    those of the actuators, then those of the rotor-bearing.

    Parameters
    ----------
    bearing : RotorBearing
        Structure of rotor and bearing.
    actuators : PiezoPair
        Structure of the actuators.
    outputs : ("u", "p") or ("p",)
        Output signals. From r to p alone only the product of actuator gain and input gain can be identified, so a fit
        must then fix the parameters of the actuators (``fit(..., fixed={...})``).
    """

    bearing: RotorBearing = field(default_factory=RotorBearing)
    actuators: PiezoPair = field(default_factory=PiezoPair)
    outputs: tuple[str, ...] = ("u", "p")
    name: str = "plant"
    inputs: tuple[str, ...] = ("r",)
    intersample: Hold | tuple[Hold, ...] = "zoh"

    def __post_init__(self) -> None:
        if self.bearing.unbalance and self.inputs == ("r",):
            object.__setattr__(self, "inputs", ("r", "unbalance"))
            object.__setattr__(self, "intersample", ("zoh", "zoh", "foh", "foh"))
        outputs: str | Sequence[str] = self.outputs
        object.__setattr__(self, "outputs", as_names(outputs))
        if self.outputs not in (("u", "p"), ("p",)):
            raise UsageError(f"{self.name}: outputs = {self.outputs}; choose ('u', 'p') or ('p',)")
        if self.bearing.film != "linear":
            raise UsageError(f"{self.name}: film = {self.bearing.film!r} is for fits of the bearing alone, from u to p")
        if self.actuators.disturbance_gain != "none":
            raise UsageError(f"{self.name}: the actuators' disturbance gain must be 'none' in series")

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Parameters of the actuators, then those of the rotor-bearing."""
        return (*self.actuators.parameters, *self.bearing.parameters)

    @property
    def forgotten_states(self) -> tuple[int, ...]:
        """States of the delays, and of actuators that no output shows: they forget their start within milliseconds."""
        n_a = 4
        if self.bearing.delay == "exact":  # see `_with_exact_delay`
            return tuple(range(n_a, 2 * n_a) if self._explains_u else range(n_a))
        shown = () if self._explains_u else range(n_a)
        return (*shown, *(n_a + i for i in self.bearing.forgotten_states))

    def matrices(self, p: Values) -> dict[str, Any]:
        """Return the matrices A, B, C, D and K of the series connection."""
        act, whole = self.actuators.matrices(p), self.bearing.matrices(p)
        rb = {**whole, "B": whole["B"][:, :2], "D": whole["D"][:, :2]}
        if self.bearing.delay == "exact":
            rb |= {"B_delayed": whole["B_delayed"][:, :2], "delay": whole["delay"][:2]}
            found = self._with_exact_delay(act, rb)
        else:
            found = self._with_pade(act, rb)
        return _with_forces(found, whole["B"][:, 2:]) if self.bearing.unbalance else found

    def _with_pade(self, act: dict[str, Any], rb: dict[str, Any]) -> dict[str, Any]:
        """Return the series connection with the delays of the bearing as states."""
        n_a, n_b = act["A"].shape[0], rb["A"].shape[0]
        A = ca.blockcat([[act["A"], ca.SX(n_a, n_b)], [rb["B"] @ act["C"], rb["A"]]])
        to_u = ca.horzcat(act["C"], ca.SX(2, n_b))
        to_p = ca.horzcat(rb["D"] @ act["C"], rb["C"])
        return {
            "A": A,
            "B": ca.vertcat(act["B"], ca.SX(n_b, 2)),
            "C": ca.vertcat(to_u, to_p) if self._explains_u else to_p,
            "D": ca.SX(len(self.outputs) * 2, 2),
            "K": self._disturbance_gain(n_a, rb["K"]),
        }

    def _with_exact_delay(self, act: dict[str, Any], rb: dict[str, Any]) -> dict[str, Any]:
        """Return the series connection with the delays moved to the references.

        Each delay commutes with the actuator of its axis. When u is an output as well, the actuators occur twice,
        once without and once with the delay.
        """
        n_a, n_b = act["A"].shape[0], rb["A"].shape[0]
        late = ca.blockcat([[act["A"], ca.SX(n_a, n_b)], [rb["B_delayed"] @ act["C"], rb["A"]]])
        late_B = ca.vertcat(act["B"], ca.SX(n_b, 2))
        to_p = ca.horzcat(ca.SX(2, n_a), rb["C"])
        n_prompt = n_a if self._explains_u else 0
        n = n_prompt + n_a + n_b
        if not self._explains_u:
            A, B, B_delayed, C = late, ca.SX(n, 2), late_B, to_p
        else:
            A = ca.diagcat(act["A"], late)
            B = ca.vertcat(act["B"], ca.SX(n_a + n_b, 2))
            B_delayed = ca.vertcat(ca.SX(n_a, 2), late_B)
            C = ca.diagcat(act["C"], to_p)
        K = self._disturbance_gain(n_prompt + n_a, rb["K"])
        D = ca.SX(len(self.outputs) * 2, 2)
        return {"A": A, "B": B, "B_delayed": B_delayed, "delay": rb["delay"], "C": C, "D": D, "K": K}

    @property
    def _explains_u(self) -> bool:
        return "u" in self.outputs

    def _disturbance_gain(self, n_before: int, K: ca.SX) -> ca.SX:
        """Return the gain of the disturbance of the bearing, for all states and outputs."""
        below = ca.vertcat(ca.SX(n_before, 2), K)
        return ca.horzcat(ca.SX(below.shape[0], 2), below) if self._explains_u else below


def _with_forces(found: dict[str, Any], forces: ca.SX) -> dict[str, Any]:
    """Return the matrices with further inputs that act on the states of the bearing, which are the last."""
    n, m = found["A"].shape[0], forces.shape[1]
    acting = ca.vertcat(ca.SX(n - forces.shape[0], m), forces)
    more = {"B": ca.horzcat(found["B"], acting), "D": ca.horzcat(found["D"], ca.SX(found["D"].shape[0], m))}
    if "delay" in found:
        more |= {
            "B_delayed": ca.horzcat(found["B_delayed"], ca.SX(n, m)),
            "delay": ca.vertcat(found["delay"], ca.SX.zeros(m, 1)),
        }
    return {**found, **more}
