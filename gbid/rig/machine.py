"""Machine of the virtual rig: true parameters, effects beyond Eq. 5, and scatter between recordings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from math import sqrt
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt
from annotated_types import Ge, Le

from gbid.core.arrays import FloatArray, frequencies_and_dampings
from gbid.core.brief import Brief
from gbid.core.errors import UsageError
from gbid.core.option_types import Finite, NotNegative, Positive, check_options
from gbid.rig.film import FilmPoint
from gbid.rig.piezo import PiezoStacks
from gbid.rig.sensors import SensorChain


@dataclass(frozen=True)
class FlexibleMode:
    r"""Bending mode of the shaft, which the model of Eq. 5 does not have; equal in x and y.

    .. math:: \ddot \eta + 2 \zeta \omega \dot\eta + \omega^2 \eta = m\, a, \qquad p = q + \eta

    Here a is the sum of all forces per moving mass (film, unbalance, impacts). Below omega the mode only adds
    compliance.

    Parameters
    ----------
    frequency_hz : float
        Natural frequency [Hz].
    damping : float
        Damping ratio zeta.
    share : float
        Modal participation m: acceleration of the disc by this mode over that by the mode of the model.
    """

    frequency_hz: Positive = 480.0
    damping: Positive = 0.01
    share: NotNegative = 0.3

    def __post_init__(self) -> None:
        check_options(self, "flexible mode")


@dataclass(frozen=True)
class FilmStiffening:
    """Gas film whose stiffness grows with the distance from the centre: ``K (1 + |q|^2/l^2)`` in place of ``K``.

    The stiffening is given by the deviation that a staircase shows (Sec. 3.1). Where a linear film would let the disc
    rest at `at_m`, the disc rests short of it by `deviation_m`. The best straight line through a staircase has smaller
    errors. The static error in the paper is below 0.95 um.

    Parameters
    ----------
    deviation_m, at_m : float
        Deviation from the linear position, and the linear position itself [m].

    Raises
    ------
    UsageError
        When the deviation is not below `at_m`.
    """

    deviation_m: NotNegative = 0.9e-6
    at_m: Positive = 8e-6

    def __post_init__(self) -> None:
        check_options(self, "stiffening")
        if self.deviation_m >= self.at_m:
            raise UsageError(f"stiffening: deviation_m = {self.deviation_m}; it must lie below at_m = {self.at_m}")

    @property
    def inverse_square_length(self) -> float:
        """Coefficient 1/l^2 [1/m^2] by which the stiffness of the film grows with the squared displacement."""
        return self.deviation_m / (self.at_m - self.deviation_m) ** 3


@dataclass(frozen=True)
class NonSynchronous:
    r"""Non-synchronous whirl: small slow deviations of the orbit near 4000 rpm (Sec. 4).

    A force per mass -K w(t) acts on the rotor. It would move the disc quasi-statically by

    .. math:: w = s(n)\, \mathrm{Re}/\mathrm{Im}\left(z(t) e^{i \rho \phi}\right), \quad
              s(n) = \text{size} \cdot e^{-(n - n_0)^2 / (2 \Delta n^2)}

    Here z is a complex first-order random process of unit variance and the given bandwidth.

    Parameters
    ----------
    size_m : float
        Largest rms value of ``|w|`` over the speed [m].
    peak_rpm, width_rpm : float
        n_0 and Delta n, centre and width of the speed range [rpm].
    ratio : float
        rho, whirl frequency over shaft frequency.
    bandwidth_hz : float
        Corner frequency of z [Hz].
    """

    size_m: NotNegative = 0.3e-6
    peak_rpm: NotNegative = 4000.0
    width_rpm: Positive = 500.0
    ratio: NotNegative = 0.95
    bandwidth_hz: Positive = 1.0

    def __post_init__(self) -> None:
        check_options(self, "non-synchronous")

    def size_at(self, speed: FloatArray) -> FloatArray:
        """Return the size s of the whirl at given speeds [rad/s], shape of `speed` [m]."""
        rpm = np.abs(speed) * (30.0 / np.pi)
        return np.asarray(self.size_m * np.exp(-0.5 * ((rpm - self.peak_rpm) / self.width_rpm) ** 2))


@dataclass(frozen=True)
class ProcessNoise:
    """Broadband force noise on the rotor, white up to about the sampling frequency, independent in x and y.

    Parameters
    ----------
    density : float
        Square root of the one-sided power density of the acceleration [m/s^2 per sqrt(Hz)].
    """

    density: NotNegative = 0.01

    def __post_init__(self) -> None:
        check_options(self, "process noise")


@dataclass(frozen=True)
class Contact:
    """Contact of disc and bearing beyond the clearance: a stiff wall without friction.

    Parameters
    ----------
    stiffness : float
        Contact force per depth [N/m].
    damping : float
        Contact force per speed into the wall [N s/m]. The wall never pulls.
    """

    stiffness: Positive = 1e8
    damping: NotNegative = 5e3

    def __post_init__(self) -> None:
        check_options(self, "contact")


@dataclass(frozen=True, eq=False)
class RigRun(Brief):
    """Times, shaft angle, speed and operating point of a run, at n + 1 samples from the start of the settling time.

    Attributes
    ----------
    time : (n + 1,) array
        Time from the start of the logger [s]; negative while the rig settles.
    angle, speed : (n + 1,) array
        Angle of the shaft [rad] and its speed [rad/s].
    conditions : dict of str to float
        The operating point.
    random : numpy.random.Generator
        Random numbers of this effect in this recording.
    """

    time: FloatArray
    angle: FloatArray
    speed: FloatArray
    conditions: Mapping[str, float]
    random: np.random.Generator


@dataclass(frozen=True)
class RigEffect:
    """Base of the effects in ``gbid/rig/effects.py``; a subclass overrides one or several of its methods.

    Attributes
    ----------
    name : str
        Name in the YAML, under ``rig: effects:``.
    """

    name: str = field(default="", init=False)

    def __post_init__(self) -> None:
        check_options(self, self.name)

    def force(self, run: RigRun) -> FloatArray | None:  # noqa: ARG002  # for subclasses
        """Return an additional force per moving mass at the samples of `run`, (n + 1, 2) [m/s^2]."""
        return None

    def reading(self, run: RigRun) -> FloatArray | None:  # noqa: ARG002
        """Return the error of the readings of p at the samples of `run`, (n + 1, 2) [m].

        A controller sees it, too.
        """
        return None


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

    @classmethod
    @lru_cache(maxsize=64)
    def of_film(cls, point: FilmPoint) -> RotorBearingTruth:
        """Return the rotor and bearing with the response of a gas film at the mean frequency of the rotor's two modes.

        Parameters
        ----------
        point : FilmPoint
            Film, operating point and rotor.
        """
        return cls(*point.at_frequency(float(point.modes()[:, 0].mean())))

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

    The acceleration is eccentricity * Omega^2 and points at the shaft angle phi + `phase_rad`. It acts on x and y.

    Parameters
    ----------
    eccentricity_m : float
        Unbalance over moving mass, m_u e_u / M [m]. The default is a well balanced rotor (about ISO 21940
        grade G 1 at 6000 rpm). This close to the resonances its orbit still has a radius of 3 to 4 um.
    phase_rad : float
        Angle of the unbalance on the shaft [rad].
    """

    eccentricity_m: NotNegative = 1.5e-6
    phase_rad: Finite = 0.7

    def __post_init__(self) -> None:
        check_options(self, "unbalance")


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
    film : FilmPoint, optional
        Gas film that carries the rotor in place of `rotor_bearing`, which then only gives the orbit at the start; see
        `RotorBearingTruth.of_film`.

    Raises
    ------
    UsageError
        When a value is not allowed, or when there is a film and an effect that belongs to the linear bearing.
    """

    rotor_bearing: RotorBearingTruth
    actuator: ActuatorTruth | PiezoStacks
    unbalance: Unbalance = field(default_factory=Unbalance)
    sensors: SensorChain = field(default_factory=SensorChain)
    clearance: Positive = 25e-6
    moving_mass: Positive = 2.18
    flexible_mode: FlexibleMode | None = None
    stiffening: FilmStiffening | None = None
    non_synchronous: NonSynchronous | None = None
    process_noise: ProcessNoise | None = None
    contact: Contact = field(default_factory=Contact)
    effects: tuple[RigEffect, ...] = ()
    film: FilmPoint | None = None

    def __post_init__(self) -> None:
        linear = [name for name in ("stiffening", "non_synchronous", "flexible_mode") if getattr(self, name)]
        if self.film is not None and linear:
            names = ", ".join(linear)
            raise UsageError(f"machine: {names} with a gas film; these are effects of the linear bearing")
        check_options(self, "machine")

    @property
    def travel(self) -> float:
        """Largest ``|r|`` that a controller may command [m]; half of 45 um for linear actuators."""
        return self.actuator.travel if isinstance(self.actuator, PiezoStacks) else 22.5e-6

    def check_stable(self) -> None:
        """Check that the rotor is stable without control.

        Raises
        ------
        UsageError
            When it is not.
        """
        if self.film is None:
            self.rotor_bearing.check_stable()
        else:
            self.film.check_stable()

    def beyond_closed_form(self) -> list[str]:
        """Return the names of the parts without closed-form solution, which need time stepping."""
        parts = {
            "gas film": self.film is not None,
            "piezo stacks": isinstance(self.actuator, PiezoStacks),
            "flexible mode": self.flexible_mode is not None,
            "stiffening": self.stiffening is not None,
            "non-synchronous motion": self.non_synchronous is not None,
            "process noise": self.process_noise is not None,
        }
        forces = [effect.name for effect in self.effects if type(effect).force is not RigEffect.force]
        return [*(name for name, present in parts.items() if present), *forces]

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
            Arguments of `Machine`; the defaults of `Machine` when not given. With a `film` the key parameters do not
            count.

        Returns
        -------
        Machine

        Raises
        ------
        UsageError
            When a parameter is missing or has a wrong value.
        """
        film = parts.get("film")
        return cls(
            RotorBearingTruth.from_parameters(key_parameters) if film is None else RotorBearingTruth.of_film(film),
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


# ---- Scatter of the true parameters from recording to recording (paper, Secs. 3.7 and 4).

_TRIES = 200


@dataclass(frozen=True)
class Scatter:
    r"""Random differences of rotor and bearing between recordings, and between operating points.

    The paper gives the scatter of its estimates for delays, natural frequencies, damping factors and static gains.
    These quantities are drawn from independent normal distributions. The fourteen key parameters follow from them: the
    eigenvectors of the rotor are kept and its eigenvalues are moved,
    :math:`[K\ D] = \Psi \Lambda^2 [\Psi; \Psi\Lambda]^{-1}`, and :math:`B = -K G_{dc}`.

    A draw is rejected and repeated when a mode has less damping than `minimum_damping` (or than half of its true
    damping, if that is less), or when a delay is below `minimum_delay_s` (same rule). So no draw is unstable. At points
    with little damping this puts the mean slightly above the truth.

    Parameters
    ----------
    share : float, optional
        Factor on all standard deviations; by default one half, or 1 with `within`. The figures of the paper are
        deviations of estimates from a polynomial and contain its lack of fit.
    within : float, optional
        Share of the variance that differs between the recordings at an operating point. The rest is drawn once for
        each operating point: what a polynomial such as Eq. 16 misses there. Without it there is no such draw.
    delay_s : (2,) tuple
        Standard deviations of tau_x, tau_y [s]; 0.088 and 0.041 ms, Sec. 4.
    frequency_hz : (2,) tuple
        Standard deviations of omega_1, omega_2 [Hz]; 1.13 and 0.58, Sec. 4.
    damping : (2,) tuple
        Standard deviations of zeta_1, zeta_2; 0.0104 and 0.0063, Sec. 4.
    static_gain : (4,) tuple
        Standard deviations of g_xx, g_xy, g_yx, g_yy [m/m]; Sec. 4.
    minimum_damping : float
        Smallest damping factor of a draw.
    minimum_delay_s : float
        Smallest delay of a draw [s].
    """

    share: NotNegative | None = None
    within: Annotated[float, Ge(0), Le(1)] | None = None
    delay_s: tuple[NotNegative, NotNegative] = (0.088e-3, 0.041e-3)
    frequency_hz: tuple[NotNegative, NotNegative] = (1.13, 0.58)
    damping: tuple[NotNegative, NotNegative] = (0.0104, 0.0063)
    static_gain: tuple[NotNegative, NotNegative, NotNegative, NotNegative] = (
        *(0.0031, 0.0022),
        *(0.0027, 0.0031),
    )
    minimum_damping: NotNegative = 0.01
    minimum_delay_s: NotNegative = 20e-6

    def __post_init__(self) -> None:
        check_options(self, "scatter")

    @property
    def sizes(self) -> tuple[float, float]:
        """Factors on the standard deviations between operating points, and between recordings at one."""
        if self.within is None:
            return 0.0, 0.5 if self.share is None else self.share
        share = 1.0 if self.share is None else self.share
        return share * sqrt(1.0 - self.within), share * sqrt(self.within)


def scatter_random(seed: int, name: str, conditions: Mapping[str, float]) -> np.random.Generator:
    """Return the random generator of a recording, which depends on seed, name and operating point.

    Parameters
    ----------
    seed : int
        Seed of the recording.
    name : str
        Name of the recording.
    conditions : dict of str to float
        Operating point of the recording.
    """
    point = ",".join(f"{key}={float(conditions[key])!r}" for key in sorted(conditions))
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=tuple(f"scatter {name} {point}".encode())))


