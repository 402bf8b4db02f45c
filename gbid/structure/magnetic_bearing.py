"""Structure of a rotor in active magnetic bearings, with amplifiers and sensors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from math import pi
from typing import Annotated, Any

import casadi as ca
import numpy as np

from gbid.core.brief import Brief
from gbid.core.errors import UsageError
from gbid.core.option_types import Allowed, Names, Positive, check_options
from gbid.discretise import Hold
from gbid.structure.linear import Structure, as_names, symbolic_matrices
from gbid.structure.parameter import Parameter, Values

_PLANES = {1: "one position", 2: "x and y of one bearing", 4: "x and y of two bearings"}

PositiveNumber = Annotated[Positive, Allowed("a positive number")]


@dataclass(frozen=True)
class RigidRotor(Brief):
    r"""Rigid rotor in the field of magnetic bearings: from the coil currents of the axes to the positions.

    The force of an axis is ``k_s z + k_i i`` with its position z and its current i (Schweitzer and Maslen, Magnetic
    Bearings, 2009, ch. 4). One axis and two axes (x and y of one bearing) move a mass. Four axes (x and y of two
    bearings) move and tilt a rotor:

    .. math:: m\,\ddot x = f_{ax} + f_{bx}, \qquad
              I_t\,\ddot\alpha + \Omega I_p\,\dot\beta = z_a f_{ax} + z_b f_{bx}, \qquad
              I_t\,\ddot\beta - \Omega I_p\,\dot\alpha = z_a f_{ay} + z_b f_{by}

    with the slopes :math:`\alpha, \beta` of its axis, positive speed from x to y. The states are centre and slopes,
    then their derivatives.

    Parameters
    ----------
    axes : tuple of str
        Names of one, two or four axes, ``("ax", "ay", "bx", "by")``. They end the names of the parameters ``k_s_ax``
        [N/m], positive where the field pulls away from the centre, and ``k_i_ax`` [N/A].
    mass_kg : float
        Mass of the rotor [kg]. With 1 kg the parameters are those per mass.
    inertia_kg_m2, polar_inertia_kg_m2 : float, optional
        Transverse moment of inertia about the centre of mass, and polar one [kg m^2]; four axes need the first.
    arms_m : (float, float), optional
        Positions z of both bearings on the shaft, from the centre of mass [m]; four axes need them.
    sensor_arms_m : (float, float), optional
        Positions of the planes of the sensors; those of the bearings when not given.
    speed_rpm : float
        Speed of the recordings, for the gyroscopic moment.
    k_s, k_i : float, optional
        Start values for all axes [N/m], [N/A]; from the data when not given.

    Raises
    ------
    UsageError
        When there are not one, two or four axes, or when a number does not fit them.
    """

    axes: Names = ("z",)
    mass_kg: PositiveNumber = 1.0
    inertia_kg_m2: float | None = None
    polar_inertia_kg_m2: float = 0.0
    arms_m: tuple[float, float] | None = None
    sensor_arms_m: tuple[float, float] | None = None
    speed_rpm: float = 0.0
    k_s: float | None = None
    k_i: float | None = None
    name: str = "rigid_rotor"
    inputs: Names = ("i",)
    outputs: Names = ("p",)
    intersample: Hold = "zoh"

    def __post_init__(self) -> None:
        check_options(self, self.name)
        if len(self.axes) not in _PLANES:
            choices = ", ".join(f"{n} ({what})" for n, what in _PLANES.items())
            raise UsageError(f"{self.name}: {len(self.axes)} axes; choose from {choices}")
        tilts = (self.inertia_kg_m2, self.arms_m)
        if len(self.axes) == 4 and (None in tilts or not self.inertia_kg_m2 or self.inertia_kg_m2 < 0):
            raise UsageError(f"{self.name}: four axes need inertia_kg_m2 and arms_m = (z_a, z_b)")
        if len(self.axes) < 4 and any(part is not None for part in (*tilts, self.sensor_arms_m)):
            raise UsageError(f"{self.name}: inertia_kg_m2 and arms are for four axes; there are {len(self.axes)}")

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Stiffness of the field, and force per current, of each axis."""
        stiffness = [Parameter(f"k_s_{axis}", self.k_s, unit="N/m") for axis in self.axes]
        return (*stiffness, *(Parameter(f"k_i_{axis}", self.k_i, unit="N/A") for axis in self.axes))

    def matrices(self, p: Values) -> dict[str, Any]:
        """Return A, B and C."""
        n = len(self.axes)
        inertia, gyroscopic, reach, seen = np.full(n, self.mass_kg), np.zeros((n, n)), np.eye(n), np.eye(n)
        if self.arms_m and self.inertia_kg_m2:
            inertia[2:] = self.inertia_kg_m2
            gyroscopic[2, 3] = 2 * pi / 60 * self.speed_rpm * self.polar_inertia_kg_m2
            gyroscopic[3, 2] = -gyroscopic[2, 3]
            reach, seen = (
                np.vstack([np.hstack([np.eye(2), arm * np.eye(2)]) for arm in arms])
                for arms in (self.arms_m, self.sensor_arms_m or self.arms_m)
            )
        pulls = ca.DM(reach.T / inertia[:, None])  # acceleration per force
        k_s, k_i = (ca.diag(ca.vertcat(*(p[f"{k}_{axis}"] for axis in self.axes))) for k in ("k_s", "k_i"))
        turns = ca.sparsify(ca.DM(gyroscopic / inertia[:, None]))
        return {
            "A": ca.blockcat([[ca.SX(n, n), ca.SX.eye(n)], [pulls @ k_s @ ca.DM(reach), -ca.SX(turns)]]),
            "B": ca.vertcat(ca.SX(n, n), pulls @ k_i),
            "C": ca.horzcat(ca.SX(ca.sparsify(ca.DM(seen))), ca.SX(n, n)),
        }


