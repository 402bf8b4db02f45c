"""Structure of two pairs of PD-controlled piezo actuators (paper, Sec. 3.3)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import casadi as ca

from gbid.brief import Brief
from gbid.discretise import Hold
from gbid.errors import UsageError
from gbid.structure.parameter import Parameter, Values

AXES = ("x", "y")


@dataclass(frozen=True)
class PiezoPair(Brief):
    """Piezo pairs with the transfer function ``kappa / ((s/p1 + 1) (s/p2 + 1))`` per axis, from r to u (Eqs. 12 to 14).

    The input is the position reference r, the output the position difference u. The states are
    ``[output of the slow pole, u]`` for x, then for y.

    Parameters
    ----------
    disturbance_gain : {"none", "full"}
        ``"full"``: the disturbance d_a acts on the states of its own axis with gains to be estimated (Eq. 14).
        ``"none"``: it acts on the output only, as in the parameter list of Eq. 13.
    """

    disturbance_gain: Literal["none", "full"] = "none"
    name: str = "piezo_pair"
    inputs: tuple[str, ...] = ("r",)
    outputs: tuple[str, ...] = ("u",)
    intersample: Hold = "zoh"

    def __post_init__(self) -> None:
        if self.disturbance_gain not in ("none", "full"):
            raise UsageError(f"{self.name}: disturbance_gain = {self.disturbance_gain!r}; choose 'none' or 'full'")

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Slow pole p1, fast pole p2 and gain kappa of each axis."""
        parameters = []
        for axis in AXES:
            parameters += [Parameter(f"{pole}_{axis}", lower=1.0, upper=1e6, unit="rad/s") for pole in ("p1", "p2")]
            parameters.append(Parameter(f"kappa_{axis}", unit="m/m"))
        if self.disturbance_gain == "full":
            parameters += [Parameter(f"bd{i}_{axis}", 0.0, unit="1/s") for axis in AXES for i in (1, 2)]
        return tuple(parameters)

    def matrices(self, p: Values) -> dict[str, Any]:
        """Return A, B, C, D and K for parameters by name."""
        blocks = [self._axis(p, axis) for axis in AXES]
        return {letter: ca.diagcat(*(block[letter] for block in blocks)) for letter in "ABCDK"}

    def _axis(self, p: Values, axis: str) -> dict[str, ca.SX]:
        slow, fast = p[f"p1_{axis}"], p[f"p2_{axis}"]
        A = ca.vertcat(ca.horzcat(-slow, 0), ca.horzcat(fast, -fast))
        B = ca.vertcat(slow * p[f"kappa_{axis}"], 0)
        K = ca.vertcat(*(p.get(f"bd{i}_{axis}", 0) for i in (1, 2)))
        return {
            "A": ca.sparsify(A),
            "B": ca.sparsify(B),
            "C": ca.SX([[0, 1]]),
            "D": ca.SX(1, 1),
            "K": ca.SX(K),
        }
