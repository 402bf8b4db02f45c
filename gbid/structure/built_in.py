"""Built-in structures of the test rig: rotor bearing, piezo actuators, and both in series (paper, Sec. 3)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from math import inf
from typing import Any, ClassVar, Literal

import casadi as ca

from gbid.core.brief import Brief
from gbid.core.errors import UsageError
from gbid.core.option_types import Count, Names, check_options
from gbid.discretise import Hold
from gbid.structure.delay import with_filters
from gbid.structure.linear import LoopParts, as_names
from gbid.structure.parameter import Parameter, Values, once

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

    ``pdd = K p + D pd + B u(t - tau)`` per unit mass (Eqs. 5 to 7). The states are ``[p_x, p_y, pd_x, pd_y]``, with a
    `pade_order` followed by those of the delays (Eq. 10). Disturbances enter the velocity rows through ``B_d``
    (Eqs. 7, 11). The input is u, the output is p.

    Parameters
    ----------
    pade_order : int, optional
        Order of Pade all-pass filters in place of exact delays (Eq. 9); the paper uses 1. A filter of order 1 biases
        the delays (docs/delays.md). By default delays are exact for any fraction of a sample.
    delay : {"exact", "pade"}, optional
        By default "pade" with a `pade_order`, else "exact". "pade" alone is of order 1.
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
        then has the channels Omega^2 cos(phi) and Omega^2 sin(phi), see `gbid.recording.with_unbalance`. It is for
        recordings in which the speed changes, where no map over the shaft angle removes the response to it.

    Raises
    ------
    UsageError
        When an option is unknown.
    """

    is_value: ClassVar[bool] = True
    pade_order: Count | None = None
    delay: Literal["exact", "pade"] | None = None
    disturbance_gain: DisturbanceGain = "full"
    film: Film = "linear"
    unbalance: bool = False
    name: str = "rotor_bearing"
    inputs: Names = ("u",)
    outputs: Names = ("p",)
    intersample: Hold = "foh"

    def __post_init__(self) -> None:
        check_options(self, str(self.name))
        if self.unbalance and self.inputs == ("u",):
            object.__setattr__(self, "inputs", ("u", "unbalance"))
        if self.delay == "exact" and self.pade_order is not None:
            raise UsageError(f"{self.name}: pade_order is for delay = 'pade'; exact delays have no order")
        if self.delay is None:
            object.__setattr__(self, "delay", "exact" if self.pade_order is None else "pade")
        if self.delay == "pade" and self.pade_order is None:
            object.__setattr__(self, "pade_order", 1)

    @property
    @once
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
        stiffness, damping, input_gain = (square(p, letter) for letter in "kdb")
        zero, eye = ca.SX(2, 2), ca.SX.eye(2)
        parts = LoopParts(
            ca.blockcat([[zero, eye], [stiffness, damping]]), ca.SX(4, 2), ca.horzcat(eye, zero), zero, self._gain(p)
        )
        B_delayed, delays = ca.vertcat(zero, input_gain), [p[f"tau_{axis}"] for axis in AXES]
        if self.unbalance:
            turned = ca.vertcat(ca.horzcat(p["e_cos"], -p["e_sin"]), ca.horzcat(p["e_sin"], p["e_cos"]))
            parts = parts._replace(B=ca.horzcat(parts.B, ca.vertcat(zero, turned)), D=ca.SX(2, 4))
            B_delayed = ca.horzcat(B_delayed, ca.SX(4, 2))
        if self.pade_order is not None:
            return with_filters(parts, B_delayed, dict(enumerate(delays)), self.pade_order)._asdict()
        none = ca.SX.zeros(parts.B.shape[1] - 2, 1)
        return {**parts._asdict(), "B_delayed": B_delayed, "delay": ca.vertcat(*delays, none)}

    @property
    def forgotten_states(self) -> tuple[int, ...]:
        """States of the Padé filters, whose initial values decay within milliseconds; none with exact delays."""
        return tuple(range(4, 4 + 2 * (self.pade_order or 0)))

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
    """Return the 2x2 matrix of the parameters ``letter_xx`` to ``letter_yy``."""
    xx, xy, yx, yy = (p[f"{letter}_{pair}"] for pair in PAIRS)
    return ca.vertcat(ca.horzcat(xx, xy), ca.horzcat(yx, yy))


