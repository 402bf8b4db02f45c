"""The machine that the virtual rig simulates: true parameters, never estimates."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from gbid.errors import UsageError
from gbid.recording import FloatArray
from gbid.rig.sensors import SensorChain


def fixed_array(owner: str, name: str, values: npt.ArrayLike, shape: tuple[int, ...]) -> FloatArray:
    """Read-only float array of a given shape.

    Raises
    ------
    UsageError
        When the shape differs or a number is not finite.
    """
    array = np.array(values, dtype=float)
    if array.shape != shape:
        raise UsageError(f"{owner}: {name} has shape {array.shape}, expected {shape}")
    if not np.isfinite(array).all():
        raise UsageError(f"{owner}: {name} = {array.tolist()} holds a value that is not finite")
    array.setflags(write=False)
    return array


@dataclass(frozen=True, eq=False)
class RotorBearingTruth:
    r"""Rotor and gas bearing at one operating point (paper, Eqs. 5 to 8), with exact delays.

    .. math:: \ddot p = K p + D \dot p + B u_\tau, \quad u_\tau = [u_x(t - \tau_x), u_y(t - \tau_y)]

    All per kg of moving mass, in the paper's sign: stiffness and damping have negative diagonals.

    Parameters
    ----------
    stiffness : (2, 2) array
        K [N/(kg m)].
    damping : (2, 2) array
        D [N s/(kg m)].
    input_gain : (2, 2) array
        B [N/(kg m)].
    delay : (2,) array
        tau [s], at least zero; any real number, no multiple of a grid.

    Raises
    ------
    UsageError
        For wrong shapes, values that are not finite, negative delays.
    """

    stiffness: FloatArray
    damping: FloatArray
    input_gain: FloatArray
    delay: FloatArray

    def __post_init__(self) -> None:
        for name, shape in (
            ("stiffness", (2, 2)),
            ("damping", (2, 2)),
            ("input_gain", (2, 2)),
            ("delay", (2,)),
        ):
            value = fixed_array("rotor bearing", name, getattr(self, name), shape)
            object.__setattr__(self, name, value)
        if (self.delay < 0).any():
            raise UsageError(f"rotor bearing: delay = {self.delay.tolist()} s; delays cannot be negative")

    def check_stable(self) -> None:
        """Refuse a rotor that does not come to rest by itself.

        Raises
        ------
        UsageError
            When an eigenvalue of [0 I; K D] has no negative real part.
        """
        matrix = np.block([[np.zeros((2, 2)), np.eye(2)], [self.stiffness, self.damping]])
        worst = max(np.linalg.eigvals(matrix), key=lambda s: float(s.real))
        if worst.real >= 0:
            raise UsageError(
                f"rotor bearing: unstable, eigenvalue {worst:.4g} 1/s; the rig simulates stable points only"
            )


@dataclass(frozen=True, eq=False)
class ActuatorTruth:
    r"""Controlled piezo pairs from reference r to position difference u (paper, Eq. 12), one per axis.

    .. math:: G_{a,j}(s) = \frac{\kappa_j}{(s/p_{1,j} + 1)(s/p_{2,j} + 1)}

    Parameters
    ----------
    slow_pole, fast_pole : (2,) array
        p_1 and p_2 [rad/s], positive.
    gain : (2,) array
        kappa [m/m].

    Raises
    ------
    UsageError
        For wrong shapes, values that are not finite, poles that are not positive.
    """

    slow_pole: FloatArray
    fast_pole: FloatArray
    gain: FloatArray

    def __post_init__(self) -> None:
        for name in ("slow_pole", "fast_pole", "gain"):
            object.__setattr__(self, name, fixed_array("actuator", name, getattr(self, name), (2,)))
        for name in ("slow_pole", "fast_pole"):
            if (getattr(self, name) <= 0).any():
                raise UsageError(f"actuator: {name} = {getattr(self, name).tolist()} rad/s; it must be positive")


@dataclass(frozen=True)
class Unbalance:
    """Mass unbalance of the rotor, felt as a force that turns with the shaft.

    Its acceleration is eccentricity * Omega^2, pointing at shaft angle phi + `phase`. Shared by x and y.

    Parameters
    ----------
    eccentricity : float
        Unbalance over moving mass, m_u e_u / M [m]. The default is a well balanced rotor (about ISO 21940
        grade G 1 at 6000 rpm), which so close to its resonances still orbits by 3 to 4 um.
    phase : float
        Angle of the heavy spot on the shaft [rad].
    """

    eccentricity: float = 1.5e-6
    phase: float = 0.7

    def __post_init__(self) -> None:
        if not (np.isfinite([self.eccentricity, self.phase]).all() and self.eccentricity >= 0):
            raise UsageError(
                f"unbalance: eccentricity = {self.eccentricity} m, phase = {self.phase} rad; "
                "give finite numbers, the eccentricity at least zero"
            )


@dataclass(frozen=True, eq=False)
class Machine:
    """All parts of the virtual test rig at one operating point.

    Parameters
    ----------
    rotor_bearing : RotorBearingTruth
        Rotor and gas bearing.
    actuator : ActuatorTruth
        Piezo pairs.
    unbalance : Unbalance
        Mass unbalance.
    sensors : SensorChain
        Noise, run-out, offsets and encoder.
    clearance : float
        Radial clearance of the bearing [m]; 25 um in the paper, Sec. 2.
    """

    rotor_bearing: RotorBearingTruth
    actuator: ActuatorTruth
    unbalance: Unbalance = field(default_factory=Unbalance)
    sensors: SensorChain = field(default_factory=SensorChain)
    clearance: float = 25e-6

    def __post_init__(self) -> None:
        if not self.clearance > 0:
            raise UsageError(f"machine: clearance = {self.clearance} m; it must be positive")

    @classmethod
    def from_parameters(
        cls,
        key_parameters: Mapping[str, Any],
        actuators: Mapping[str, float],
        unbalance: Unbalance | None = None,
        sensors: SensorChain | None = None,
        clearance: float = 25e-6,
    ) -> Machine:
        """Build a machine from parameters by name, as `gbid.LPVModel` and `gbid.FitResult` have them.

        Parameters
        ----------
        key_parameters : dict of str to float
            ``k_xx`` to ``b_yy`` per kg, ``tau_x`` and ``tau_y`` [s]; others are left aside.
        actuators : dict of str to float
            ``p1_x``, ``p2_x``, ``kappa_x`` and those of y [rad/s, rad/s, m/m]; others are left aside.
        unbalance, sensors, clearance
            As for `Machine`; the usual ones when not given.

        Returns
        -------
        Machine

        Raises
        ------
        UsageError
            When a parameter is missing, or a part of the machine refuses its value.
        """
        bearing = _by_name("rotor bearing", key_parameters, _BEARING)
        piezo = _by_name("actuator", actuators, _ACTUATORS)
        K, D, B = (np.reshape([bearing[f"{letter}_{pair}"] for pair in _PAIRS], (2, 2)) for letter in "kdb")
        return cls(
            RotorBearingTruth(K, D, B, np.array([bearing["tau_x"], bearing["tau_y"]])),
            ActuatorTruth(*(np.array([piezo[f"{name}_x"], piezo[f"{name}_y"]]) for name in _ACTUATOR)),
            Unbalance() if unbalance is None else unbalance,
            SensorChain() if sensors is None else sensors,
            clearance,
        )


_PAIRS = ("xx", "xy", "yx", "yy")
_BEARING = (*(f"{letter}_{pair}" for letter in "kdb" for pair in _PAIRS), "tau_x", "tau_y")
_ACTUATOR = ("p1", "p2", "kappa")
_ACTUATORS = tuple(f"{name}_{axis}" for name in _ACTUATOR for axis in "xy")


def _by_name(owner: str, given: Mapping[str, Any], names: tuple[str, ...]) -> dict[str, float]:
    missing = [name for name in names if name not in given]
    if missing:
        raise UsageError(f"{owner}: no value for {', '.join(missing)}")
    return {name: float(np.asarray(given[name])) for name in names}
