"""Parts of the built-in controllers: gains and filter of an axis, low-pass (paper, Eq. 21), sections of filters."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import casadi as ca
import numpy as np

from gbid.core.arrays import is_finite, is_whole
from gbid.core.errors import UsageError
from gbid.discretise import Hold
from gbid.structure import Parameter
from gbid.structure.parameter import Values

System = tuple[Any, Any, Any, Any]
"""A, B, C, D as casadi.SX."""


@dataclass(frozen=True)
class Lowpass:
    """Low-pass filter ``(p_lp / (s + p_lp))^n`` as a chain of first-order lags.

    Parameters
    ----------
    corner_hz : float or casadi.SX
        Corner frequency ``p_lp / 2 pi`` [Hz].
    order : int
        Order n; 0 for none.
    """

    corner_hz: Any = 1000.0
    order: int = 1

    def check(self, where: str) -> None:
        """Refuse a corner frequency that is not positive, and an order that is not a whole number of at least 0.

        Raises
        ------
        UsageError
            When one of them is wrong.
        """
        if not (is_finite(self.corner_hz) and self.corner_hz > 0):
            raise UsageError(f"{where}: lowpass_hz = {self.corner_hz!r}; give a positive number of Hz")
        if not is_whole(self.order, 0):
            raise UsageError(f"{where}: order = {self.order}; it must be a whole number, at least 0")

    def matrices(self) -> System:
        """Return A (n, n), B (n, 1), C (1, n), D (1, 1) as casadi.SX."""
        n, corner = self.order, 2 * np.pi * self.corner_hz
        # the output of each stage is the input of the next
        chain = ca.sparsify(ca.SX(ca.DM(np.eye(n, k=-1) - np.eye(n))))
        first, last = ca.SX(n, 1), ca.SX(1, n)
        if n:
            first[0], last[n - 1] = corner, 1.0
        return corner * chain, first, last, ca.SX(1, 1) if n else ca.SX(1)


# ---- Controllers with a filter and a low-pass per axis, from disc position p to reference r.

AXES = ("x", "y")
INPUTS = ("p_x", "p_y")
OUTPUTS = ("r_x", "r_y")
NOT_OPTIONS = ("name", "inputs", "outputs", "intersample", "speed_rpm")
"""Fields of a structure that are no options of the user."""


class AxisGain(NamedTuple):
    """A gain that each axis has: name, start, bounds and unit; whether it is one of the filter's poles."""

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
    """Return the value within bounds that is nearest to a value."""
    return min(max(value, bounds[0]), bounds[1])


def gain_within(name: str, start: float, bounds: tuple[float, float], unit: str, of_poles: bool = False) -> AxisGain:
    """Gain with the start value within its bounds that is nearest to a given one."""
    return AxisGain(name, inside(start, bounds), *bounds, unit, of_poles)


def symmetric_gain(name: str, limit: float, unit: str = "m/m", start: float = 0.0) -> AxisGain:
    """Gain of a bounded magnitude."""
    return gain_within(name, start, (-limit, limit), unit)


def pole_gains(frequency_khz: tuple[float, float], damping: tuple[float, float]) -> tuple[AxisGain, AxisGain]:
    """Gains of a pair of poles: its frequency [kHz] and its damping factor, within their bounds."""
    return (
        gain_within("frequency", 0.15, frequency_khz, "kHz", of_poles=True),
        gain_within("damping", 0.7, damping, "", of_poles=True),
    )


