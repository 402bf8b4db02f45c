"""Structure of the rotor on its controllable gas bearing (paper, Sec. 3.2)."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf
from typing import Any, Literal

import casadi as ca

from gbid.brief import Brief
from gbid.discretise import Hold
from gbid.errors import UsageError
from gbid.structure.delay import pade_delay
from gbid.structure.parameter import Parameter, Values

AXES = ("x", "y")
PAIRS = ("xx", "xy", "yx", "yy")
DisturbanceGain = Literal["full", "diagonal", "states", "none"]
Film = Literal["linear", "stiffening"]
STIFFENING = "stiffening"
"""Name of the parameter of a stiffening film, 1/l^2 [1/m^2]."""

KEY_PARAMETERS = (
    *(f"{letter}_{pair}" for letter in "kdb" for pair in PAIRS),
    *(f"tau_{axis}" for axis in AXES),
)
"""The fourteen parameters that are compared across recordings (paper, Sec. 3.6)."""

_UNITS = {"k": "N/(kg m)", "d": "N s/(kg m)", "b": "N/(kg m)"}


@dataclass(frozen=True)
class RotorBearing(Brief):
    """Rotor and gas bearing: two coupled degrees of freedom with two input delays.

    ``pdd = K p + D pd + B u(t - tau)`` per unit mass (Eqs. 5 to 7), with delays as Pade all-pass filters (Eq. 9). The
    states are ``[p_x, p_y, pd_x, pd_y, delay states]`` (Eq. 10). Disturbances enter the velocity rows through ``B_d``
    (Eqs. 7, 11). The input is u, the output is p.

    Parameters
    ----------
    pade_order : int
        Order of the approximation of the delays; the paper uses 1.
    delay : {"pade", "exact"}
        Delays as all-pass filters of `pade_order`, or exact for any fraction of a sample. With exact delays there are
        no delay states, and simulation and frequency response of the model use the exact delay.
    disturbance_gain : {"full", "diagonal", "states", "none"}
        Entries of ``B_d`` that are estimated: all four, two, or none. With "states" disturbances also enter the
        position rows through ``B_p`` (bp_xx to bp_yy [1/s]), as in a steady-state Kalman filter. This is for a rotor
        with process noise.
    film : {"linear", "stiffening"}
        Stiffness of the film. With "stiffening" it grows with the distance from the centre, ``K (1 + s |p|^2) p``, with
        one more parameter ``stiffening`` s [1/m^2] (`gbid.rig.FilmStiffening`). The fit is then nonlinear. `matrices`
        are those of small amplitudes.
    unbalance : bool
        Whether a mass unbalance acts on the rotor, with the unknowns e_cos and e_sin [m]. A second input "unbalance"
        then has the channels Omega^2 cos(phi) and Omega^2 sin(phi), see `gbid.with_unbalance`. It is for recordings in
        which the speed changes, where no map over the shaft angle removes the response to it.

    Raises
    ------
    UsageError
        When an option is unknown.
    """

    pade_order: int = 1
    delay: Literal["pade", "exact"] = "pade"
    disturbance_gain: DisturbanceGain = "full"
    film: Film = "linear"
    unbalance: bool = False
    name: str = "rotor_bearing"
    inputs: tuple[str, ...] = ("u",)
    outputs: tuple[str, ...] = ("p",)
    intersample: Hold = "foh"

    def __post_init__(self) -> None:
        if self.unbalance and self.inputs == ("u",):
            object.__setattr__(self, "inputs", ("u", "unbalance"))
        if self.pade_order < 1:
            raise UsageError(f"{self.name}: pade_order = {self.pade_order}; it must be at least 1")
        if self.delay not in ("pade", "exact"):
            raise UsageError(f"{self.name}: delay = {self.delay!r}; choose 'pade' or 'exact'")
        if self.disturbance_gain not in ("full", "diagonal", "states", "none"):
            raise UsageError(
                f"{self.name}: disturbance_gain = {self.disturbance_gain!r}; "
                "choose 'full', 'diagonal', 'states' or 'none'"
            )
        if self.film not in ("linear", "stiffening"):
            raise UsageError(f"{self.name}: film = {self.film!r}; choose 'linear' or 'stiffening'")

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Stiffness k, damping d and input gain b per unit mass, delays tau, stiffening, disturbance gains bd, bp."""
        coefficients = [Parameter(f"{letter}_{pair}", unit=_UNITS[letter]) for letter in "kdb" for pair in PAIRS]
        # A negative delay has an unstable Pade pole, and a zero delay has none. The lower bound is far below a sample.
        delays = [Parameter(f"tau_{axis}", lower=5e-6, upper=5e-3, unit="s") for axis in AXES]
        gains = [
            Parameter(name, 0.0, -inf, inf, unit="1/s" if name.startswith("bp") else "1/s^2")
            for name in self._gain_names()
        ]
        rotating = [Parameter(f"e_{part}", 0.0, unit="m") for part in ("cos", "sin") if self.unbalance]
        film = [Parameter(STIFFENING, 0.0, unit="1/m^2")] if self.film == "stiffening" else []
        return (*coefficients, *delays, *film, *rotating, *gains)

    def matrices(self, p: Values) -> dict[str, Any]:
        """Return the matrices of Eq. 10, or of Eqs. 6 and 7 with exact delays."""
        found = self._of_bearing(p)
        if not self.unbalance:
            return found
        n = found["A"].shape[0]
        turned = ca.vertcat(ca.horzcat(p["e_cos"], -p["e_sin"]), ca.horzcat(p["e_sin"], p["e_cos"]))
        found["B"] = ca.horzcat(found["B"], ca.vertcat(ca.SX(2, 2), turned, ca.SX(n - 4, 2)))
        found["D"] = ca.SX(2, 4)
        if self.delay == "exact":
            found["B_delayed"] = ca.horzcat(found["B_delayed"], ca.SX(n, 2))
            found["delay"] = ca.vertcat(found["delay"], ca.SX.zeros(2, 1))
        return found

    def _of_bearing(self, p: Values) -> dict[str, Any]:
        """Return the matrices without unbalance."""
        stiffness, damping, input_gain = (square(p, letter) for letter in "kdb")
        if self.delay == "exact":
            zero, eye = ca.SX(2, 2), ca.SX.eye(2)
            return {
                "A": ca.blockcat([[zero, eye], [stiffness, damping]]),
                "B": ca.SX(4, 2),
                "B_delayed": ca.vertcat(zero, input_gain),
                "delay": ca.vertcat(p["tau_x"], p["tau_y"]),
                "C": ca.horzcat(eye, zero),
                "D": zero,
                "K": self._gain(p),
            }
        n_tau = self.pade_order
        delays = [pade_delay(p[f"tau_{axis}"], n_tau) for axis in AXES]
        A_tau, B_tau, C_tau, D_tau = (ca.diagcat(*(getattr(delay, letter) for delay in delays)) for letter in "ABCD")
        zero, eye = ca.SX(2, 2), ca.SX.eye(2)
        A = ca.blockcat(
            [
                [ca.horzcat(zero, eye), ca.SX(2, 2 * n_tau)],
                [ca.horzcat(stiffness, damping), input_gain @ C_tau],
                [ca.SX(2 * n_tau, 4), A_tau],
            ]
        )
        B = ca.vertcat(zero, input_gain @ D_tau, B_tau)
        C = ca.horzcat(eye, ca.SX(2, 2 + 2 * n_tau))
        return {"A": A, "B": B, "C": C, "D": zero, "K": ca.vertcat(self._gain(p), ca.SX(2 * n_tau, 2))}

    @property
    def forgotten_states(self) -> tuple[int, ...]:
        """States of the Padé filters, which forget their start within milliseconds; none with exact delays."""
        return () if self.delay == "exact" else tuple(range(4, 4 + 2 * self.pade_order))

    def _gain_names(self) -> list[str]:
        velocities = [f"bd_{pair}" for pair in PAIRS]
        return {
            "full": velocities,
            "diagonal": ["bd_xx", "bd_yy"],
            "states": [*(f"bp_{pair}" for pair in PAIRS), *velocities],
            "none": [],
        }[self.disturbance_gain]

    def _gain(self, p: Values) -> Any:
        """Return the disturbance gain of positions and velocities, (4, 2)."""
        entries = [[p.get(f"{letter}_{axis}{error}", 0) for error in AXES] for letter in ("bp", "bd") for axis in AXES]
        return ca.sparsify(ca.SX(ca.vertcat(*(ca.horzcat(*row) for row in entries))))


def square(p: Values, letter: str) -> Any:
    """Return the 2x2 matrix of the entries ``letter_xx`` to ``letter_yy``."""
    xx, xy, yx, yy = (p[f"{letter}_{pair}"] for pair in PAIRS)
    return ca.vertcat(ca.horzcat(xx, xy), ca.horzcat(yx, yy))
