"""Machine of the virtual rig, given by its true parameters."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from gbid.arrays import FloatArray
from gbid.brief import Brief
from gbid.errors import UsageError
from gbid.rig.machine.piezo import PiezoStacks
from gbid.rig.machine.rig_effect import RigEffect
from gbid.rig.machine.rotor_effects import Contact, FilmStiffening, FlexibleMode, NonSynchronous, ProcessNoise
from gbid.rig.machine.sensors import SensorChain


def fixed_array(owner: str, name: str, values: npt.ArrayLike, shape: tuple[int, ...]) -> FloatArray:
    """Return a read-only float array of a given shape.

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
class RotorBearingTruth(Brief):
    r"""True parameters of rotor and gas bearing at one operating point (paper, Eqs. 5 to 8), with exact delays.

    .. math:: \ddot p = K p + D \dot p + B u_\tau, \quad u_\tau = [u_x(t - \tau_x), u_y(t - \tau_y)]

    All are per kg of moving mass, with the sign of the paper: stiffness and damping have negative diagonals.

    Parameters
    ----------
    stiffness : (2, 2) array
        K [N/(kg m)].
    damping : (2, 2) array
        D [N s/(kg m)].
    input_gain : (2, 2) array
        B [N/(kg m)].
    delay : (2,) array
        tau [s], at least zero. It need not be a multiple of the sample time.

    Raises
    ------
    UsageError
        When shapes are wrong, values are not finite, or a delay is negative.
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

    @classmethod
    def from_parameters(cls, key_parameters: Mapping[str, Any]) -> RotorBearingTruth:
        """Return the rotor and bearing with parameters given by name.

        Parameters
        ----------
        key_parameters : dict of str to float
            ``k_xx`` to ``b_yy`` per kg, and ``tau_x``, ``tau_y`` [s], in SI units. Other entries are ignored.

        Raises
        ------
        UsageError
            When a parameter is missing.
        """
        named = _by_name("rotor bearing", key_parameters, _BEARING)
        K, D, B = (np.reshape([named[f"{letter}_{pair}"] for pair in _PAIRS], (2, 2)) for letter in "kdb")
        return cls(K, D, B, np.array([named["tau_x"], named["tau_y"]]))

    def key_parameters(self) -> dict[str, float]:
        """Return the fourteen key parameters by name, ``k_xx`` to ``tau_y``, SI per kg."""
        matrices = zip("kdb", (self.stiffness, self.damping, self.input_gain), strict=True)
        named = {f"{a}_{pair}": float(v) for a, m in matrices for pair, v in zip(_PAIRS, m.ravel(), strict=True)}
        return {**named, "tau_x": float(self.delay[0]), "tau_y": float(self.delay[1])}

    def check_stable(self) -> None:
        """Check that the rotor is stable without control.

        Raises
        ------
        UsageError
            When an eigenvalue of [0 I; K D] has no negative real part.
        """
        matrix = np.block([[np.zeros((2, 2)), np.eye(2)], [self.stiffness, self.damping]])
        worst = max(np.linalg.eigvals(matrix), key=lambda s: float(s.real))
        if worst.real >= 0:
            raise UsageError(
                f"rotor bearing: unstable, eigenvalue {worst:.4g} 1/s; without a controller "
                "the rig simulates stable points only"
            )


@dataclass(frozen=True, eq=False)
class ActuatorTruth(Brief):
    r"""True parameters of the controlled piezo pairs, from reference r to position difference u (paper, Eq. 12).

    .. math:: G_{a,j}(s) = \frac{\kappa_j}{(s/p_{1,j} + 1)(s/p_{2,j} + 1)}

    There is one pair per axis j.

    Parameters
    ----------
    slow_pole, fast_pole : (2,) array
        p_1 and p_2 of x and y [rad/s], positive.
    gain : (2,) array
        kappa of x and y [m/m].

    Raises
    ------
    UsageError
        When shapes are wrong, values are not finite, or a pole is not positive.
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
    """Mass unbalance of the rotor: a force that rotates with the shaft.

    Its acceleration is eccentricity * Omega^2 and points at the shaft angle phi + `phase`. It acts on x and y.

    Parameters
    ----------
    eccentricity : float
        Unbalance over moving mass, m_u e_u / M [m]. The default is a well balanced rotor (about ISO 21940
        grade G 1 at 6000 rpm). This close to the resonances its orbit still has a radius of 3 to 4 um.
    phase : float
        Angle of the unbalance on the shaft [rad].
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
class Machine(Brief):
    """Machine of the virtual test rig at one operating point.

    Parameters
    ----------
    rotor_bearing : RotorBearingTruth
        Rotor and gas bearing.
    actuator : ActuatorTruth or PiezoStacks
        Piezo pairs, either as linear filters (Table 2) or as four nonlinear stacks.
    unbalance : Unbalance
        Mass unbalance.
    sensors : SensorChain
        Noise, run-out, offsets and encoder.
    clearance : float
        Radial clearance of the bearing [m]; 25 um in the paper, Sec. 2.
    moving_mass : float
        Mass that an impact accelerates [kg]. The disc and the shaft of Table 1 rotate about the ball bearing at the
        other end of the shaft, which makes 1.5 kg + 2.04 kg/3 at the disc.
    flexible_mode, stiffening, non_synchronous, process_noise : optional
        Effects of a real rotor beyond Eq. 5; none by default.
    contact : Contact
        Contact of disc and bearing at the end of the clearance.
    effects : tuple of RigEffect
        Further effects, made by `gbid.rig.rig_effect`.
    """

    rotor_bearing: RotorBearingTruth
    actuator: ActuatorTruth | PiezoStacks
    unbalance: Unbalance = field(default_factory=Unbalance)
    sensors: SensorChain = field(default_factory=SensorChain)
    clearance: float = 25e-6
    moving_mass: float = 2.18
    flexible_mode: FlexibleMode | None = None
    stiffening: FilmStiffening | None = None
    non_synchronous: NonSynchronous | None = None
    process_noise: ProcessNoise | None = None
    contact: Contact = field(default_factory=Contact)
    effects: tuple[RigEffect, ...] = ()

    def __post_init__(self) -> None:
        for name, unit in (("clearance", "m"), ("moving_mass", "kg")):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0):
                raise UsageError(f"machine: {name} = {value} {unit}; it must be positive")

    @property
    def travel(self) -> float:
        """Largest ``|r|`` that a controller may command [m]; half of 45 um for linear actuators."""
        return self.actuator.travel if isinstance(self.actuator, PiezoStacks) else 22.5e-6

    def beyond_closed_form(self) -> list[str]:
        """Return the names of the parts that have no solution in closed form and need time stepping."""
        parts = {
            "piezo stacks": isinstance(self.actuator, PiezoStacks),
            "flexible mode": self.flexible_mode is not None,
            "stiffening": self.stiffening is not None,
            "non-synchronous motion": self.non_synchronous is not None,
            "process noise": self.process_noise is not None,
        }
        forces = [effect.name for effect in self.effects if type(effect).force is not RigEffect.force]
        return [*(name for name, there in parts.items() if there), *forces]

    @classmethod
    def from_parameters(
        cls,
        key_parameters: Mapping[str, Any],
        actuators: Mapping[str, float] | PiezoStacks,
        unbalance: Unbalance | None = None,
        sensors: SensorChain | None = None,
        clearance: float = 25e-6,
        **parts: Any,
    ) -> Machine:
        """Return a machine with parameters given by name, as in `gbid.LPVModel` and `gbid.FitResult`.

        Parameters
        ----------
        key_parameters : dict of str to float
            ``k_xx`` to ``b_yy`` per kg, ``tau_x`` and ``tau_y`` [s]. Other entries are ignored.
        actuators : dict of str to float, or PiezoStacks
            ``p1_x``, ``p2_x`` [rad/s], ``kappa_x`` [m/m] and the same of y; other entries are ignored. Or the four
            stacks.
        unbalance, sensors, clearance, **parts
            Arguments of `Machine`; the defaults of `Machine` when not given.

        Returns
        -------
        Machine

        Raises
        ------
        UsageError
            When a parameter is missing or has a wrong value.
        """
        return cls(
            RotorBearingTruth.from_parameters(key_parameters),
            actuators if isinstance(actuators, PiezoStacks) else _linear_actuator(actuators),
            Unbalance() if unbalance is None else unbalance,
            SensorChain() if sensors is None else sensors,
            clearance,
            **parts,
        )


_PAIRS = ("xx", "xy", "yx", "yy")
_BEARING = (*(f"{letter}_{pair}" for letter in "kdb" for pair in _PAIRS), "tau_x", "tau_y")
_ACTUATOR = ("p1", "p2", "kappa")
_ACTUATORS = tuple(f"{name}_{axis}" for name in _ACTUATOR for axis in "xy")


def _linear_actuator(actuators: Mapping[str, float]) -> ActuatorTruth:
    piezo = _by_name("actuator", actuators, _ACTUATORS)
    return ActuatorTruth(*(np.array([piezo[f"{name}_x"], piezo[f"{name}_y"]]) for name in _ACTUATOR))


def _by_name(owner: str, given: Mapping[str, Any], names: tuple[str, ...]) -> dict[str, float]:
    missing = [name for name in names if name not in given]
    if missing:
        raise UsageError(f"{owner}: no value for {', '.join(missing)}")
    return {name: float(np.asarray(given[name])) for name in names}