@dataclass(frozen=True)
class PerAxis(ABC):
    """Base class of the built-in structures: one filter per axis in series with a low-pass.

    A structure gives the gains of an axis (`_axis_gains`) and the filter that they make (`_filter`); the rest is here.
    In a full structure (`crossed`) the filter of each input drives the references of all axes: ``kappa_xy`` goes from
    p_y to r_x, and gains of poles belong to an input, ``frequency_x``.

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
    """

    lowpass_hz: float = 1000.0
    order: int = 1
    tune_corner: bool = False
    name: str = ""
    inputs: tuple[str, ...] = INPUTS
    outputs: tuple[str, ...] = OUTPUTS
    intersample: Hold = "foh"
    axes: tuple[str, ...] = AXES
    crossed: ClassVar[bool] = False

    def __post_init__(self) -> None:
        axes = tuple(self.axes) if isinstance(self.axes, Iterable) else ()
        if not axes or not all(isinstance(axis, str) for axis in axes) or len(set(axes)) < len(axes):
            raise UsageError(f"controller {self.name!r}: axes = {self.axes!r}; give each axis a name of its own")
        object.__setattr__(self, "axes", axes)
        if self.axes != AXES:
            object.__setattr__(self, "inputs", tuple(gain_name("p", axis) for axis in self.axes))
            object.__setattr__(self, "outputs", tuple(gain_name("r", axis) for axis in self.axes))
        Lowpass(self.lowpass_hz, self.order).check(f"controller {self.name!r}")
        if self.tune_corner and self.order == 0:
            raise UsageError(f"controller {self.name!r}: tune_corner needs a low-pass; give an order of at least 1")
        if self.tune_corner and not 0.05 <= self.lowpass_hz / 1e3 <= 2.5:
            raise UsageError(
                f"controller {self.name!r}: lowpass_hz = {self.lowpass_hz:g}; to be tuned it must start in 50 to 2500"
            )

    @abstractmethod
    def _axis_gains(self) -> tuple[AxisGain, ...]:
        """Return the gains of an axis."""

    @abstractmethod
    def _filter(self, gain: Mapping[str, Any], lowpass: System) -> System:
        """Return A, B, C, D of one axis for its gains and its low-pass."""

    def _gain_name(self, gain: AxisGain, to: str, of: str) -> str:
        """Name of a gain in the filter from an input to an output."""
        return f"{gain.name}_{to}{of}" if self.crossed and not gain.of_poles else gain_name(gain.name, of)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Gains of all axes, by kind; the corner frequency is last when it is tuned."""
        gains = [
            Parameter(name, gain.start, gain.lower, gain.upper, unit=gain.unit)
            for gain in self._axis_gains()
            for name in dict.fromkeys(self._gain_name(gain, to, of) for to in self.axes for of in self.axes)
        ]
        if self.tune_corner:
            gains.append(Parameter("lowpass_khz", self.lowpass_hz / 1e3, 0.05, 2.5, unit="kHz"))
        return tuple(gains)

    def matrices(self, p: Values) -> dict[str, Any]:
        """Return A, B, C and D for gains by name."""
        corner = p["lowpass_khz"] * 1e3 if self.tune_corner else self.lowpass_hz
        lowpass, gains = Lowpass(corner, self.order).matrices(), self._axis_gains()
        columns = []
        for of in self.axes:
            filters = [
                self._filter({gain.name: p[self._gain_name(gain, to, of)] for gain in gains}, lowpass)
                for to in (self.axes if self.crossed else (of,))
            ]
            A, B = filters[0][:2]  # the filters to all outputs have the same
            columns.append((A, B, ca.vertcat(*(f[2] for f in filters)), ca.vertcat(*(f[3] for f in filters))))
        join = ca.horzcat if self.crossed else ca.diagcat
        return {
            letter: (ca.diagcat if letter in "AB" else join)(*(column[i] for column in columns))
            for i, letter in enumerate("ABCD")
        }

    def _check_bounds(self, lower: float, upper: float) -> None:
        for name, value in (("lower", lower), ("upper", upper)):
            if not is_finite(value):
                raise UsageError(f"controller {self.name!r}: {name} = {value!r}; give a finite number")
        if not lower < upper:
            raise UsageError(f"controller {self.name!r}: lower = {lower} must be below upper = {upper}")

    def _check_positive(self, **values: float) -> None:
        for name, value in values.items():
            if not (is_finite(value) and value > 0):
                raise UsageError(f"controller {self.name!r}: {name} = {value!r}; give a positive number")

    def _check_ranges(self, *names: str, positive: bool = True) -> None:
        """Refuse ranges that are empty, or not positive; store them as pairs of numbers."""
        for name in names:
            given = getattr(self, name)
            pair = tuple(given) if isinstance(given, Sequence | np.ndarray) else ()
            if len(pair) != 2 or not all(map(is_finite, pair)) or not pair[0] < pair[1] or (positive and pair[0] <= 0):
                kind = "positive " if positive else ""
                raise UsageError(f"controller {self.name!r}: {name} = {given!r}; give two {kind}numbers, lower first")
            object.__setattr__(self, name, (float(pair[0]), float(pair[1])))


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
    """Return the system whose input passes `first`, then `second`."""
    A, B, C, D = first
    a, b, c, d = second
    n, m = A.shape[0], a.shape[0]
    return ca.blockcat([[A, ca.SX(n, m)], [b @ C, a]]), ca.vertcat(B, b @ D), ca.horzcat(d @ C, c), d @ D


def in_parallel(first: Sequence[Any], second: Sequence[Any]) -> System:
    """Return the sum of two systems with one input."""
    A, B, C, D = first
    a, b, c, d = second
    return ca.diagcat(A, a), ca.vertcat(B, b), ca.horzcat(C, c), D + d