def scattered_bearing(
    truth: RotorBearingTruth, scatter: Scatter, seed: int, name: str, conditions: Mapping[str, float]
) -> tuple[RotorBearingTruth, int]:
    """Return the random rotor and bearing of a recording, and the number of rejected draws; see `scattered`.

    The draw of the operating point comes first; that of the recording is about it.

    Parameters
    ----------
    truth : RotorBearingTruth
        The machine without scatter.
    scatter : Scatter
        Standard deviations and limits.
    seed, name, conditions
        As for `scatter_random`.
    """
    at_point, _ = scatter.sizes
    middle, before = truth, 0
    if at_point:
        middle, before = scattered(truth, scatter, scatter_random(seed, "", conditions), at_point)
    drawn, rejected = scattered(middle, scatter, scatter_random(seed, name, conditions))
    return drawn, before + rejected


def scattered(
    truth: RotorBearingTruth, scatter: Scatter, random: np.random.Generator, size: float | None = None
) -> tuple[RotorBearingTruth, int]:
    """Return a random rotor and bearing.

    Parameters
    ----------
    truth : RotorBearingTruth
        The machine without scatter.
    scatter : Scatter
        Standard deviations and limits.
    random : numpy.random.Generator
        Source of random numbers; see `scatter_random`.
    size : float, optional
        Factor on the standard deviations; by default that of recordings at one operating point.

    Returns
    -------
    RotorBearingTruth
        Stable rotor and bearing.
    int
        Number of rejected draws.

    Raises
    ------
    UsageError
        When a mode does not oscillate, or when all draws are rejected.
    """
    frequency, damping, shapes = _modes(truth)
    gain = -np.linalg.solve(truth.stiffness, truth.input_gain)
    floor = np.minimum(scatter.minimum_damping, 0.5 * damping)
    floor_delay = np.minimum(scatter.minimum_delay_s, 0.5 * truth.delay)
    size = scatter.sizes[1] if size is None else size
    for thrown in range(_TRIES):
        z = size * random.standard_normal(10)
        new_frequency = frequency + z[:2] * scatter.frequency_hz
        new_damping = damping + z[2:4] * scatter.damping
        delay = truth.delay + z[4:6] * scatter.delay_s
        if (new_damping < floor).any() or (new_damping >= 1).any() or (new_frequency <= 0).any():
            continue
        if (delay < floor_delay).any():
            continue
        omega = 2 * np.pi * new_frequency
        half = omega * (-new_damping + 1j * np.sqrt(1 - new_damping**2))
        values = np.concatenate([half, half.conj()])
        KD = (shapes * values**2) @ np.linalg.inv(np.vstack([shapes, shapes * values]))
        K, D = KD.real[:, :2], KD.real[:, 2:]
        G = gain + np.reshape(z[6:] * scatter.static_gain, (2, 2))
        return replace(truth, stiffness=K, damping=D, input_gain=-K @ G, delay=delay), thrown
    raise UsageError(f"scatter: no acceptable draw in {_TRIES}; lower share = {size:g}")


def _modes(truth: RotorBearingTruth) -> tuple[FloatArray, FloatArray, np.ndarray]:
    """Return natural frequencies [Hz], damping factors and mode shapes (2, 4) of both modes, lower frequency first."""
    values, vectors = np.linalg.eig(np.block([[np.zeros((2, 2)), np.eye(2)], [truth.stiffness, truth.damping]]))
    upper = np.flatnonzero(values.imag > 0)
    if len(upper) != 2:
        raise UsageError("scatter: the rotor has a mode that does not oscillate; it cannot be scattered by frequency")
    upper = upper[np.argsort(np.abs(values[upper]))]
    half, shapes = values[upper], vectors[:2, upper]
    return *frequencies_and_dampings(half).T, np.hstack([shapes, shapes.conj()])