# ---- Two pairs of PD-controlled piezo actuators (paper, Sec. 3.3).


@dataclass(frozen=True)
class PiezoPair(Brief):
    """Piezo pairs with the transfer function ``kappa / ((s/p1 + 1) (s/p2 + 1))`` per axis, from r to u (Eqs. 12 to 14).

    The input is the position reference r, the output the position difference u. The states are
    ``[output of the slow pole, u]`` for x, then for y; with `poles` "any" ``[ud / omega, u]``.

    Parameters
    ----------
    poles : {"real", "any"}
        ``"real"``: the poles p1 and p2 of the paper. An actuator whose damping factor is below one has complex poles;
        its fit ends where p1 and p2 are equal. ``"any"``: natural frequency omega [rad/s] and damping factor zeta
        describe real and complex poles, ``kappa omega^2 / (s^2 + 2 zeta omega s + omega^2)``.
    disturbance_gain : {"none", "full"}
        ``"full"``: the disturbance d_a acts on the states of its own axis with gains to be estimated (Eq. 14).
        ``"none"``: it acts on the output only, as in the parameter list of Eq. 13.
    """

    is_value: ClassVar[bool] = True
    disturbance_gain: Literal["none", "full"] = "none"
    name: str = "piezo_pair"
    inputs: Names = ("r",)
    outputs: Names = ("u",)
    intersample: Hold = "zoh"
    poles: Literal["real", "any"] = "real"

    def __post_init__(self) -> None:
        check_options(self, str(self.name))

    @property
    @once
    def parameters(self) -> tuple[Parameter, ...]:
        """Parameters of each axis: poles p1 and p2 (or natural frequency and damping factor), and gain kappa."""
        parameters = []
        for axis in AXES:
            if self.poles == "any":
                parameters.append(Parameter(f"omega_{axis}", lower=1.0, upper=1e6, unit="rad/s"))
                parameters.append(Parameter(f"zeta_{axis}", lower=1e-4, upper=500.0))  # of poles of 1 and 1e6 rad/s
            else:
                parameters += [Parameter(f"{pole}_{axis}", lower=1.0, upper=1e6, unit="rad/s") for pole in ("p1", "p2")]
            parameters.append(Parameter(f"kappa_{axis}", unit="m/m"))
        if self.disturbance_gain == "full":
            parameters += [Parameter(f"bd{i}_{axis}", 0.0, unit="1/s") for axis in AXES for i in (1, 2)]
        return tuple(parameters)

    @property
    def exchangeable(self) -> tuple[tuple[str, str], ...]:
        """Pairs of exchangeable parameters: the two real poles of each axis."""
        return () if self.poles == "any" else tuple((f"p1_{axis}", f"p2_{axis}") for axis in AXES)

    def matrices(self, p: Values) -> dict[str, Any]:
        """Return A, B, C, D and K for given parameter values."""
        blocks = [self._axis(p, axis) for axis in AXES]
        return {letter: ca.diagcat(*(block[letter] for block in blocks)) for letter in "ABCDK"}

    def _axis(self, p: Values, axis: str) -> dict[str, ca.SX]:
        if self.poles == "any":
            omega, zeta = p[f"omega_{axis}"], p[f"zeta_{axis}"]
            A = ca.vertcat(ca.horzcat(-2 * zeta * omega, -omega), ca.horzcat(omega, 0))
            B = ca.vertcat(omega * p[f"kappa_{axis}"], 0)
        else:
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


