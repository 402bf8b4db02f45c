"""Parts of the built-in controllers: gains and filter of an axis, low-pass (paper, Eq. 21), sections of filters."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Annotated, Any, ClassVar, NamedTuple

import casadi as ca
import numpy as np

from gbid.core.arrays import is_finite
from gbid.core.errors import UsageError
from gbid.core.option_types import Allowed, CountOrZero, Finite, Positive, check_options
from gbid.discretise import Hold
from gbid.structure import Parameter
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


# ---- Controllers with a filter and a low-pass per axis, from disc position p to reference r.

AXES = ("x", "y")
INPUTS = ("p_x", "p_y")
OUTPUTS = ("r_x", "r_y")
NOT_OPTIONS = ("name", "inputs", "outputs", "intersample", "speed_rpm")
"""Fields of a structure that are no options of the user."""

Range = Annotated[tuple[Finite, Finite], Allowed("two numbers, lower first")]
PositiveRange = Annotated[tuple[Positive, Positive], Allowed("two positive numbers, lower first")]
AxisNames = Annotated[tuple[str, ...], Allowed("each axis a name of its own")]


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

    lowpass_hz: Positive = 1000.0
    order: CountOrZero = 1
    tune_corner: bool = False
    name: str = ""
    inputs: tuple[str, ...] = INPUTS
    outputs: tuple[str, ...] = OUTPUTS
    intersample: Hold = "foh"
    axes: AxisNames = AXES
    crossed: ClassVar[bool] = False

    def __post_init__(self) -> None:
        where = f"controller {self.name!r}"
        check_options(self, where)
        for name in (
            each.name for each in fields(self) if isinstance(each.default, tuple) and is_finite(each.default[0])
        ):
            lower, upper = getattr(self, name)
            if not lower < upper:
                raise UsageError(f"{where}: {name} = ({lower:g}, {upper:g}); give two numbers, lower first", name)
            object.__setattr__(self, name, (float(lower), float(upper)))
        if not self.axes or len(set(self.axes)) < len(self.axes):
            raise UsageError(f"{where}: axes = {self.axes!r}; give each axis a name of its own", "axes")
        object.__setattr__(self, "axes", tuple(self.axes))
        if self.axes != AXES:
            object.__setattr__(self, "inputs", tuple(gain_name("p", axis) for axis in self.axes))
            object.__setattr__(self, "outputs", tuple(gain_name("r", axis) for axis in self.axes))
        if self.tune_corner and self.order == 0:
            raise UsageError(f"{where}: tune_corner needs a low-pass; give an order of at least 1", "order")
        if self.tune_corner and not 0.05 <= self.lowpass_hz / 1e3 <= 2.5:
            raise UsageError(
                f"{where}: lowpass_hz = {self.lowpass_hz:g}; to be tuned it must start in 50 to 2500", "lowpass_hz"
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
        lowpass, gains = lowpass_filter(corner, self.order), self._axis_gains()
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
