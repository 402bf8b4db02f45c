"""Built-in controller structures: P, PD, PI, PID, notch, PPF, lead-lag, biquad, filter, observer, resonant, coupled.

A subclass of `PerAxis` in this file is a built-in structure. The default of its field `name` is its name in Python,
YAML, controller files and messages. Nothing else has to know it.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cache, cached_property
from types import MappingProxyType
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, Self

import casadi as ca
import numpy as np
import scipy
from annotated_types import Ge, Le

from gbid.core.arrays import is_finite
from gbid.core.errors import UsageError
from gbid.core.option_types import Allowed, CountOrZero, Exact, Finite, Positive, check_options
from gbid.discretise import Hold
from gbid.structure import LinearModel, LinearStructure, Parameter
from gbid.structure.delay import with_pade
from gbid.structure.parameter import Values

System = tuple[Any, Any, Any, Any]
"""A, B, C, D as casadi.SX."""


def lowpass_filter(corner_hz: Any, order: int) -> System:
    """Return the low-pass ``(p_lp / (s + p_lp))^n`` as a chain of first-order lags.

    Parameters
    ----------
    corner_hz : float or casadi.SX
        Corner frequency ``p_lp / 2 pi`` [Hz].
    order : int
        Order n; 0 for none.

    Returns
    -------
    tuple of casadi.SX
        A (n, n), B (n, 1), C (1, n), D (1, 1).
    """
    corner = 2 * np.pi * corner_hz
    # the output of each stage is the input of the next
    chain = ca.sparsify(ca.SX(ca.DM(np.eye(order, k=-1) - np.eye(order))))
    first, last = ca.SX(order, 1), ca.SX(1, order)
    if order:
        first[0], last[order - 1] = corner, 1.0
    return corner * chain, first, last, ca.SX(1, 1) if order else ca.SX(1)


AXES = ("x", "y")
INPUTS = ("p_x", "p_y")
OUTPUTS = ("r_x", "r_y")
NOT_OPTIONS = ("name", "inputs", "outputs", "intersample", "speed_rpm")
"""Fields of a structure that are no options of the user."""

Range = Annotated[tuple[Finite, Finite], Allowed("two numbers, lower first")]
PositiveRange = Annotated[tuple[Positive, Positive], Allowed("two positive numbers, lower first")]
TwoPlaces = Annotated[tuple[Finite, ...], Allowed("two numbers in m")]
AxisNames = Annotated[tuple[str, ...], Allowed("each axis a name of its own")]


class AxisGain(NamedTuple):
    """Gain of one axis: name, start value, bounds, unit, and whether it sets poles of the filter."""

    name: str
    start: float
    lower: float
    upper: float
    unit: str
    of_poles: bool = False


def gain_name(name: str, axis: str) -> str:
    """Return the name of a gain of an axis; an axis without name adds nothing."""
    return f"{name}_{axis}" if axis else name


def inside(value: float, bounds: tuple[float, float]) -> float:
    """Return a value clipped to bounds."""
    return min(max(value, bounds[0]), bounds[1])


def gain_within(name: str, start: float, bounds: tuple[float, float], unit: str, of_poles: bool = False) -> AxisGain:
    """Return a gain whose start value is clipped to its bounds."""
    return AxisGain(name, inside(start, bounds), *bounds, unit, of_poles)


def symmetric_gain(name: str, limit: float, unit: str = "m/m", start: float = 0.0) -> AxisGain:
    """Return a gain with the bounds ``-limit`` and ``limit``."""
    return gain_within(name, start, (-limit, limit), unit)


def pole_gains(frequency_khz: tuple[float, float], damping: tuple[float, float]) -> tuple[AxisGain, AxisGain]:
    """Return the two gains of a pair of poles: frequency [kHz] and damping factor, clipped to their bounds."""
    return (
        gain_within("frequency", 0.15, frequency_khz, "kHz", of_poles=True),
        gain_within("damping", 0.7, damping, "", of_poles=True),
    )


@dataclass(frozen=True)
class PerAxis(ABC):
    """Base class of the built-in structures: one filter per axis in series with a low-pass.

    A structure gives the gains of an axis (`_axis_gains`) and the filter that they make (`_filter`); the rest is here.

    Parameters
    ----------
    lowpass_hz : float
        Corner frequency of the low-pass ``(p_lp / (s + p_lp))^n`` of each axis [Hz].
    order : int
        Order n of the low-pass; 0 for none.
    tune_corner : bool
        Whether the corner frequency is a gain as well, ``lowpass_khz`` [kHz], common to all axes.
    axes : tuple of str
        Names of the axes, which end the names of gains, inputs and outputs. ``("",)`` is a controller of one input and
        one output, whose gains have plain names.
    feedback : {"positive", "negative"}
        Sign with which the output is added to the input of the plant: ``r = K p`` as in the paper, or ``r = -K p``.
    gain_unit : str
        Unit of an output of the controller over that of an input, such as ``"A/m"``.
    gain_sets : tuple of str
        Name of the gains of each axis, which ends them. Axes with the same name have common gains: ``("",) * 4`` is one
        set of gains for four axes. By default each axis has gains of its own.
    sensors_m, actuators_m : tuple of two floats
        Places of the two sensors and of the two actuators of each direction, along the shaft from the centre of mass
        [m]. The axes are then pairs, both planes of one direction and then of the next, ``("x1", "x2", "y1", "y2")``,
        and the filters act on translation and tilt, whose gains are ``kappa_translation_x``, ``kappa_tilt_x``. The
        coordinates are the position of the centre of mass and half the difference of the planes. A symmetric rotor with
        equal gains of both has decentralised control.
    coupling : {"none", "full", "gyroscopic"}
        ``"full"``: the filter of each input drives the outputs of all axes; ``kappa_xy`` goes from p_y to r_x, and
        gains of poles belong to an input, ``frequency_x``. ``"gyroscopic"``: the first half of the axes is one
        direction, the second half the other in the same order. The filter of an axis then drives the same axis of the
        other direction as well, with ``kappa_cross_x`` from y to x and its negative from x to y, so that forward and
        backward whirl have different phases.
    notch_orders : tuple of float
        Multiples of the speed at which each axis has a notch in series with its low-pass, against unbalance. The gains
        of notch k are ``speed_width_k`` and ``speed_depth_k`` (0 blocks the frequency, 1 is no notch). The frequency
        follows the speed, so the structure is scheduled.
    lowest_hz : float
        Frequency of the notch at rest, ``omega_0 / 2 pi``, with ``omega^2 = (order Omega)^2 + omega_0^2`` [Hz].
    """

    lowpass_hz: Positive = 1000.0
    order: CountOrZero = 1
    tune_corner: bool = False
    name: str = ""
    inputs: tuple[str, ...] = INPUTS
    outputs: tuple[str, ...] = OUTPUTS
    intersample: Hold = "foh"
    axes: AxisNames = AXES
    feedback: Literal["positive", "negative"] = "positive"
    gain_unit: str = "m/m"
    gain_sets: tuple[str, ...] = ()
    sensors_m: TwoPlaces = ()
    actuators_m: TwoPlaces = ()
    coupling: Literal["none", "full", "gyroscopic"] = "none"
    notch_orders: tuple[Positive, ...] = ()
    lowest_hz: Positive = 20.0
    speed_rpm: Any = 0.0
    is_value: ClassVar[bool] = True
    has_common_poles: ClassVar[bool] = True
    """Whether its poles depend on gains of poles alone, so that all filters of an input can share them."""

    def __post_init__(self) -> None:
        where = f"controller {self.name!r}"
        check_options(self, where)
        for name in (
            each.name for each in fields(self) if isinstance(each.default, tuple) and is_finite((*each.default, "")[0])
        ):
            lower, upper = getattr(self, name)
            if not lower < upper:
                raise UsageError(f"{where}: {name} = ({lower:g}, {upper:g}); give two numbers, lower first", name)
            object.__setattr__(self, name, (float(lower), float(upper)))
        if not self.axes or len(set(self.axes)) < len(self.axes):
            raise UsageError(f"{where}: axes = {self.axes!r}; give each axis a different name", "axes")
        object.__setattr__(self, "axes", tuple(self.axes))
        if self.axes != AXES:
            object.__setattr__(self, "inputs", tuple(gain_name("p", axis) for axis in self.axes))
            object.__setattr__(self, "outputs", tuple(gain_name("r", axis) for axis in self.axes))
        self._check_coupling(where)
        if self.tune_corner and self.order == 0:
            raise UsageError(f"{where}: tune_corner needs a low-pass; give an order of at least 1", "tune_corner")
        if self.tune_corner and not 0.05 <= self.lowpass_hz / 1e3 <= 2.5:
            raise UsageError(
                f"{where}: lowpass_hz = {self.lowpass_hz:g}; to be tuned it must start in 50 to 2500", "lowpass_hz"
            )

    @abstractmethod
    def _axis_gains(self) -> tuple[AxisGain, ...]:
        """Return the gains of the filter of one axis."""

    @abstractmethod
    def _filter(self, gain: Mapping[str, Any], lowpass: System) -> System:
        """Return A, B, C, D of one axis for its gains and its low-pass."""

    def _check_coupling(self, where: str) -> None:
        """Refuse sensor and actuator positions, gain sets and couplings that do not fit the axes."""
        n = len(self.axes)
        places = self.sensors_m, self.actuators_m
        if any(places) and (n % 2 or any(len(pair) != 2 or pair[0] == pair[1] for pair in places)):
            raise UsageError(
                f"{where}: sensors_m = {places[0]}, actuators_m = {places[1]} for {n} axes; give two different places "
                "each, and axes in pairs such as ('x1', 'x2', 'y1', 'y2')",
                "sensors_m",
            )
        if self.gain_sets and (len(self.gain_sets) != n or self.coupling == "full"):
            raise UsageError(
                f"{where}: gain_sets = {self.gain_sets} for {n} axes with coupling {self.coupling!r}; give a name for "
                "each axis, without full coupling",
                "gain_sets",
            )
        if self.coupling != "none" and not self.has_common_poles:
            raise UsageError(
                f"{where}: coupling is not possible for this structure, because each of its gains changes its poles",
                "coupling",
            )
        if self.coupling == "gyroscopic" and n % 2:
            raise UsageError(f"{where}: gyroscopic coupling of {n} axes; give as many in each direction", "coupling")

    @property
    def follows_speed(self) -> bool:
        """Whether the matrices depend on the speed, so that the structure needs a schedule."""
        return bool(self.notch_orders)

    def at_speed(self, speed_rpm: Any) -> Self:
        """Return the structure at a speed [rpm], which may be a number or a symbol."""
        return replace(self, speed_rpm=speed_rpm)

    def _khz_at(self, order: float) -> Any:
        """Frequency at a multiple of the speed [kHz]."""
        return ca.sqrt((order * self.speed_rpm / 60) ** 2 + self.lowest_hz**2) / 1e3

    @property
    def _sets(self) -> tuple[str, ...]:
        """Name of the gain set of each filter: the axis, or translation and tilt of a direction."""
        if self.gain_sets or not self.sensors_m:
            return self.gain_sets or self.axes
        pairs = zip(self.axes[::2], self.axes[1::2], strict=True)
        directions = ["".join(letter for letter in one if letter in two) for one, two in pairs]
        if len(set(directions)) < len(directions):
            directions = [str(i + 1) for i in range(len(directions))]
        return tuple(gain_name(way, direction) for direction in directions for way in ("translation", "tilt"))

    @property
    def _entries(self) -> list[tuple[int, int, int]]:
        """Row, column and sign of each filter in the controller matrix."""
        n = len(self.axes)
        if self.coupling == "full":
            return [(to, of, 1) for to in range(n) for of in range(n)]
        direct, half = [(i, i, 1) for i in range(n)], n // 2
        cross = [(i, i + half, 1) for i in range(half)] + [(i + half, i, -1) for i in range(half)]
        return direct + (cross if self.coupling == "gyroscopic" else [])

    def _gain_name(self, gain: AxisGain, to: int, of: int) -> str:
        """Name of a gain in the filter from an input to an output."""
        sets = self._sets
        if gain.of_poles or (to == of and self.coupling != "full"):
            return gain_name(gain.name, sets[of])
        if self.coupling == "full":
            return f"{gain.name}_{sets[to]}{sets[of]}"
        return gain_name(f"{gain.name}_cross", sets[min(to, of)])

    def _all_gains(self) -> tuple[AxisGain, ...]:
        """Gains of one axis, with the gains of its notches at multiples of the speed."""
        notches = [
            gain_within(f"speed_{name}_{k}", start, bounds, "", of_poles=True)
            for k in range(1, len(self.notch_orders) + 1)
            for name, start, bounds in (("width", 0.2, (0.01, 2.0)), ("depth", 0.9, (0.0, 2.0)))
        ]
        return (*self._axis_gains(), *notches)

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        """Gains of all axes, sorted by kind; the corner frequency is last when it is tuned."""
        gains: dict[str, Parameter] = {}
        for gain in self._all_gains():
            for to, of, _ in self._entries:
                start, low, high = gain.start, gain.lower, gain.upper
                if to != of and high < 0 and not gain.of_poles:  # across, an integral gain may have either sign
                    start, low, high = 0.0, low, -low
                name = self._gain_name(gain, to, of)
                gains.setdefault(name, Parameter(name, start, low, high, unit=self._unit(gain)))
        if self.tune_corner:
            gains["lowpass_khz"] = Parameter("lowpass_khz", self.lowpass_hz / 1e3, 0.05, 2.5, unit="kHz")
        return tuple(gains.values())

    def _unit(self, gain: AxisGain) -> str:
        """Return the unit of a gain; for integral and derivative gains the proportional gain's unit times 1/s or ms."""
        times = gain.unit in ("ms", "1/s") and self.gain_unit != "m/m"
        return f"{self.gain_unit} {gain.unit}" if times else gain.unit.replace("m/m", self.gain_unit)

    def matrices(self, p: Values) -> dict[str, Any]:
        """Return A, B, C and D for gains by name."""
        corner = p["lowpass_khz"] * 1e3 if self.tune_corner else self.lowpass_hz
        lowpass, gains, columns = lowpass_filter(corner, self.order), self._all_gains(), []
        for of in range(len(self.axes)):
            rows: list[Any] = [None] * len(self.axes)
            for to, _, sign in (entry for entry in self._entries if entry[1] == of):
                gain = {each.name: p[self._gain_name(each, to, of)] for each in gains}
                first = lowpass
                for k, order in enumerate(self.notch_orders, 1):
                    width, depth = gain[f"speed_width_{k}"], gain[f"speed_depth_{k}"]
                    first = in_series(first, second_order((1.0, 2 * depth * width, 1.0), self._khz_at(order), width))
                A, B, C, D = self._filter(gain, first)  # A and B are those of all filters of this input
                rows[to] = sign * C, sign * D
            zero = ca.SX(1, A.shape[0]), ca.SX(1, 1)
            columns.append((A, B, *(ca.vertcat(*part) for part in zip(*(row or zero for row in rows), strict=True))))
        A, B, C, D = zip(*columns, strict=True)
        sense, act = self._geometry()
        sign = 1 if self.feedback == "positive" else -1
        C, D = (sign * act @ ca.horzcat(*part) for part in (C, D))
        return {"A": ca.diagcat(*A), "B": ca.diagcat(*B) @ sense, "C": C, "D": D @ sense}

    def _geometry(self) -> tuple[Any, Any]:
        """Return two matrices: from positions to filter inputs, and from filter outputs to references."""
        if not self.sensors_m:
            return 1, 1
        (s1, s2), (a1, a2) = self.sensors_m, self.actuators_m
        each = np.eye(len(self.axes) // 2)
        sense = np.array([[s2 / (s2 - s1), -s1 / (s2 - s1)], [-0.5, 0.5]])
        # the sum of the forces is twice the first output, their moment the second times the distance of the planes
        act = np.array([[2 * a2 / (a2 - a1), -1.0], [-2 * a1 / (a2 - a1), 1.0]])
        return ca.sparsify(ca.DM(np.kron(each, sense))), ca.sparsify(ca.DM(np.kron(each, act)))


# ---- Sections of filters as symbolic state-space models, and their series connection.


def second_order(b: Sequence[Any], frequency_khz: Any, damping: Any) -> System:
    """Return ``(b2 s^2 + b1 w s + b0 w^2) / (s^2 + 2 damping w s + w^2)``.

    Parameters
    ----------
    b : (b0, b1, b2)
        Gains of the numerator.
    frequency_khz, damping : float or casadi.SX
        ``w / (2 pi 1000)`` [kHz] and damping factor.
    """
    w = 2e3 * np.pi * frequency_khz
    # states w^2/den and w s/den; s^2/den = 1 - 2 damping (second) - (first)
    A = ca.blockcat([[ca.SX(1, 1), ca.SX(w)], [ca.SX(-w), ca.SX(-2 * damping * w)]])
    C = ca.horzcat(ca.SX(b[0] - b[2]), ca.SX(b[1] - 2 * damping * b[2]))
    return A, ca.vertcat(ca.SX(1, 1), ca.SX(w)), C, ca.SX(b[2])


def first_order(low: Any, high: Any, corner_khz: Any) -> System:
    """Return ``(high s + low w) / (s + w)``: the gain `low` at rest and `high` at high frequency.

    Parameters
    ----------
    low, high : float or casadi.SX
        Gains.
    corner_khz : float or casadi.SX
        ``w / (2 pi 1000)`` [kHz].
    """
    w = 2e3 * np.pi * corner_khz
    return ca.SX(-w), ca.SX(w), ca.SX(low - high), ca.SX(high)


def in_series(first: Sequence[Any], second: Sequence[Any]) -> System:
    """Return the series connection of two systems: the output of `first` is the input of `second`."""
    A, B, C, D = first
    a, b, c, d = second
    n, m = A.shape[0], a.shape[0]
    return ca.blockcat([[A, ca.SX(n, m)], [b @ C, a]]), ca.vertcat(B, b @ D), ca.horzcat(d @ C, c), d @ D


def in_parallel(first: Sequence[Any], second: Sequence[Any]) -> System:
    """Return the parallel connection of two systems: one input, summed outputs."""
    A, B, C, D = first
    a, b, c, d = second
    return ca.diagcat(A, a), ca.vertcat(B, b), ca.horzcat(C, c), D + d


# ---- The structures.

FilterOrder = Annotated[int, Exact(), Ge(1), Le(8), Allowed("a whole number, 1 to 8")]


@dataclass(frozen=True)
class Proportional(PerAxis):
    """Base class of the structures with a proportional gain kappa per axis; by itself a proportional controller."""

    lower: Finite = -3.0
    upper: Finite = 3.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.lower < self.upper:
            raise UsageError(
                f"controller {self.name!r}: lower = {self.lower} must be below upper = {self.upper}", "lower"
            )

    def _axis_gains(self) -> tuple[AxisGain, ...]:
        return (gain_within("kappa", 0.0, (self.lower, self.upper), "m/m"),)

    def _filter(self, gain: Mapping[str, Any], lowpass: System) -> System:
        A, B, C, D = lowpass
        return A, B, gain["kappa"] * C, gain["kappa"] * D


@dataclass(frozen=True)
class PStructure(Proportional):
    r"""Decentralised proportional controller with low-pass (paper, Eq. 21).

    .. math:: K_i(s) = \kappa_i \left(\frac{p_{lp}}{s + p_{lp}}\right)^n

    The gains are ``kappa_x``, ``kappa_y`` [m/m].

    Parameters
    ----------
    lowpass_hz : float
        Corner frequency of the low-pass [Hz].
    order : int
        Order n of the low-pass; 0 for none.
    tune_corner : bool
        Whether the corner frequency is a gain as well, ``lowpass_khz`` [kHz].
    lower, upper : float
        Bounds of the gains [m/m].
    axes : tuple of str
        Names of the axes; ``("",)`` for one input and one output with plain names.
    feedback : {"positive", "negative"}
        Sign with which the controller acts on the outputs, for positive gains.
    gain_unit : str
        Unit of the gains; "m/m" for positions that follow positions.
    gain_sets, sensors_m, actuators_m, coupling, notch_orders, lowest_hz, speed_rpm
        See `gbid.control.controllers.built_in.PerAxis`; the schedule sets the speed.
    """

    lower: Finite = 0.0
    name: str = "P"


_KD_LIMIT_MS = 3.0


@dataclass(frozen=True)
class PDStructure(Proportional):
    r"""Decentralised proportional and derivative controller; the low-pass makes it proper.

    .. math:: K_i(s) = (\kappa_i + k_{d,i} s) \left(\frac{p_{lp}}{s + p_{lp}}\right)^n, \quad n \ge 1

    The gains are ``kappa_x``, ``kappa_y`` [m/m], ``kd_x``, ``kd_y`` [ms].

    Parameters
    ----------
    lowpass_hz, order, tune_corner, axes, feedback, gain_unit
        As in `PStructure`; the order is at least 1.
    lower, upper : float
        Bounds of the proportional gains [m/m].
    kd_limit_ms : float, optional
        Bound on the magnitude of the derivative gains [ms]. By default 3 ms, and where `gbid.tune` has a plant that is
        no LPV model, the bound of kappa over the plant's slowest oscillation [rad/s].
    derivative_khz : (lowest, highest), optional
        Bounds of the corner of a filter of the derivative alone, ``kd s / (1 + s / w)``, which is then the gain
        ``corner`` [kHz]. The order of the low-pass may then be 0.
    gain_sets, sensors_m, actuators_m, coupling, notch_orders, lowest_hz, speed_rpm
        See `gbid.control.controllers.built_in.PerAxis`; the schedule sets the speed.
    """

    kd_limit_ms: Positive | None = None
    derivative_khz: PositiveRange | None = None
    name: str = "PD"

    def __post_init__(self) -> None:
        super().__post_init__()
        where = f"controller {self.name!r}"
        if self.derivative_khz is None and self.order == 0:
            raise UsageError(f"{where}: order = 0; at least 1: without a low-pass it is not proper", "order")
        if self.derivative_khz is not None and not self.derivative_khz[0] < self.derivative_khz[1]:
            raise UsageError(f"{where}: derivative_khz = {self.derivative_khz}; lower first", "derivative_khz")

    def _axis_gains(self) -> tuple[AxisGain, ...]:
        corner = () if self.derivative_khz is None else (gain_within("corner", 0.5, self.derivative_khz, "kHz", True),)
        return (*super()._axis_gains(), symmetric_gain("kd", self.kd_limit_ms or _KD_LIMIT_MS, "ms"), *corner)

    def at_rate(self, rate: float) -> Self:
        """Return the structure with a bound of kd that follows from the plant, unless `kd_limit_ms` is given.

        Parameters
        ----------
        rate : float
            Angular frequency [rad/s] at which the derivative may act as strongly as kappa.

        Returns
        -------
        PDStructure
            Structure with this bound.
        """
        return replace(self, kd_limit_ms=self.kd_limit_ms or 1e3 * max(-self.lower, self.upper) / rate)

    def _filter(self, gain: Mapping[str, Any], lowpass: System) -> System:
        if self.derivative_khz is not None:
            straight = super()._filter(gain, lowpass_filter(1.0, 0))
            high = 2 * np.pi * gain["corner"] * gain["kd"]  # kHz times ms
            return in_series(lowpass, in_parallel(straight, first_order(0.0, high, gain["corner"])))
        A, B, C, D = super()._filter(gain, lowpass)
        n, seconds = lowpass[0].shape[0], 1e-3 * gain["kd"]
        # D = 0 of the low-pass: the derivative of its last stage is C (A x + B p)
        rate = ca.horzcat(lowpass[2] @ lowpass[0], ca.SX(1, A.shape[0] - n))
        return A, B, C + seconds * rate, D + seconds * (lowpass[2] @ lowpass[1])


@dataclass(frozen=True)
class PIStructure(Proportional):
    r"""Proportional and integral controller with low-pass.

    .. math:: K_i(s) = \left(\kappa_i + \frac{k_{I,i}}{s}\right) \left(\frac{p_{lp}}{s + p_{lp}}\right)^n

    The gains per axis are ``kappa`` [m/m] and ``ki`` [1/s]. Feedback is positive, so a negative ``ki`` is stable, and
    the disc then returns to its set point under a steady force.

    Parameters
    ----------
    lower, upper : float
        Bounds of kappa [m/m].
    ki : (lowest, highest)
        Bounds of the integral gain [1/s], below zero.
    lowpass_hz, order, tune_corner, axes, feedback, gain_unit
        As in `PStructure`.
    """

    ki: Range = (-1000.0, -1.0)
    name: str = "PI"

    def _axis_gains(self) -> tuple[AxisGain, ...]:
        return (*super()._axis_gains(), gain_within("ki", -20.0, self.ki, "1/s"))

    def _filter(self, gain: Mapping[str, Any], lowpass: System) -> System:
        return in_series(lowpass, (ca.SX(1, 1), ca.SX(1), ca.SX(gain["ki"]), ca.SX(gain["kappa"])))


@dataclass(frozen=True)
class PIDStructure(PDStructure, PIStructure):
    r"""Proportional, integral and derivative controller; the low-pass makes it proper.

    .. math:: K_i(s) = \left(\kappa_i + \frac{k_{I,i}}{s} + k_{d,i} s\right)
                       \left(\frac{p_{lp}}{s + p_{lp}}\right)^n, \quad n \ge 1

    The gains per axis are ``kappa`` [m/m], ``ki`` [1/s] and ``kd`` [ms].

    Parameters
    ----------
    kd_limit_ms
        As in `PDStructure`.
    lower, upper, ki, lowpass_hz, order, tune_corner, axes
        As in `PIStructure`; the order is at least 1.
    """

    name: str = "PID"


@dataclass(frozen=True)
class NotchStructure(Proportional):
    r"""Proportional controller with a notch per axis.

    .. math:: K_i(s) = \kappa_i \frac{s^2 + 2 d_i \zeta_i \omega_i s + \omega_i^2}
                                     {s^2 + 2 \zeta_i \omega_i s + \omega_i^2}
                       \left(\frac{p_{lp}}{s + p_{lp}}\right)^n

    The gains per axis are ``kappa`` [m/m], ``frequency`` [kHz], ``width`` (zeta) and ``depth`` (d, the gain at the
    frequency: 0 blocks it, 1 is no notch, above 1 is a peak).

    Parameters
    ----------
    lower, upper : float
        Bounds of kappa [m/m].
    frequency_khz, width, depth : (lowest, highest)
        Bounds of frequency [kHz], width and depth.
    lowpass_hz, order, tune_corner, axes, feedback, gain_unit
        As in `PStructure`.
    """

    frequency_khz: PositiveRange = (0.02, 1.5)
    width: PositiveRange = (0.05, 3.0)
    depth: PositiveRange = (0.01, 4.0)
    name: str = "notch"

    def _axis_gains(self) -> tuple[AxisGain, ...]:
        return (
            *super()._axis_gains(),
            gain_within("frequency", 0.15, self.frequency_khz, "kHz", of_poles=True),
            gain_within("width", 0.7, self.width, "", of_poles=True),
            gain_within("depth", 0.5, self.depth, ""),
        )

    def _filter(self, gain: Mapping[str, Any], lowpass: System) -> System:
        kappa, zeta = gain["kappa"], gain["width"]
        b = (kappa, 2 * gain["depth"] * zeta * kappa, kappa)
        return in_series(lowpass, second_order(b, gain["frequency"], zeta))


@dataclass(frozen=True)
class PPFStructure(Proportional):
    r"""Positive position feedback: a second-order low-pass per axis (Goh and Caughey 1985).

    .. math:: K_i(s) = \frac{\kappa_i \omega_i^2}{s^2 + 2 \zeta_i \omega_i s + \omega_i^2}

    The gains per axis are ``kappa`` [m/m], ``frequency`` [kHz] and ``damping``. It falls by 40 dB per decade, so that
    modes above its frequency are hardly excited.

    Parameters
    ----------
    lower, upper : float
        Bounds of kappa [m/m].
    frequency_khz, damping : (lowest, highest)
        Bounds of frequency [kHz] and damping factor of the filter.
    lowpass_hz, order, tune_corner, axes, feedback, gain_unit
        As in `PStructure`; by default there is no further low-pass.
    """

    order: CountOrZero = 0
    lower: Finite = 0.0
    frequency_khz: PositiveRange = (0.02, 1.5)
    damping: PositiveRange = (0.05, 3.0)
    name: str = "PPF"

    def _axis_gains(self) -> tuple[AxisGain, ...]:
        return (*super()._axis_gains(), *pole_gains(self.frequency_khz, self.damping))

    def _filter(self, gain: Mapping[str, Any], lowpass: System) -> System:
        return in_series(lowpass, second_order((gain["kappa"], 0.0, 0.0), gain["frequency"], gain["damping"]))


@dataclass(frozen=True)
class LeadLagStructure(PerAxis):
    r"""Lead-lag controller: one first-order section per axis.

    .. math:: K_i(s) = \frac{\kappa_{\infty,i}\, s + \kappa_{0,i}\, \omega_i}{s + \omega_i}
                       \left(\frac{p_{lp}}{s + p_{lp}}\right)^n

    The gains per axis are ``low`` (at rest) and ``high`` (at high frequency) [m/m], and ``corner`` [kHz]. With high
    above low it leads, below low it lags.

    Parameters
    ----------
    gain_limit : float
        Bound on the magnitude of the gains [m/m].
    corner_khz : (lowest, highest)
        Bounds of the corner [kHz].
    lowpass_hz, order, tune_corner, axes, feedback, gain_unit
        As in `PStructure`.
    """

    gain_limit: Positive = 5.0
    corner_khz: PositiveRange = (0.02, 1.5)
    name: str = "lead-lag"

    def _axis_gains(self) -> tuple[AxisGain, ...]:
        low, high = (symmetric_gain(name, self.gain_limit) for name in ("low", "high"))
        return (low, high, gain_within("corner", 0.15, self.corner_khz, "kHz", of_poles=True))

    def _filter(self, gain: Mapping[str, Any], lowpass: System) -> System:
        return in_series(lowpass, first_order(gain["low"], gain["high"], gain["corner"]))


@dataclass(frozen=True)
class BiquadStructure(PerAxis):
    r"""Biquad controller: one second-order filter per axis.

    .. math:: K_i(s) = \frac{b_{2,i} s^2 + b_{1,i} \omega_i s + b_{0,i} \omega_i^2}
                            {s^2 + 2 \zeta_i \omega_i s + \omega_i^2}
                       \left(\frac{p_{lp}}{s + p_{lp}}\right)^n

    The numerator is scaled by the frequency of the filter, so that all gains are of order one: ``b0`` is the static
    gain and ``b2`` the gain at high frequency. The gains per axis are ``b0``, ``b1``, ``b2`` [m/m], ``frequency``
    [kHz] (``omega = 2 pi 1000 frequency``) and ``damping`` [-]. The bounds of the last two keep the filter stable.

    Parameters
    ----------
    lowpass_hz, order, tune_corner, axes, feedback, gain_unit
        As in `PStructure`; by default there is no low-pass.
    gain_limit : float
        Bound on the magnitude of b0, b1 and b2 [m/m].
    frequency_khz, damping : (lowest, highest)
        Bounds of the frequency [kHz] and damping factor of the filter.
    gain_sets, sensors_m, actuators_m, coupling, notch_orders, lowest_hz, speed_rpm
        See `gbid.control.controllers.built_in.PerAxis`; the schedule sets the speed.
    """

    order: CountOrZero = 0
    gain_limit: Positive = 5.0
    frequency_khz: PositiveRange = (0.02, 1.5)
    damping: PositiveRange = (0.05, 3.0)
    name: str = "biquad"

    def _axis_gains(self) -> tuple[AxisGain, ...]:
        numerator = (symmetric_gain(f"b{i}", self.gain_limit) for i in range(3))
        return (*numerator, *pole_gains(self.frequency_khz, self.damping))

    def _filter(self, gain: Mapping[str, Any], lowpass: System) -> System:
        b = [gain[f"b{i}"] for i in range(3)]
        return in_series(lowpass, second_order(b, gain["frequency"], gain["damping"]))


@dataclass(frozen=True)
class FilterStructure(PerAxis):
    r"""Filter of order n per axis, as a product of second-order sections.

    .. math:: K_i(s) = \prod_k \frac{b_{2,k} s^2 + b_{1,k} \omega_k s + b_{0,k} \omega_k^2}
                                    {s^2 + 2 \zeta_k \omega_k s + \omega_k^2}

    Numerators are scaled by the frequency of their section, so that all gains are of order one. ``b0`` of the first
    section is the static gain, that of the others is 1. At the start they are 1 at all frequencies. An odd order adds a
    section ``(c s + omega) / (s + omega)``. The gains of section k end in ``k``: ``b0_1_x``, ``frequency_2_y`` [kHz].

    Parameters
    ----------
    filter_order : int
        Order n per axis, 1 to 8.
    gain_limit : float
        Bound on the magnitude of the numerators' gains [m/m].
    frequency_khz, damping : (lowest, highest)
        Bounds of frequency [kHz] and damping factor of each section, which keep it stable.
    lowpass_hz, order, tune_corner, axes, feedback, gain_unit
        As in `PStructure`; by default there is no low-pass.
    """

    order: CountOrZero = 0
    filter_order: FilterOrder = 4
    gain_limit: Positive = 5.0
    frequency_khz: PositiveRange = (0.02, 1.5)
    damping: PositiveRange = (0.05, 3.0)
    name: str = "filter"

    def _axis_gains(self) -> tuple[AxisGain, ...]:
        limit, gains = self.gain_limit, [symmetric_gain("b0_1", self.gain_limit)]
        for k in range(1, self.filter_order // 2 + 1):
            zeta = inside(0.7, self.damping)
            gains += [
                symmetric_gain(f"b1_{k}", limit, start=0.0 if k == 1 else 2 * zeta),
                symmetric_gain(f"b2_{k}", limit, start=0.0 if k == 1 else 1.0),
                gain_within(f"frequency_{k}", 0.15 * 1.6 ** (k - 1), self.frequency_khz, "kHz", of_poles=True),
                gain_within(f"damping_{k}", zeta, self.damping, "", of_poles=True),
            ]
        if self.filter_order % 2:
            c = AxisGain("c", 0.0 if self.filter_order == 1 else 1.0, -limit, limit, "m/m")
            gains += [c, gain_within("corner", 0.3, self.frequency_khz, "kHz", of_poles=True)]
        return tuple(gains)

    def _filter(self, gain: Mapping[str, Any], lowpass: System) -> System:
        system = lowpass
        for k in range(1, self.filter_order // 2 + 1):
            b = [gain["b0_1"] if k == 1 else 1.0, gain[f"b1_{k}"], gain[f"b2_{k}"]]
            system = in_series(system, second_order(b, gain[f"frequency_{k}"], gain[f"damping_{k}"]))
        if self.filter_order % 2:
            low = gain["b0_1"] if self.filter_order == 1 else 1.0
            system = in_series(system, first_order(low, gain["c"], gain["corner"]))
        return system


@dataclass(frozen=True)
class ObserverStructure(PerAxis):
    r"""State feedback from an observer that models one mode per axis.

    .. math:: \dot{\hat x} = \omega \begin{pmatrix} 0 & 1 \\ -1 & -2 \zeta_m \end{pmatrix} \hat x
              + \omega \begin{pmatrix} 0 \\ 1 \end{pmatrix} r
              + \omega \begin{pmatrix} l_1 \\ l_2 \end{pmatrix} (p - \hat x_1), \quad
              r = f_1 \hat x_1 + f_2 \hat x_2

    The states are position and velocity over omega. The gains per axis are ``l1``, ``l2`` of the observer, ``f1``,
    ``f2`` of the feedback [m/m], and ``frequency`` of the modelled mode [kHz]. Observer and feedback alone are stable
    within the bounds.

    Parameters
    ----------
    observer_limit, feedback_limit : float
        Bounds on l (from 0) and on the magnitude of f.
    frequency_khz : (lowest, highest)
        Bounds of the frequency of the mode [kHz].
    model_damping : float
        Damping factor of the modelled mode.
    lowpass_hz, order, tune_corner, axes, feedback, gain_unit
        As in `PStructure`; by default there is no low-pass.
    """

    order: CountOrZero = 0
    observer_limit: Positive = 8.0
    feedback_limit: Positive = 3.0
    frequency_khz: PositiveRange = (0.02, 1.0)
    model_damping: Positive = 0.1
    name: str = "observer"
    has_common_poles: ClassVar[bool] = False

    def _axis_gains(self) -> tuple[AxisGain, ...]:
        return (
            gain_within("l1", 1.0, (0.0, self.observer_limit), ""),
            gain_within("l2", 0.5, (-1.0, self.observer_limit), ""),
            symmetric_gain("f1", self.feedback_limit),
            symmetric_gain("f2", self.feedback_limit),
            gain_within("frequency", 0.12, self.frequency_khz, "kHz"),
        )

    def _filter(self, gain: Mapping[str, Any], lowpass: System) -> System:
        w = 2e3 * np.pi * gain["frequency"]
        l1, l2, f1, f2 = (gain[name] for name in ("l1", "l2", "f1", "f2"))
        A = ca.blockcat([[ca.SX(-w * l1), ca.SX(w)], [w * (f1 - 1 - l2), w * (f2 - 2 * self.model_damping)]])
        observer = A, ca.vertcat(ca.SX(w * l1), ca.SX(w * l2)), ca.horzcat(ca.SX(f1), ca.SX(f2)), ca.SX(1, 1)
        return in_series(lowpass, observer)


@dataclass(frozen=True)
class ResonantStructure(PerAxis):
    r"""Proportional controller with a resonant term at the speed, against synchronous vibration.

    .. math:: K_i(s) = \kappa_i L(s) + \frac{c_i \omega s + s_i \omega^2}{s^2 + 2 w_i \omega s + \omega^2}, \quad
              \omega^2 = \Omega^2 + \omega_0^2

    L is the low-pass. The gains per axis are ``kappa``, ``sine`` (s) and ``cosine`` (c) [m/m], and ``width`` (w). The
    frequency follows the speed: `gbid.tune` schedules this structure, and at each operating point it is another filter.
    A narrow term is a slow mode of the loop, whose damping counts like that of others.

    Parameters
    ----------
    lowest_hz : float
        Frequency of the term at rest, ``omega_0 / 2 pi`` [Hz].
    gain_limit : float
        Bound on the magnitude of the gains [m/m].
    width : (lowest, highest)
        Bounds of the damping factor of the term.
    lowpass_hz, order, tune_corner, axes, feedback, gain_unit
        As in `PStructure`; the low-pass acts on kappa.
    """

    gain_limit: Positive = 3.0
    width: PositiveRange = (0.02, 2.0)
    name: str = "resonant"

    @property
    def follows_speed(self) -> bool:
        """Whether the matrices depend on the speed."""
        return True

    def _axis_gains(self) -> tuple[AxisGain, ...]:
        gains = (symmetric_gain(name, self.gain_limit) for name in ("kappa", "sine", "cosine"))
        return (*gains, gain_within("width", 0.7, self.width, "", of_poles=True))

    def _filter(self, gain: Mapping[str, Any], lowpass: System) -> System:
        term = second_order((gain["sine"], gain["cosine"], 0.0), self._khz_at(1.0), gain["width"])
        straight = in_series(lowpass, (ca.SX(0, 0), ca.SX(0, 1), ca.SX(1, 0), ca.SX(gain["kappa"])))
        return in_parallel(straight, term)


@dataclass(frozen=True)
class FullPStructure(Proportional):
    r"""Proportional controller with cross-coupling and low-pass.

    .. math:: K(s) = \begin{pmatrix} \kappa_{xx} & \kappa_{xy} \\ \kappa_{yx} & \kappa_{yy} \end{pmatrix}
                     \left(\frac{p_{lp}}{s + p_{lp}}\right)^n

    Parameters
    ----------
    lower, upper : float
        Bounds of the gains [m/m].
    lowpass_hz, order, tune_corner, axes, feedback, gain_unit
        As in `PStructure`.
    """

    name: str = "full P"
    coupling: Literal["none", "full", "gyroscopic"] = "full"


@dataclass(frozen=True)
class FullPDStructure(PDStructure):
    r"""Proportional and derivative controller with cross-coupling; the low-pass makes it proper.

    .. math:: K_{ij}(s) = (\kappa_{ij} + k_{d,ij} s) \left(\frac{p_{lp}}{s + p_{lp}}\right)^n, \quad n \ge 1

    Parameters
    ----------
    lower, upper : float
        Bounds of kappa [m/m].
    kd_limit_ms : float
        Bound on the magnitude of the derivative gains [ms].
    lowpass_hz, order, tune_corner, axes, feedback, gain_unit
        As in `PStructure`; the order is at least 1.
    """

    name: str = "full PD"
    coupling: Literal["none", "full", "gyroscopic"] = "full"


@dataclass(frozen=True)
class FullBiquadStructure(BiquadStructure):
    r"""Biquad controller with cross-coupling: all filters of one input have a common denominator.

    .. math:: K_{ij}(s) = \frac{b_{2,ij} s^2 + b_{1,ij} \omega_j s + b_{0,ij} \omega_j^2}
                               {s^2 + 2 \zeta_j \omega_j s + \omega_j^2} \left(\frac{p_{lp}}{s + p_{lp}}\right)^n

    The gains are ``b0_xx`` ... ``b2_yy`` [m/m], and ``frequency`` [kHz] and ``damping`` of each input.

    Parameters
    ----------
    gain_limit : float
        Bound on the magnitude of the numerators' gains [m/m].
    frequency_khz, damping : (lowest, highest)
        Bounds of frequency [kHz] and damping factor, which keep the filters stable.
    lowpass_hz, order, tune_corner, axes, feedback, gain_unit
        As in `PStructure`; by default there is no low-pass.
    """

    name: str = "full biquad"
    coupling: Literal["none", "full", "gyroscopic"] = "full"


# ---- State feedback of a given plant.


def state_feedback(model: LinearModel, position: float, noise: float = 0.1, reach: float = 4.0) -> LinearStructure:
    r"""Return a state feedback with an observer of all states of a model, for example of a fitted model.

    .. math:: \dot{\hat x} = A \hat x + B r + L\,(p - C \hat x - D r), \quad r = F \hat x, \quad
              F = F_0\, \mathrm{diag}(f), \quad L = \mathrm{diag}(l)\, L_0

    F_0 and L_0 are those of the linear-quadratic optimum of the model, with the cost ``|p|^2 + position^2 |r|^2`` and
    disturbances of r beside noise of p. The gains are the factors f and l of each state, 1 at the start, where the loop
    of this model is stable.

    Parameters
    ----------
    model : LinearModel
        Continuous plant from r to p; exact delays become Padé delays of third order.
    position : float
        Position that costs as much as a reference of 1; a larger one gives a softer control.
    noise : float
        Noise of p, in units of `position`, beside disturbances of r of 1; less noise gives a faster observer.
    reach : float
        Largest factor.

    Returns
    -------
    LinearStructure
        Gains ``feedback_...`` and ``observer_...`` with the names of the states.

    Raises
    ------
    UsageError
        When the model is sampled, or a state that is not stable cannot be controlled or observed.
    """
    plant = with_pade(model, 3)
    if plant.dt is not None:
        raise UsageError(f"state_feedback: model {model.name!r} is sampled; give the continuous one")
    A, B, C, D = plant.A, plant.B, plant.C / position, plant.D / position  # p in units of position
    (n_p, n_r), n = D.shape, len(A)
    try:
        S = scipy.linalg.solve_continuous_are(A, B, C.T @ C, D.T @ D + np.eye(n_r), s=C.T @ D)
        P = scipy.linalg.solve_continuous_are(A.T, C.T, B @ B.T, noise**2 * np.eye(n_p))
    except (np.linalg.LinAlgError, ValueError) as error:
        raise UsageError(
            f"state_feedback: model {model.name!r} with position = {position:g} has no optimal feedback ({error}); "
            "leave out states that cannot be controlled or observed, or change position"
        ) from None
    F = -np.linalg.solve(D.T @ D + np.eye(n_r), B.T @ S + D.T @ C)
    L = P @ C.T / noise**2 / position
    states = plant.state_names if len(set(plant.state_names)) == n else tuple(str(i + 1) for i in range(n))
    names = [f"{kind}_{state}" for kind in ("feedback", "observer") for state in states]

    def matrices(p: Values) -> dict[str, Any]:
        factors = [ca.vertcat(*(p[name] for name in part)) for part in (names[:n], names[n:])]
        feedback, observer = F @ ca.diag(factors[0]), ca.diag(factors[1]) @ L
        inner = A + B @ feedback - observer @ (plant.C + plant.D @ feedback)
        return {"A": inner, "B": observer, "C": feedback, "D": ca.SX(n_r, n_p)}

    gains = [Parameter(name, 1.0, 0.0, reach) for name in names]
    return LinearStructure(f"state feedback of {model.name}", gains, matrices, plant.output_names, plant.input_names)


@cache
def built_in_structures() -> Mapping[str, type[PerAxis]]:
    """Built-in structures by name: all classes of this file that have a name."""
    classes = [c for c in globals().values() if isinstance(c, type) and issubclass(c, PerAxis) and c.name]
    return MappingProxyType({c.name: c for c in sorted(classes, key=lambda c: c.name)})