# ---- Actuators and rotor bearing in series (paper, Eqs. 3 and 20).


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

    is_value: ClassVar[bool] = True
    bearing: RotorBearing = field(default_factory=RotorBearing)
    actuators: PiezoPair = field(default_factory=PiezoPair)
    outputs: Names = ("u", "p")
    name: str = "plant"
    inputs: Names = ("r",)
    intersample: Hold | tuple[Hold, ...] = "zoh"

    def __post_init__(self) -> None:
        check_options(self, "Plant")
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
    @once
    def parameters(self) -> tuple[Parameter, ...]:
        """Parameters of the actuators, then the parameters of the rotor bearing."""
        return (*self.actuators.parameters, *self.bearing.parameters)

    @property
    def exchangeable(self) -> tuple[tuple[str, str], ...]:
        """Pairs of exchangeable parameters: the two real poles of each actuator."""
        return self.actuators.exchangeable

    @property
    def forgotten_states(self) -> tuple[int, ...]:
        """States of delays and of unmeasured actuators: their initial values decay within milliseconds."""
        n_a = 4
        if self.bearing.pade_order is None:  # see `matrices`
            return tuple(range(n_a, 2 * n_a) if self._explains_u else range(n_a))
        shown = () if self._explains_u else range(n_a)
        return (*shown, *(n_a + i for i in self.bearing.forgotten_states))

    def matrices(self, p: Values) -> dict[str, Any]:
        """Return the matrices of the series connection.

        Exact delays are moved to the references: each commutes with the actuator of its axis. When u is an output as
        well, the actuators occur twice, once without and once with the delay.
        """
        act, bearing = self.actuators.matrices(p), self.bearing.matrices(p)
        exact = self.bearing.pade_order is None
        n_a, (n_b, n_u) = act["A"].shape[0], bearing["B"].shape  # further inputs act on the bearing alone
        drive = bearing["B_delayed" if exact else "B"][:, :2]
        A = ca.blockcat([[act["A"], ca.SX(n_a, n_b)], [drive @ act["C"], bearing["A"]]])
        references = ca.vertcat(ca.horzcat(act["B"], ca.SX(n_a, n_u - 2)), ca.SX(n_b, n_u))
        forces = ca.vertcat(ca.SX(n_a, n_u), ca.horzcat(ca.SX(n_b, 2), bearing["B"][:, 2:]))
        to_u, to_p = ca.horzcat(act["C"], ca.SX(2, n_b)), ca.horzcat(bearing["D"][:, :2] @ act["C"], bearing["C"])
        gain = ca.vertcat(ca.SX(n_a, 2), bearing["K"])
        if self._explains_u:
            gain = ca.horzcat(ca.SX(n_a + n_b, 2), gain)
        D = ca.SX(len(self.outputs) * 2, n_u)
        if not exact:
            C = ca.vertcat(to_u, to_p) if self._explains_u else to_p
            return {"A": A, "B": references + forces, "C": C, "D": D, "K": gain}
        delays = {"B_delayed": references, "delay": bearing["delay"]}
        series = {"A": A, "B": forces, "C": to_p, "D": D, "K": gain, **delays}
        if not self._explains_u:
            return series
        prompt = ca.horzcat(act["B"], ca.SX(n_a, n_u - 2))
        return {
            **series,
            "A": ca.diagcat(act["A"], A),
            "B": ca.vertcat(prompt, forces),
            "B_delayed": ca.vertcat(ca.SX(n_a, n_u), references),
            "C": ca.diagcat(act["C"], to_p),
            "K": ca.vertcat(ca.SX(n_a, 4), gain),
        }

    @property
    def _explains_u(self) -> bool:
        return "u" in self.outputs


EXACT_AS_PADE = 3
"""Order of Pade filters in place of exact delays, where a model over pressure and speed must be rational: up to 250 Hz
their phase is off by less than 1e-4 rad for delays below 0.8 ms, that of order 1 by 0.13 rad."""


def pade_order_of(structure: Any) -> int:
    """Return the Padé order of a rotor bearing or plant; `EXACT_AS_PADE` where its delays are exact."""
    bearing = structure.bearing if isinstance(structure, Plant) else structure
    order = bearing.pade_order if isinstance(bearing, RotorBearing) else None
    return EXACT_AS_PADE if order is None else order


def exact_delays(structure: Any) -> tuple[RotorBearing | Plant, list[int]] | None:
    """Return a rotor bearing or plant with exact delays instead of Padé filters, and the new place of each state.

    None for other structures, and where delays are exact already.
    """
    if isinstance(structure, Plant) and (inner := exact_delays(structure.bearing)):
        bearing, motion = inner
        assert isinstance(bearing, RotorBearing)
        delayed_inputs = (
            range(4) if "u" in structure.outputs else ()
        )  # the actuators a second time, see `Plant.matrices`
        return replace(structure, bearing=bearing), [*range(4), *delayed_inputs, *(4 + i for i in motion)]
    if isinstance(structure, RotorBearing) and structure.pade_order is not None:
        return replace(structure, delay="exact", pade_order=None), [*range(4)]
    return None