@dataclass(frozen=True)
class MagneticBearing(Brief):
    r"""Rotor in magnetic bearings with amplifiers and sensors: from current references to positions.

    An amplifier is a delay and a lag of first order, :math:`i = e^{-s \tau} / (1 + s / \omega_a)\, i_{ref}`, a sensor a
    lag :math:`1 / (1 + s / \omega_s)`. All axes have equal amplifiers and equal sensors. The states are those of the
    rotor, the currents, and the signals of the sensors.

    The rotor is unstable: fit it in its loop, ``gbid.ClosedLoop(bearing, controller, pade_order=None)`` with
    ``focus="simulation"``.

    Parameters
    ----------
    rotor : Structure
        Rotor from currents to positions: a `RigidRotor`, or one made by `gbid.export.from_ross`, with its currents
        as the only inputs.
    amplifier_hz, amplifier_delay_s : float
        Bandwidth [Hz] and delay [s] of the amplifiers: the start values of ``omega_amplifier`` [rad/s] and
        ``tau_amplifier`` [s]. The delay is exact.
    longest_delay_s : float
        Upper bound of the delay [s].
    sensor_hz : float, optional
        Bandwidth of the sensors [Hz], known: the fixed parameter ``omega_sensor`` [rad/s]. Lags of amplifier and sensor
        act in series, so that positions alone do not tell one from the other. None for sensors without lag.
    outputs : ("p",) or ("i", "p")
        Signals of the recordings: positions, or measured currents before these.

    Raises
    ------
    UsageError
        When a number is not positive, or when the rotor does not fit.
    """

    rotor: Structure = field(default_factory=RigidRotor)
    amplifier_hz: PositiveNumber = 1000.0
    amplifier_delay_s: float = 1e-5
    longest_delay_s: PositiveNumber = 1e-4
    sensor_hz: PositiveNumber | None = None
    name: str = "magnetic_bearing"
    inputs: Names = ("i_ref",)
    outputs: Names = ("p",)
    intersample: Hold = "zoh"

    def __post_init__(self) -> None:
        outputs: str | Sequence[str] = self.outputs
        object.__setattr__(self, "outputs", as_names(outputs))
        if self.outputs not in (("p",), ("i", "p")):
            raise UsageError(f"{self.name}: outputs = {self.outputs}; choose ('p',) or ('i', 'p')")
        check_options(self, self.name)
        if not 0 <= self.amplifier_delay_s <= self.longest_delay_s:
            raise UsageError(f"{self.name}: amplifier_delay_s = {self.amplifier_delay_s}; 0 to longest_delay_s")
        _, m = symbolic_matrices(self.rotor)
        if m.has_delay or m.D.nnz() or m.K.nnz():
            raise UsageError(
                f"{self.name}: the rotor {self.rotor.name!r} has delays, feedthrough or disturbance gains; remove them"
            )

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Parameters of the rotor, then the parameters of amplifiers and sensors."""
        corner, delay = 2 * pi * self.amplifier_hz, self.longest_delay_s
        chain = [
            Parameter("omega_amplifier", corner, lower=corner / 100, upper=100 * corner, unit="rad/s"),
            Parameter("tau_amplifier", self.amplifier_delay_s, lower=0.0, upper=delay, unit="s"),
        ]
        if self.sensor_hz is not None:
            chain.append(Parameter("omega_sensor", 2 * pi * self.sensor_hz, fixed=True, unit="rad/s"))
        return (*self.rotor.parameters, *chain)

    def matrices(self, p: Values) -> dict[str, Any]:
        """Return A, B, C, and the exact delay of the current references."""
        rotor = {letter: ca.SX(matrix) for letter, matrix in self.rotor.matrices(p).items()}
        (n, n_u), n_y = rotor["B"].shape, rotor["C"].shape[0]
        omega = p["omega_amplifier"]
        A = ca.blockcat([[rotor["A"], rotor["B"]], [ca.SX(n_u, n), -omega * ca.SX.eye(n_u)]])
        C = ca.horzcat(rotor["C"], ca.SX(n_y, n_u))
        currents = ca.horzcat(ca.SX(n_u, n), ca.SX.eye(n_u))
        if self.sensor_hz is not None:
            follows = p["omega_sensor"] * ca.SX.eye(n_y)
            A = ca.blockcat([[A, ca.SX(n + n_u, n_y)], [follows @ C, -follows]])
            C, currents = ca.horzcat(ca.SX(n_y, n + n_u), ca.SX.eye(n_y)), ca.horzcat(currents, ca.SX(n_u, n_y))
        drive = ca.vertcat(ca.SX(n, n_u), omega * ca.SX.eye(n_u), ca.SX(A.shape[0] - n - n_u, n_u))
        return {
            "A": A,
            "B": ca.SX(*drive.shape),
            "C": ca.vertcat(currents, C) if "i" in self.outputs else C,
            "B_delayed": drive,
            "delay": ca.SX(ca.repmat(p["tau_amplifier"], n_u, 1)),
        }
